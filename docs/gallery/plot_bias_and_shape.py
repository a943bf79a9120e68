"""
Bias and shape of the errors
============================

What is wrong with ``ekf-xyz`` at a 9 cm baseline: left the mean error of each axis in stated standard deviations, with
95 % intervals; right the mean product of the whitened errors, scaled to trace 3: the identity, if
relative sizes and correlations are as stated.
"""

import matplotlib.pyplot as plt

import consistency as cs

AXES = ("x", "y", "heading")

results = cs.run_trials(cs.load_scenario("herath2007-stereo"), ["ekf-xyz"], runs=50, seed=101)
verdict = cs.analyse(results)["ekf-xyz"]

figure, (left, right) = plt.subplots(1, 2, figsize=(7.2, 3), width_ratios=(3, 2), layout="constrained")
for i, axis in enumerate(AXES):
    bias = verdict.bias.by_axis[axis]
    left.errorbar(i, bias.value, [[bias.value - bias.low], [bias.high - bias.value]], fmt="o", color="C0", capsize=4)
left.axhline(0, color="0.4", lw=0.8)
left.set_xticks(range(3), labels=AXES)
left.set(xlim=(-0.5, 2.5), ylabel="mean error, stated sigma")

picture = right.imshow(verdict.shape.matrix, cmap="RdBu_r", vmin=-2, vmax=2)
for i, row in enumerate(verdict.shape.matrix):
    for j, value in enumerate(row):
        right.text(j, i, f"{value:.2f}", ha="center", va="center", color="white" if abs(value) > 1.4 else "black")
right.set_xticks(range(3), labels=AXES)
right.set_yticks(range(3), labels=AXES)
figure.colorbar(picture, ax=right)
print(verdict.reasons[0])
