"""Judged motions with their covariances: as a record of the referee, and as files that ``analyse --motions`` reads."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from consistency.referee.column_names import COVARIANCE
from consistency.referee.diagnostics.records.record import Record
from consistency.referee.fit_covariance.covariance_ratios import Fold
from consistency.referee.fit_covariance.motion_windows import DriveWindows
from consistency.referee.geometry.lie_groups import composed, propagated, to_left, vectors
from consistency.referee.readers.pipeline.relative_motions import relative_recording
from consistency.referee.readers.places import Places
from consistency.referee.readers.truth_matching import Poses
from consistency.referee.readers.windows import Relative
from consistency.referee.types import Array

DIGITS = "%.17g"  # all that a number has
CONVENTIONS = {3: "so2", 6: "so3"}  # the defaults of files, so that they are read without further options


def stretches_of(windows: DriveWindows, folds: Sequence[Fold]) -> list[Poses]:
    """Each stretch of neighbouring windows of a drive that are judged; a window left out begins another."""
    found: list[Poses] = []
    for fold in folds:
        some = windows.of(fold.judges(windows))
        corrected = fold.noise.mean.applied(some)
        C = fold.noise.covariance(corrected.pieces)
        begins = np.flatnonzero(~some.follows) + 1
        for part in np.split(np.arange(len(C)), begins):
            if len(part):
                found.append(_stretch(len(found), corrected.of(part), C[part]))
    return found


def _stretch(run: int, windows: DriveWindows, C: Array) -> Poses:
    """Neighbouring windows of one drive as rows, the first of which is only where they start."""
    drive = windows.drives[windows.drive[0]]
    n = len(windows.axes)
    convention = CONVENTIONS[n]
    D = windows.motions
    P = propagated(np.linalg.inv(to_left(D, convention)), C)
    start = np.eye(windows.d + 1)[None]
    t = drive.t[np.append(windows.first, windows.last[-1])]
    return Poses(
        place=Places(lambda row: f"{drive.name}, window {row}", np.arange(len(t))),
        t=t,
        estimate=vectors(np.concatenate([start, D])),
        covariance=np.concatenate([np.zeros((1, n, n)), P]),
        stated=np.ones(len(t), bool),
        true_t=t,
        truth=vectors(composed(np.concatenate([start, windows.true]))),
        manifold="planar" if n == 3 else "spatial",
        convention=convention,
        max_dt=0.0,
        run=run,
        files=(drive.name, drive.name),
    )


def record_of_motions(stretches: Sequence[Poses], axes: Sequence[str]) -> Record:
    """The record that ``analyse --motions --relative 1`` has of the written files."""
    one = Relative(1.0, "step", motions=True, independent=True)
    names = ("x", "y", "heading") if len(axes) == 3 else axes
    return relative_recording("motions", "motions", stretches, names, range(len(axes)), one)


def write_motions(stretches: Sequence[Poses], folder: Path) -> list[str]:
    """motions.csv and truth.csv in the plane, folders motions/ and truth/ of trajectories in space; their names."""
    if stretches[0].d == 2:
        _write_tables(stretches, folder)
        return ["motions.csv", "truth.csv"]
    for part in ("motions", "truth"):
        (folder / part).mkdir()
    for each in stretches:
        file = f"{each.run:03d}-{str(each.files[0]).replace('/', '_')}.tum"
        covariances = each.covariance.reshape(len(each.t), -1)
        np.savetxt(folder / "motions" / file, np.column_stack([each.t, each.estimate, covariances]), DIGITS)
        np.savetxt(folder / "truth" / file, np.column_stack([each.t, each.truth]), DIGITS)
    return ["motions", "truth"]


def _write_tables(stretches: Sequence[Poses], folder: Path) -> None:
    """Two tables, with a clock where all stretches have one."""
    motions, truth = [], []
    for each in stretches:
        keys = np.column_stack([np.full(len(each.t), each.run), np.arange(len(each.t)), each.t])
        stated = [each.covariance[:, i, j] for i, j in COVARIANCE.values()]
        motions.append(np.column_stack([keys, each.estimate, *stated]))
        truth.append(np.column_stack([keys, each.truth]))
    head = np.array(["run", "step", "t", "x", "y", "heading", *COVARIANCE])
    for name, parts in (("motions", motions), ("truth", truth)):
        rows = np.concatenate(parts)
        known = ~np.isnan(rows).any(axis=0)
        columns = ",".join(head[: len(known)][known])
        np.savetxt(folder / f"{name}.csv", rows[:, known], DIGITS, ",", header=columns, comments="")
