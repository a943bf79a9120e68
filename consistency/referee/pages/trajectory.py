"""The trajectory of one run, true and estimated, with ellipses where the errors are largest against the covariance."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from consistency.referee.diagnostics.records.record import Record
from consistency.referee.diagnostics.statistics import distributions
from consistency.referee.document.colours import TRUTH, Look, style
from consistency.referee.geometry.conventions import CHARTS
from consistency.referee.show.matplotlib_style import dots, make_map, path
from consistency.referee.types import Array, Indices

if TYPE_CHECKING:
    from matplotlib.axes import Axes

IN_WORLD = ("so2", "so3", "so3-body", "vector", *CHARTS)  # errors whose position is about the axes of the world
NAMES = "xyz"
MOST = 5  # ellipses
SHARE = 0.95  # of a right estimator's errors in a step that lie inside its ellipse
CORNERS = 73
TRUE, ESTIMATED = Look(TRUTH, width=0.9), replace(style(0), width=1.0)
ELLIPSE, AT = replace(style(1), dash=(), width=0.9), Look(TRUTH, marker="X", size=5.0)


def shown_run(record: Record) -> int:
    """Row of the run that is drawn: the first that reaches furthest."""
    assert record.error is not None
    return int(np.argmax(np.isfinite(record.error).all(axis=-1).sum(axis=1)))


def trajectory_panel(record: Record) -> tuple[str, Callable[[Axes], None]] | None:
    """Caption, and what draws the shown run on axes; None where positions are not known.

    It shows the two axes over which the path reaches furthest.
    """
    if record.path is None or record.error is None or record.window is not None:
        return None
    row = shown_run(record)
    true, estimated = record.path[row, :, 0], record.path[row, :, 1]
    known = np.isfinite(record.path[row]).all(axis=(1, 2))
    if known.sum() < 2 or sum(axis in record.axes for axis in NAMES) < 2:
        return None
    pair = furthest(record, np.ptp(true[known], axis=0))
    steps = _worst(record, row) if record.convention in IN_WORLD else np.empty(0, np.int64)

    def paint(axes: Axes) -> None:
        path(axes, true[:, pair], TRUE, "truth")
        path(axes, estimated[:, pair], ESTIMATED, "estimate")
        label = "95 % ellipse"
        for outline in ellipses_at(record, row, steps, pair):
            path(axes, outline, ELLIPSE, label)
            label = ""
        if len(steps):
            axes.plot(*true[steps][:, pair].T, label="truth there", **dots(AT))
        x, y = (record.own_names.get(NAMES[axis], NAMES[axis]) for axis in pair)
        axes.set(xlabel=f"{x} (m)", ylabel=f"{y} (m)")
        make_map(axes)

    caption = f"Trajectory of {record.unit} {record.run_numbers[row]}, true and estimated."
    if len(steps):
        where = ", ".join(str(step + 1) for step in sorted(steps))
        caption += (
            " Ellipses: where the truth lies with 95 % by the stated covariance, in the steps whose errors are "
            f"largest against it ({where}); crosses are the truth there."
        )
    elif record.convention not in IN_WORLD:
        caption += " No ellipses: the stated covariance is not about the axes of the world."
    return caption, paint


def furthest(record: Record, reach: Array) -> list[int]:
    """Two of the position's axes that are judged, with the largest product of their reach (3,); else the first."""
    judged = [i for i, name in enumerate(NAMES) if name in record.axes]
    return list(max(itertools.combinations(judged, 2), key=lambda two: float(np.prod(reach[list(two)]))))


def ellipses_at(record: Record, row: int, steps: Indices, pair: Sequence[int]) -> list[Array]:
    """Outlines (corners, 2) of the 95 % regions of one run in some steps, about the estimates."""
    if not len(steps):
        return []
    assert record.path is not None
    assert record.covariance is not None
    index = [list(record.axes).index(NAMES[axis]) for axis in pair]
    P = np.asarray(record.covariance[row], float)[steps][:, index][:, :, index]
    centres = record.path[row, steps, 1][:, list(pair)]
    return [ellipse(centre, own) for centre, own in zip(centres, P, strict=True)]


def ellipse(centre: Array, P: Array) -> Array:
    """Outline (corners, 2) of the region that holds a share of 95 % about ``centre`` (2,) with covariance P (2, 2)."""
    angle = np.linspace(0.0, 2.0 * np.pi, CORNERS)
    circle = np.sqrt(float(distributions.chi2.ppf(SHARE, 2))) * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.asarray(centre + circle @ np.linalg.cholesky(P).T)


def _worst(record: Record, row: int) -> Indices:
    """Steps of the largest NEES, at most five, and apart from each other by a twentieth of the run."""
    if record.nees is None:
        return np.empty(0, np.int64)
    nees = np.where(np.isfinite(record.nees[row]), record.nees[row], -1.0)
    apart, found = max(len(nees) // 20, 1), list[int]()
    for step in np.argsort(-nees, kind="stable"):
        if nees[step] < 0.0 or len(found) == MOST:
            break
        if all(abs(int(step) - other) >= apart for other in found):
            found.append(int(step))
    return np.array(found, np.int64)
