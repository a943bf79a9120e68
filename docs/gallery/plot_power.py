"""
How many runs a verdict takes
=============================

Probability that the average NEES of a planar pose shows a covariance that is too small, by the number of runs; the dots
are at 95 %.
"""

import matplotlib.pyplot as plt

from consistency.diagnostics import power_of, required_runs

DOF, FALSE_ALARM, POWER = 3, 0.05, 0.95

figure, axes = plt.subplots(figsize=(7.2, 3.2), layout="constrained")
runs = range(2, 301)
for ratio, dashes in ((1.2, "-"), (1.35, "--"), (1.5, ":"), (2, "-.")):
    axes.plot(
        runs, [power_of(DOF, n, ratio, FALSE_ALARM) for n in runs], dashes, label=f"covariance too small by x{ratio:g}"
    )
    needed = required_runs(DOF, ratio, FALSE_ALARM, POWER)
    axes.plot(needed, POWER, "ko", ms=4)
    axes.annotate(f"{needed}", (needed, POWER), (4, -11), textcoords="offset points")
axes.set(xscale="log", xlabel="runs", ylabel="probability of finding it", xlim=(2, 300), ylim=(0, 1.02))
axes.set_xticks([2, 5, 10, 20, 50, 100, 200], labels=["2", "5", "10", "20", "50", "100", "200"])
axes.minorticks_off()
axes.legend(loc="lower right")
