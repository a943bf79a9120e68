"""
Map of where a filter is consistent
===================================

The map that ships with the bench has twelve filters in 150 worlds: baseline by range of the landmarks, with three
densities of landmarks and two noises of the odometry in each place. ``consistency sweep`` makes such a map for other
filters and worlds.
"""

import matplotlib.pyplot as plt

from consistency.sweeps import read_regime

FILTERS = ("ekf-uvd", "ukf-uvd", "parked-ekf-uvd")

table = read_regime().table.assign(consistent=lambda rows: rows["status"] == "consistent")
worlds = len(table.groupby(["density", "odometry"]))

figure, panels = plt.subplots(1, len(FILTERS), figsize=(7.2, 2.9), sharex=True, sharey=True, layout="constrained")
for axes, name in zip(panels, FILTERS, strict=True):
    rows = table[table["filter"] == name]
    counts = rows.pivot_table(index="range", columns="baseline", values="consistent", aggfunc="sum")
    axes.imshow(counts, cmap="Greens", vmin=0, vmax=1.4 * worlds, origin="lower", aspect="auto")
    for i, row in enumerate(counts.to_numpy()):
        for j, count in enumerate(row):
            axes.text(j, i, count, ha="center", va="center")
    axes.set_title(name, fontsize="medium")
    axes.set_xticks(range(counts.shape[1]), labels=[f"{value:g}" for value in counts.columns])
    axes.set_yticks(range(counts.shape[0]), labels=[f"{value:g}" for value in counts.index])
    axes.set_xlabel("baseline, m")
panels[0].set_ylabel("range of landmarks, m")
figure.suptitle(f"worlds, of {worlds} each, in which the filter is consistent", fontsize="medium")
