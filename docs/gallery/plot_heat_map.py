"""
Heat map of a sweep
===================

By how much the covariance of a filter is too small, over the baseline of the cameras and the range of the landmarks,
from the map that ships with the bench (the densest landmarks, the smaller noise of the odometry). White is right.
"""

import matplotlib.pyplot as plt
from matplotlib.colors import LogNorm

from consistency.sweeps import read_regime

FILTERS = ("ekf-uvd", "ukf-uvd", "parked-ekf-uvd")

table = read_regime().table
world = table[(table["density"] == table["density"].max()) & (table["odometry"] == table["odometry"].min())]

figure, panels = plt.subplots(1, len(FILTERS), figsize=(7.2, 2.9), sharex=True, sharey=True, layout="constrained")
for axes, name in zip(panels, FILTERS, strict=True):
    ratio = world[world["filter"] == name].pivot_table(index="range", columns="baseline", values="ratio")
    picture = axes.imshow(ratio, cmap="RdBu_r", norm=LogNorm(0.01, 100), origin="lower", aspect="auto")
    for i, row in enumerate(ratio.to_numpy()):
        for j, value in enumerate(row):
            text, ink = (f"{value:.2g}", "black") if value < 20 else (f"{min(value, 100):.0f}", "white")
            axes.text(j, i, text if value < 100 else ">100", ha="center", va="center", color=ink, fontsize="small")
    axes.set_title(name, fontsize="medium")
    axes.set_xticks(range(ratio.shape[1]), labels=[f"{value:g}" for value in ratio.columns])
    axes.set_yticks(range(ratio.shape[0]), labels=[f"{value:g}" for value in ratio.index])
    axes.set_xlabel("baseline, m")
panels[0].set_ylabel("range of landmarks, m")
figure.colorbar(picture, ax=panels, label="true over stated covariance", extend="max")
