"""Judged motions with their covariances: as a record of the referee, and as files that ``analyse --motions`` reads."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from consistency.referee.column_names import COVARIANCE
from consistency.referee.diagnostics import Record
from consistency.referee.fit_covariance.covariance_ratios import Fold
from consistency.referee.fit_covariance.drives import Drive
from consistency.referee.fit_covariance.motion_windows import DriveWindows
from consistency.referee.geometry.groups import composed, propagated, to_left, vectors
from consistency.referee.readers.formats.sheet import Places
from consistency.referee.readers.relative_motions import Stretch, relative_recording
from consistency.referee.readers.windows import Relative

CONVENTIONS = {3: "so2", 6: "so3"}  # the defaults of files, so that they are read without further options
HEAD = ("run", "step", "t", "x", "y", "heading")


def stretches_of(drives: Sequence[Drive], windows: DriveWindows, folds: Sequence[Fold]) -> list[tuple[str, Stretch]]:
    """Name and rows of each stretch of neighbouring windows that are judged; a window left out begins another."""
    found: list[tuple[str, Stretch]] = []
    for fold in folds:
        some = windows.of(fold.judges(windows))
        corrected = fold.noise.mean.applied(some)
        D = corrected.motions
        kind = CONVENTIONS[len(some.axes)]
        P = propagated(np.linalg.inv(to_left(D, kind)), fold.noise.covariance(corrected.pieces))
        begins = np.flatnonzero((np.diff(some.drive) != 0) | (some.first[1:] != some.last[:-1])) + 1
        for part in np.split(np.arange(len(D)), begins):
            if not len(part):
                continue
            name, run = drives[some.drive[part[0]]].name, len(found)
            ends = np.append(some.first[part], some.last[part[-1]])
            start = np.eye(some.d + 1)[None]
            rows = np.arange(len(ends))
            found.append((name, Stretch(
                run, name, Places(lambda row, name=name: f"{name}, window {row}", rows),  # type: ignore[misc]
                drives[some.drive[part[0]]].t[ends], vectors(np.concatenate([start, D[part]])),
                np.concatenate([np.zeros((1, *P.shape[1:])), P[part]]), None, rows,
                vectors(composed(np.concatenate([start, some.true[part]]))), kind,
            )))  # fmt: skip
    return found


def record_of_motions(stretches: Sequence[tuple[str, Stretch]], axes: Sequence[str]) -> Record:
    """The record that ``analyse --motions --relative 1`` has of the written files."""
    one = Relative(1.0, "step", motions=True, independent=True)
    names = ("x", "y", "heading") if len(axes) == 3 else axes
    return relative_recording("motions", "motions", [each for _, each in stretches], names, range(len(axes)), one)


def write_motions(stretches: Sequence[tuple[str, Stretch]], folder: Path) -> list[str]:
    """motions.csv and truth.csv in the plane, folders motions/ and truth/ of trajectories in space; their names."""
    if stretches[0][1].d == 2:
        for name, lines in (("motions", _rows(stretches, True)), ("truth", _rows(stretches, False))):
            (folder / f"{name}.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
        return ["motions.csv", "truth.csv"]
    for part in ("motions", "truth"):
        (folder / part).mkdir()
    for name, s in stretches:
        stem = f"{s.run:03d}-{name.replace('/', '_')}.tum"
        for part, numbers in (
            ("motions", np.column_stack([s.t, s.estimate, s.covariance.reshape(len(s.t), -1)])),
            ("truth", np.column_stack([s.t, s.truth])),
        ):
            lines = (" ".join(map(repr, row)) for row in numbers.tolist())
            (folder / part / stem).write_text("\n".join(lines) + "\n", encoding="utf-8")
    return ["motions", "truth"]


def _rows(stretches: Sequence[tuple[str, Stretch]], stated: bool) -> Iterator[str]:
    """Lines of a table; with a clock where all have one."""
    timed = all(np.isfinite(s.t).all() for _, s in stretches)
    head = [name for name in HEAD if timed or name != "t"]
    yield ",".join([*head, *COVARIANCE] if stated else head)
    for _, s in stretches:
        poses = s.estimate if stated else s.truth
        for row, (t, pose, P) in enumerate(zip(s.t.tolist(), poses.tolist(), s.covariance.tolist(), strict=True)):
            numbers = [*([t] if timed else []), *pose]
            numbers += [P[i][j] for i, j in COVARIANCE.values()] if stated else []
            yield ",".join([str(s.run), str(row), *map(repr, numbers)])
