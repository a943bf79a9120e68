"""
Stop as soon as the runs speak
==============================

An e-process bets, run by run, that a covariance is wrong. Whoever stops when it reaches 1 / 0.05 fails a right filter
with probability 5 % or less, however often he looked. ``consistency run --until-decided`` does so.
"""

import matplotlib.pyplot as plt
import numpy as np

from consistency.diagnostics import e_process

RUNS, STEPS, DOF, FALSE_ALARM = 60, 100, 3, 0.05
rng = np.random.default_rng(101)

figure, axes = plt.subplots(figsize=(7.2, 3.2), layout="constrained")
for ratio, dashes in ((1.0, "-"), (1.5, "--"), (2.0, ":")):  # true over stated covariance
    error = np.zeros((RUNS, STEPS, DOF))
    error[:, 0] = rng.normal(size=(RUNS, DOF))
    for k in range(1, STEPS):  # errors that last for about twenty steps
        error[:, k] = 0.95 * error[:, k - 1] + np.sqrt(1 - 0.95**2) * rng.normal(size=(RUNS, DOF))
    means = ratio * (error**2).mean(axis=(1, 2))  # NEES over its degrees of freedom, of each run
    evidence = e_process(means, DOF).both
    stop = np.argmax(evidence >= 1 / FALSE_ALARM) if evidence.max() >= 1 / FALSE_ALARM else None
    (line,) = axes.plot(range(1, RUNS + 1), evidence, dashes, lw=1.5, label=f"covariance too small by x{ratio:g}")
    if stop is not None:
        axes.plot(stop + 1, evidence[stop], "o", color=line.get_color())
axes.axhline(1 / FALSE_ALARM, color="0.4", lw=0.8)
axes.text(RUNS, 1 / FALSE_ALARM, "found at fault ", ha="right", va="bottom")
axes.set(yscale="log", xlabel="runs", ylabel="e-value", xlim=(1, RUNS), ylim=(0.01, 1e4))
axes.legend(loc="lower right")
