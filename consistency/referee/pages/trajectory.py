"""The trajectory of one run, true and estimated, with ellipses where the errors are largest against the covariance."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from consistency.referee.diagnostics import Evidence
from consistency.referee.diagnostics.statistics import distributions
from consistency.referee.document.colours import TRUTH, Look, style
from consistency.referee.document.drawing import Axis, Figure, Key, Line, Mark, Panel, Points, Sheet
from consistency.referee.pages.one_step import has_one_step
from consistency.referee.types import Array, Indices

IN_WORLD = ("so2", "so3", "so3-body", "vector")  # errors whose position is about the axes of the world
MOST = 5  # ellipses
SHARE = 0.95  # of a right estimator's errors in a step that lie inside its ellipse
CORNERS = 73
TRUE, ESTIMATED = Look(TRUTH, width=0.9), replace(style(0), width=1.0)
ELLIPSE, AT = replace(style(1), dash=(), width=0.9), Look(TRUTH, marker="X", size=5.0)


def shown_run(record: Evidence) -> int:
    """Row of the run that is drawn: the first that reaches furthest."""
    assert record.error is not None
    return int(np.argmax(np.isfinite(record.error).all(axis=-1).sum(axis=1)))


def trajectory(record: Evidence) -> Figure | None:
    """Figure of the run that is drawn; None where positions are not known, or of runs of one step.

    It shows the two axes over which the path reaches furthest.
    """
    if record.path is None or record.error is None or record.window is not None or has_one_step(record):
        return None
    row = shown_run(record)
    true, estimated = record.path[row, :, 0], record.path[row, :, 1]
    known = np.isfinite(record.path[row]).all(axis=(1, 2))
    names = [axis for axis in ("x", "y", "z") if axis in record.axes]
    if known.sum() < 2 or len(names) < 2:
        return None
    reach = np.ptp(true[known], axis=0)
    axes = itertools.combinations(["xyz".index(name) for name in names], 2)
    i, j = pair = list(max(axes, key=lambda two: float(np.prod(reach[list(two)]))))  # the first where they are alike
    tips = (("x", "@x{0.000} m"), ("y", "@y{0.000} m"))
    marks: list[Mark] = [
        Line(true[:, i], true[:, j], TRUE, path=True, tips=tips),
        Line(estimated[:, i], estimated[:, j], ESTIMATED, path=True, tips=tips),
    ]
    keys = [Key("truth", TRUE), Key("estimate", ESTIMATED)]
    steps = _worst(record, row) if record.convention in IN_WORLD else np.empty(0, np.int64)
    if len(steps):
        assert record.covariance is not None
        index = [list(record.axes).index("xyz"[axis]) for axis in pair]
        P = np.asarray(record.covariance[row], float)[steps][:, index][:, :, index]
        for centre, own in zip(estimated[steps][:, pair], P, strict=True):
            outline = ellipse(centre, own)
            marks.append(Line(outline[:, 0], outline[:, 1], ELLIPSE, path=True))
        marks.append(Points(true[steps, i], true[steps, j], AT, whole=True, tips=tips))
        keys += [Key("95 % ellipse", ELLIPSE), Key("truth there", AT, "points")]
    where = ", ".join(str(step + 1) for step in sorted(steps))
    caption = f"Trajectory of {record.unit} {record.run_numbers[row]}, true and estimated." + (
        f" Ellipses: where the truth lies with 95 % by the stated covariance, in the steps whose errors are largest "
        f"against it ({where}); crosses are the truth there."
        if len(steps)
        else " No ellipses: the stated covariance is not about the axes of the world."
        if record.convention not in IN_WORLD
        else ""
    )
    panel = Panel(
        Axis(f"{'xyz'[i]} (m)"), Axis(f"{'xyz'[j]} (m)"), tuple(marks), f"Trajectory of {record.name}", height=420,
        shape="map", equal=True,
    )  # fmt: skip
    return Figure("Trajectory", caption, (panel,), (Sheet((panel,), 3.0, keys=tuple(keys)),), tuple(keys))


def ellipse(centre: Array, P: Array) -> Array:
    """Outline (corners, 2) of the region that holds a share of 95 % about ``centre`` (2,) with covariance P (2, 2)."""
    angle = np.linspace(0.0, 2.0 * np.pi, CORNERS)
    circle = np.sqrt(float(distributions.chi2.ppf(SHARE, 2))) * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.asarray(centre + circle @ np.linalg.cholesky(P).T)


def _worst(record: Evidence, row: int) -> Indices:
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
