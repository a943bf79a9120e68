"""
A monitor of innovations of a deployed filter
=============================================

A deployed filter has no truth, but it has innovations. From step 600 on their variance is twice what the filter
states. The alarm of the monitor is false with probability 0.1 % or less, however long the mission; it says
since when (shaded).
"""

import matplotlib.pyplot as plt
import numpy as np

import consistency as cs

STEPS, CHANGE, DOF = 1000, 600, 3
rng = np.random.default_rng(101)
nis = rng.chisquare(DOF, STEPS)
nis[CHANGE - 1 :] *= 2

monitor = cs.Monitor(false_alarm=1e-3)
evidence, alarm = [], None
for value in nis:
    alarm = monitor.update(value, DOF) or alarm
    evidence.append(monitor.evidence)

figure, (top, bottom) = plt.subplots(2, 1, figsize=(7.2, 3.8), sharex=True, layout="constrained")
steps = np.arange(1, STEPS + 1)
top.plot(steps, nis, ".", color="0.5", ms=3)
top.set(ylabel="NIS", ylim=(0, 30))
bottom.plot(steps, evidence)
bottom.axhline(monitor.threshold, color="0.4", lw=0.8)
bottom.set(yscale="log", xlabel="step", ylabel="e-value", xlim=(1, STEPS), ylim=(1e-2, 1e12))
for axes in (top, bottom):
    axes.axvspan(alarm.since, alarm.step, color="C1", alpha=0.3, lw=0)
bottom.annotate(f"alarm in step {alarm.step}", (alarm.step, monitor.threshold), (8, 6), textcoords="offset points")
print(alarm)
