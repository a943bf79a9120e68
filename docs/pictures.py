"""Draws the pictures of README.md: `python docs/pictures.py`, about a minute."""

from __future__ import annotations

import tempfile
import warnings
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import consistency as cs
from consistency.diagnostics import anees_interval
from consistency.reporting.front_end import samples_png
from consistency.reporting.looks import BAND, style
from consistency.sweeps.regime import read_regime
from consistency.verdicts.curves import curves
from consistency.vision import RelativePose, StereoRig, refine_reprojection

IMAGES = Path(__file__).parent / "images"
RUNS, SEED = 50, 101
FILTERS = ("ekf-uvd", "ukf-uvd", "parked-ekf-uvd")
RUN = 50.0  # s, of herath2007-stereo
TICKS = (2, 3, 5, 10, 20, 50)
RC = {"font.family": "DejaVu Sans", "font.size": 9, "axes.linewidth": 0.7, "svg.hashsalt": "consistency"}


def nine_centimetres() -> Figure:
    """Average NEES over time of the paper's two filters and of the one that is consistent."""
    results = cs.run_trials(cs.load_scenario("herath2007-stereo"), FILTERS, RUNS, SEED)
    figure = Figure(figsize=(7.2, 3.2), layout="constrained")
    axes: Axes = figure.subplots()
    low, high = anees_interval(3, RUNS)
    axes.axhspan(low, high, color=BAND, lw=0, label=f"95 % of a consistent filter, {RUNS} runs")
    for i, name in enumerate(FILTERS):
        found, look = curves(results, name), style(i)
        assert found.nees is not None
        with warnings.catch_warnings(action="ignore"):  # before the first observation there is no NEES
            average = np.nanmean(found.nees, axis=0)
        axes.plot(found.t, average, color=look.colour, lw=1.4, label=name)
    axes.set(yscale="log", xlabel="time, s", ylabel="average NEES of the pose", xlim=(0.0, RUN))
    axes.set_yticks(TICKS, labels=[f"{tick:g}" for tick in TICKS])
    axes.minorticks_off()
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="upper left")
    return figure


def regime() -> Figure:
    """In how many worlds of each baseline and range a filter is consistent."""
    shipped = read_regime()
    table, axes_of = shipped.table, {axis.key: axis.values for axis in shipped.sweep.axes}
    worlds = len(shipped.sweep.cells) // (len(axes_of["baseline"]) * len(axes_of["range"]))
    figure = Figure(figsize=(7.2, 2.9), layout="constrained")
    panels = figure.subplots(1, len(FILTERS), sharex=True, sharey=True)
    for axes, name in zip(panels, FILTERS, strict=True):
        good = table[table["filter"] == name].assign(good=lambda rows: rows["status"] == "consistent")
        counts = good.pivot_table(index="range", columns="baseline", values="good", aggfunc="sum")
        axes.imshow(counts, cmap="Greens", vmin=0, vmax=1.4 * worlds, origin="lower", aspect="auto")
        for i, j in np.ndindex(*counts.shape):
            axes.text(j, i, f"{counts.iat[i, j]:.0f}", ha="center", va="center")
        axes.set_title(name, fontsize=9)
        axes.set_xticks(range(counts.shape[1]), labels=[f"{value:g}" for value in counts.columns])
        axes.set_yticks(range(counts.shape[0]), labels=[f"{value:g}" for value in counts.index])
        axes.set_xlabel("baseline, m")
    panels[0].set_ylabel("range of landmarks, m")
    figure.suptitle(f"worlds, of {worlds} each, in which the filter is consistent", fontsize=9)
    return figure


def own_file() -> bytes:
    """The verdict on a file of somebody else's filter, whose measurements are noisier than it believes."""
    rng, runs, steps, sigma = np.random.default_rng(SEED), 60, 100, 0.5
    F, H, R = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[1.0, 0.0]]), 0.5 * sigma**2
    Q = 0.05 * np.array([[0.1**4 / 4, 0.1**3 / 2], [0.1**3 / 2, 0.1**2]])
    errors, covariances = np.empty((runs, steps, 2)), np.empty((runs, steps, 2, 2))
    for run in range(runs):
        x, P = np.zeros(2), np.eye(2)
        error = rng.multivariate_normal(x, P)  # truth minus estimate
        for step in range(steps):
            error = F @ error + rng.multivariate_normal(np.zeros(2), Q)
            P = F @ P @ F.T + Q
            K = P @ H.T / (H @ P @ H.T + R)
            error = error - K @ (H @ error + rng.normal(0.0, sigma, 1))
            P = (np.eye(2) - K @ H) @ P
            errors[run, step], covariances[run, step] = error, P
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mine.npz"
        np.savez(
            path, errors=errors, covariances=covariances, axes=["position", "speed"], t=0.1 * np.arange(1, steps + 1)
        )
        cs.judge(cs.read(path)).plot(Path(folder) / "picture.png")
        return (Path(folder) / "picture.png").read_bytes()


def ellipses() -> bytes:
    """Motions from simulated stereo matches, the scatter of 1,000 and the covariance that each states."""
    rng, K, sigma = np.random.default_rng(SEED), np.array([[700.0, 0, 600], [0, 700, 180], [0, 0, 1]]), 0.3
    rig = StereoRig(K, K, np.eye(3), np.array([0.54, 0.0, 0.0]), (1200, 360))
    true = RelativePose.from_vector(np.array([0.05, -0.02, 1.2, 0.002, -0.01, 0.003]))
    z = rng.uniform(6.0, 40.0, 60)
    p = np.column_stack([rng.uniform(-0.7, 0.7, 60) * z, rng.uniform(-0.2, 0.2, 60) * z, z])
    uv0, uv1, S = rig.project(p), rig.project((p - true.t) @ true.R), sigma**2 * np.eye(4)
    found = [
        refine_reprojection(rig, *(uv + rng.normal(0.0, sigma, uv.shape) for uv in (uv0, uv1)), true, S)
        for _ in range(1000)
    ]
    poses = np.array([each.pose.vector for each in found])
    return samples_png(poses, true.vector, found[0].covariance)


def main() -> None:
    IMAGES.mkdir(exist_ok=True)
    with mpl.rc_context(RC):
        nine_centimetres().savefig(IMAGES / "nine-centimetres.png", dpi=160)
        regime().savefig(IMAGES / "regime.png", dpi=160)
    (IMAGES / "own-file.png").write_bytes(own_file())
    (IMAGES / "ellipses.png").write_bytes(ellipses())


if __name__ == "__main__":
    main()
