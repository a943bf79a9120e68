"""
Average NEES over time, with its band
=====================================

Three filters on the same 50 simulated trials of a stereo robot with a 9 cm baseline. The average NEES of a consistent
filter lies in the grey band in 95 % of the steps.
"""

import matplotlib.pyplot as plt

import consistency as cs

FILTERS = {"ekf-uvd": "-", "ukf-uvd": "--", "parked-ekf-uvd": "-."}
LABELS = ["EKF: overconfident", "UKF: overconfident", "parked EKF: consistent"]
RUNS, SEED = 50, 101

results = cs.run_trials(cs.load_scenario("herath2007-stereo"), list(FILTERS), RUNS, SEED)

figure, axes = plt.subplots(figsize=(7.2, 3.2), layout="constrained")
low, high = cs.anees_interval(dof=3, runs=RUNS)
axes.axhspan(low, high, color="0.85", lw=0, label="95 % band of a consistent filter")
for (name, dashes), label in zip(FILTERS.items(), LABELS, strict=True):
    estimates = results.estimates[results.estimates["filter"] == name]
    average = estimates.groupby("t")["nees"].mean()  # over runs
    axes.plot(average.index, average, dashes, lw=1.8, label=label)
axes.set(yscale="log", xlabel="time, s", ylabel="average NEES of the pose", xlim=(0, average.index.max()))
axes.set_yticks([2, 3, 5, 10, 20, 50], labels=["2", "3", "5", "10", "20", "50"])
axes.minorticks_off()
axes.legend(loc="upper left")
