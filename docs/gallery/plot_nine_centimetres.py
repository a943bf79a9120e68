"""
Average NEES over time, with its band
=====================================

Three filters on the same simulated trials of a stereo robot with a 9 cm baseline, in twelve studies of 50 runs. Lines
are the median study, shades hold the middle half of the studies. The average NEES of a consistent filter lies in the
grey band in 95 % of the steps. In about half of the studies a run of the EKF diverges, and lifts the average by itself.
"""

import matplotlib.pyplot as plt
import numpy as np

import consistency as cs

FILTERS = {"ekf-uvd": "-", "ukf-uvd": "--", "parked-ekf-uvd": "-."}
LABELS = ["EKF: overconfident", "UKF: overconfident", "parked EKF: consistent"]
STUDIES, RUNS, SEED = 12, 50, 101

results = cs.run_trials("herath2007-stereo", list(FILTERS), STUDIES * RUNS, SEED)

figure, axes = plt.subplots(figsize=(7.2, 3.2), layout="constrained")
low, high = cs.anees_interval(dof=3, runs=RUNS)
axes.axhspan(low, high, color="0.85", lw=0, label="95 % band of a consistent filter")
for (name, dashes), label in zip(FILTERS.items(), LABELS, strict=True):
    estimates = results.estimates[results.estimates["filter"] == name]
    average = estimates.groupby([estimates["run"] // RUNS, "t"])["nees"].mean().unstack()  # over the runs of a study
    (line,) = axes.plot(average.columns, average.median(), dashes, lw=1.8, label=label)
    middle = average.quantile([0.25, 0.75])
    axes.fill_between(average.columns, *middle.to_numpy(), color=line.get_color(), alpha=0.2, lw=0)
    print(f"{name}: mean ANEES of each study", np.round(average.mean(axis=1), 1).tolist())
axes.set(yscale="log", xlabel="time, s", ylabel="average NEES of the pose", xlim=(0, 50), ylim=(1.5, 100))
axes.set_yticks([2, 3, 5, 10, 20, 50, 100], labels=["2", "3", "5", "10", "20", "50", "100"])
axes.minorticks_off()
axes.legend(loc="upper left")
