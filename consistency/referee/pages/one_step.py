"""Figures of runs of one step, as those of a factor or a calibration: along the axis stand the runs, each a point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from consistency.referee.diagnostics import Record
from consistency.referee.diagnostics.statistics import distributions
from consistency.referee.diagnostics.words.numbers import plural
from consistency.referee.document.colours import EXPECTED, SHADE, SIGMAS, ZERO, style
from consistency.referee.document.drawing import Axis, Band, Figure, Key, Mark, Panel, Points, Rule, Sheet
from consistency.referee.pages.judged import wide

EACH = replace(style(0), size=2.5, alpha=0.7)


def has_one_step(record: Record) -> bool:
    """Whether a curve along the steps would be a point, and one along the runs is not."""
    return len(record.t) == 1 and len(record.run_numbers) > 1


def _axis(record: Record) -> Axis:
    return Axis("run", share="run", window=(record.run_numbers.min() - 0.5, record.run_numbers.max() + 0.5))


def errors_of_runs(record: Record, units: Sequence[tuple[str, float]]) -> Figure:
    """Error of each run with its 2-sigma bounds, a panel for each of the components that have ``units``."""
    assert record.error is not None
    assert record.covariance is not None
    runs, axis, panels = record.run_numbers.astype(float), _axis(record), []
    for i, (unit, factor) in enumerate(units):
        error = factor * record.error[:, 0, i]
        bound = SIGMAS * factor * np.sqrt(np.maximum(record.covariance[:, 0, i, i], 0.0))
        tips = (("run", "@x"), ("error", f"@y{{0.0000}} {unit}"))
        marks = (Band(runs, -bound, bound, SHADE), Rule("y", 0.0, ZERO), Points(runs, error, EACH, tips=tips))
        label = f"{record.axes[i]} ({unit})" if unit else record.axes[i]
        alt = f"Error of {record.axes[i]} of {record.name} in each run, with 2-sigma bounds"
        panels.append(Panel(axis, Axis(label), marks, alt, height=220))
    caption = (
        "Error (truth minus estimate) of each run with the 2-sigma bounds that the estimator states (shaded). "
        "About 95 % of honest errors are inside."
    )
    keys = (Key("error of a run", EACH, "points"), Key("2-sigma bounds", SHADE, "band"))
    return figure_of_errors(record, caption, tuple(panels), keys)


def figure_of_errors(record: Record, caption: str, panels: tuple[Panel, ...], keys: tuple[Key, ...]) -> Figure:
    """Panels of the first components, side by side."""
    left_out, columns = len(record.axes) - len(panels), columns_of(len(panels))
    caption += f" {plural(left_out, 'further component')} not drawn." if left_out else ""
    sheet = Sheet(panels, 0.3 + 1.4 * -(-len(panels) // columns), columns=columns, keys=keys)
    return Figure("Errors and stated bounds", caption, panels, (sheet,), keys)


def columns_of(panels: int) -> int:
    """Panels in a row."""
    return 2 if panels in (2, 4) else min(3, panels)


def nees_of_runs(record: Record) -> Figure | None:
    """NEES of each run with the band of a right estimator."""
    if record.nees is None or not np.isfinite(record.nees).any():
        return None
    runs, values = record.run_numbers.astype(float), record.nees[:, 0]
    low, high = (np.full(len(runs), distributions.chi2.ppf(q, record.dof)) for q in (0.025, 0.975))
    marks: list[Mark] = [Band(runs, low, high, SHADE), Rule("y", float(record.dof), EXPECTED)]
    marks.append(Points(runs, values, EACH, tips=(("run", "@x"), ("NEES", "@y{0.000}"))))
    keys = (Key("95 % band of one run", SHADE, "band"), Key("expected", EXPECTED), Key("NEES of a run", EACH, "points"))
    caption = (
        f"NEES of each run; {record.dof} is expected in the mean (line). Above is overconfident, below conservative. "
        "Shaded: where 95 % of the runs of a right estimator lie, which is not judged."
    )
    panel = Panel(
        _axis(record), Axis("NEES", log=wide([values])), tuple(marks), f"NEES of each run of {record.name}", height=300
    )
    return Figure("NEES", caption, (panel,), (Sheet((panel,), 2.2, keys=keys),), keys)
