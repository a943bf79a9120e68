"""
Bias of stereo triangulation over range
=======================================

Depth is f B / d, and the disparity d is nearly Gaussian; so depth is not. Its mean is too large, and the more so the
fewer pixels of disparity a point has. Markers: the mean of 200,000 simulated disparities, those kept that exceed one
pixel; lines: the second-order bias sigma² / d², as a share of the range.
"""

import matplotlib.pyplot as plt
import numpy as np

import consistency as cs

sensor = cs.load_scenario("herath2007-stereo").truth.sensor
sigma = sensor.sigma[2]  # of the disparity, px
ranges = np.linspace(0.5, 6, 23)
rng = np.random.default_rng(101)

figure, axes = plt.subplots(figsize=(7.2, 3.2), layout="constrained")
for baseline, marker in ((sensor.B, "o"), (0.2, "s"), (0.5, "^")):
    true = sensor.f * baseline / ranges  # disparity, px
    measured = true + sigma * rng.normal(size=(200_000, len(ranges)))
    depth = np.where(measured > 1, sensor.f * baseline / measured, np.nan)
    bias = np.nanmean(depth, axis=0) / ranges - 1
    (line,) = axes.plot(ranges, 100 * (sigma / true) ** 2, lw=1.5)
    axes.plot(ranges, 100 * bias, marker, color=line.get_color(), ms=4, label=f"baseline {100 * baseline:.0f} cm")
axes.set(xlabel="range, m", ylabel="bias of the depth, %", xlim=(0, 6.1), ylim=(-0.5, 12))
axes.legend(loc="upper left")
