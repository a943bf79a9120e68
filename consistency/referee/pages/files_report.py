"""The report of another estimator: the verdict, then errors with bounds, NEES with band, coverage, innovations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import special

from consistency.referee.diagnostics import Record, Verdict
from consistency.referee.diagnostics.imperfect_truth.uncertain_truth import of_both
from consistency.referee.diagnostics.statistics import distributions
from consistency.referee.diagnostics.words.numbers import plural
from consistency.referee.document.blocks import Block, Chapter, Document, Facts, Text
from consistency.referee.document.colours import EXPECTED, LIMIT, SHADE, SIGMAS, ZERO, Look, style
from consistency.referee.document.drawing import Axis, Band, Figure, Key, Line, Mark, Panel, Points, Rule, Sheet, xy
from consistency.referee.errors import InputError
from consistency.referee.pages import axes, questions, verdicts
from consistency.referee.pages.judged import Clock, Estimator, Judged, clock_of, wide
from consistency.referee.pages.one_step import columns_of, errors_of_runs, figure_of_errors, has_one_step, nees_of_runs
from consistency.referee.pages.provenance import facts
from consistency.referee.pages.trajectory import shown_run, trajectory
from consistency.referee.types import Array

MOST_PANELS = 12  # components of an error that are drawn
MOST_RUNS = 20  # runs that are drawn beside the shown one
ANGLES = {"heading", "yaw", "pitch", "roll"}
METRES = {"x", "y", "z"}
DERIVED = {"v": "m/s", "bg": "rad/s", "ba": "m/s^2"}  # velocities and biases, by what comes before x, y, z
OF_BOTH = "Covariances are those of estimate and truth together."
SHOWN, OTHERS = replace(style(0), width=1.0), Look("#c0c0c0", width=0.5)
JOINT = Look("#333333", width=1.4)


def compose_files(
    records: Sequence[Record], judged: Mapping[str, Verdict], title: str, manifest: Mapping[str, Any]
) -> Document:
    """The document that HTML and PDF show; a chapter for each of the records that has a verdict."""
    named = {record.name: record for record in records}
    study = _study(tuple(judged.values()), title)
    several = len(judged) > 1
    chapters = [
        Chapter(
            f"estimator-{i}",
            name,
            name,
            (*[Text(f"{name} is {_ended(verdict.reasons[0])}")] * several, *record_figures(named[name], verdict)),
            _counts(named[name], verdict),
        )
        for i, (name, verdict) in enumerate(judged.items())
    ]
    by_axis = axes.read(study)
    blocks: list[Block] = [*verdicts.judgement(study), *questions.show(questions.read(study))]
    blocks += [] if by_axis is None else axes.figures(by_axis)
    blocks.append(Text(verdicts.method((study,)), "How a verdict comes about.", "note"))
    notes = list(dict.fromkeys(note for name in judged for note in named[name].notes))
    read = tuple(Text(note[:1].upper() + note[1:] + "." * (note[-1] not in ".?")) for note in notes)
    chapters += [
        Chapter("verdicts", "Verdict in figures", "Figures", tuple(blocks)),
        Chapter("provenance", "What was read", "Files", (*read, Facts(facts(dict(manifest))))),
    ]
    return Document(f"Estimator consistency: {title}", answer(judged), tuple(chapters))


def answer(judged: Mapping[str, Verdict]) -> str:
    """The sentence of each verdict."""
    return " ".join(f"{name} is {_ended(verdict.reasons[0])}" for name, verdict in judged.items())


def _ended(sentence: str) -> str:
    return sentence if sentence.endswith(".") else f"{sentence}."


def _study(judged: tuple[Verdict, ...], title: str) -> Judged:
    tracks = tuple(Estimator(v.filter, i, f"0:{i}", v, v.failures) for i, v in enumerate(judged))
    runs, steps = max(v.runs for v in judged), max(v.steps for v in judged)
    return Judged(title, "", runs, 0, clock_of(np.full(steps, np.nan)), np.arange(1, steps + 1), tracks, False)


def _counts(record: Record, verdict: Verdict) -> str:
    clock = clock_of(record.t)
    length = plural(verdict.steps, "step" if record.window is None else "window")
    size = f"{plural(verdict.runs, verdict.unit)} of {record.window if record.independent else length}"
    return f"{size}, {np.ptp(clock.values):.4g} s" if clock.word == "s" and len(record.t) > 1 else size


def record_figures(record: Record, verdict: Verdict) -> tuple[Figure, ...]:
    """Errors with their bounds, NEES, trajectory, coverage, and innovations; those that the record has."""
    if record.truth_covariance is not None:
        figures = record_figures(of_both(record), verdict)
        return tuple(replace(figure, caption=f"{figure.caption} {OF_BOTH}") for figure in figures)
    found = (
        _errors(record), _nees(record, verdict), trajectory(record), _coverage(record), _innovations(record, verdict),
    )  # fmt: skip
    return tuple(figure for figure in found if figure is not None)


def record_sheet(record: Record, verdict: Verdict | None = None) -> Sheet:
    """Errors with their bounds, trajectory, coverage, and with a ``verdict`` the NEES with its band, on one sheet.

    Raises
    ------
    InputError
        The record has neither errors nor NEES.
    """
    record = of_both(record)
    nees = None if verdict is None else _nees(record, verdict)
    found = [figure for figure in (_errors(record), nees, trajectory(record), _coverage(record)) if figure is not None]
    if not found:
        raise InputError(f"{record.name}: has neither errors nor NEES to draw; give --truth, or truth= in Python")
    first, *others = found
    own = (replace(panel, keys=figure.keys) for figure in others for panel in figure.panels)
    panels = (*first.panels, *own)
    columns = columns_of(len(panels))
    return Sheet(panels, 0.3 + 1.6 * -(-len(panels) // columns), columns=columns, keys=first.keys, title=record.name)


# --- errors -----------------------------------------------------------------------------------------


def unit_of(axis: str) -> tuple[str, float]:
    """Unit that a component is shown in, and the factor to it; none where it is not known."""
    if axis in ANGLES:
        return "deg", 180.0 / np.pi
    return ("m" if axis in METRES else DERIVED.get(axis[:-1], "") if axis[-1:] in METRES else "", 1.0)


def _errors(record: Record) -> Figure | None:
    """Error of each component of one run with its 2-sigma bounds, as fig. 2b of Herath et al. (2007)."""
    if record.error is None or record.covariance is None:
        return None
    if has_one_step(record):
        units = [unit_of(name) for name in record.axes[:MOST_PANELS]]
        return errors_of_runs(record, units)
    clock, row = clock_of(record.t), shown_run(record)
    others = [i for i in np.linspace(0, len(record.run_numbers) - 1, MOST_RUNS + 1).astype(int) if i != row]
    names = record.axes[:MOST_PANELS]
    panels = tuple(_error_panel(record, clock, row, list(dict.fromkeys(others)), i) for i in range(len(names)))
    keys = [
        Key(f"run {record.run_numbers[row]}", SHOWN),
        Key("2-sigma bounds", replace(SHOWN, dash=(4.0, 3.0), width=0.8)),
    ]
    keys += [Key("other runs", OTHERS)] if others else []
    meaning = "truth minus estimate" if record.window is None else f"of the motion over each window of {record.window}"
    caption = (
        f"Error ({meaning}) of run {record.run_numbers[row]} with the 2-sigma bounds that the estimator "
        "states (dashed). Honest errors stay inside about 95 % of the time."
    )
    figure = figure_of_errors(record, caption, panels, tuple(keys))
    return replace(figure, caption=figure.caption + clock.note)


def _error_panel(record: Record, clock: Clock, row: int, others: list[int], i: int) -> Panel:
    assert record.error is not None
    assert record.covariance is not None
    name = record.axes[i]
    unit, factor = unit_of(name)
    error = factor * record.error[..., i]
    bound = SIGMAS * factor * np.sqrt(np.maximum(record.covariance[row, :, i, i], 0.0))
    tips = ((clock.word, "@x"), ("error", f"@y{{0.0000}} {unit}"), ("2 sigma", f"@bound{{0.0000}} {unit}"))
    marks: list[Mark] = [Line(clock.values, error[k], OTHERS) for k in others]
    marks += [Rule("y", 0.0, ZERO), Line(clock.values, error[row], SHOWN, tips=tips, bound=bound)]
    label = f"{name} ({unit})" if unit else name
    alt = f"Error of {name} of {record.name} with 2-sigma bounds"
    return Panel(clock.axis, Axis(label), tuple(marks), alt, height=220)


# --- NEES -------------------------------------------------------------------------------------------


def _nees(record: Record, verdict: Verdict) -> Figure | None:
    """NEES of one run, or its average over runs, with the bands of a right estimator."""
    scale, location = verdict.scale, verdict.location
    if record.parts:  # of the whole no distribution is known
        return None
    if record.independent:
        return _nees_of_windows(record)
    if has_one_step(record):
        return nees_of_runs(record)
    if scale is None or len(scale.anees) != len(record.t):
        return None
    clock, single = clock_of(record.t), verdict.runs == 1
    name = "NEES" if single else f"NEES, average of {verdict.runs} runs"
    marks: list[Mark] = [Band(clock.values, *xy(scale.band), SHADE)]
    keys = [Key("95 % band of one step", SHADE, "band")]
    curves = [scale.anees, scale.band]
    if location is not None and np.isfinite(location.simultaneous).any():
        marks.append(Band(clock.values, *xy(location.simultaneous), LIMIT, outline=True))
        keys.append(Key("band of all steps at once", LIMIT))
        curves.append(location.simultaneous)
    tips = ((clock.word, "@x"), (name, "@y{0.000}"))
    marks += [Rule("y", float(scale.dof), EXPECTED), Line(clock.values, scale.anees, SHOWN, tips=tips)]
    keys += [Key("expected", EXPECTED), Key(record.name, SHOWN)]
    caption = (
        f"{name}; {scale.dof} is expected (line). Above is overconfident, below conservative. Shaded: where one step "
        f"of a right estimator lies with 95 %, which is not judged.{clock.note}"
    )
    panel = Panel(clock.axis, Axis("NEES", log=wide(curves)), tuple(marks), f"{name} of {record.name}", height=300)
    return Figure("NEES", caption, (panel,), (Sheet((panel,), 2.2, keys=tuple(keys)),), tuple(keys))


def _nees_of_windows(record: Record) -> Figure | None:
    """NEES of each window, independent of the others."""
    if record.nees is None or not np.isfinite(record.nees).any():
        return None
    clock, window = clock_of(record.t), record.window or "a step"
    low, high = (np.full(len(record.t), distributions.chi2.ppf(q, record.dof)) for q in (0.025, 0.975))
    tips = ((clock.word, "@x"), ("NEES", "@y{0.000}"))
    marks: list[Mark] = [Band(clock.values, low, high, SHADE), Rule("y", float(record.dof), EXPECTED)]
    marks += [Points(clock.values, values, replace(style(0), size=3.0, alpha=0.7), tips=tips) for values in record.nees]
    keys = (Key("95 % band of one window", SHADE, "band"), Key("expected", EXPECTED))
    caption = (
        f"NEES of the motion over each window of {window}; {record.dof} is expected (line). Above is overconfident, "
        "below conservative. Shaded: where 95 % of the windows of a right estimator lie, which is not judged."
        f"{clock.note}"
    )
    panel = Panel(
        clock.axis, Axis("NEES", log=wide([record.nees.ravel()])), tuple(marks), f"NEES of windows of {record.name}",
        height=300,
    )  # fmt: skip
    return Figure("NEES", caption, (panel,), (Sheet((panel,), 2.2, keys=keys),), keys)


# --- coverage ---------------------------------------------------------------------------------------


def observed_coverage(record: Record, p: Array) -> dict[str, Array]:
    """Share of errors inside the interval that should hold them with probability ``p`` (N,), by component and jointly.

    Of all steps of all runs; -> (N,) each.
    """
    found: dict[str, Array] = {}
    if record.error is not None and record.covariance is not None:
        sigma = np.sqrt(np.diagonal(record.covariance, axis1=-2, axis2=-1))
        with np.errstate(invalid="ignore", divide="ignore"):
            z = np.abs(record.error) / sigma
        for i, name in enumerate(record.axes[:MOST_PANELS]):
            found[name] = _shares(z[..., i], np.sqrt(2.0) * special.erfinv(p))
    if record.nees is not None and record.dof and not record.parts:
        found["all together"] = _shares(record.nees, distributions.chi2.ppf(p, record.dof))
    return {name: shares for name, shares in found.items() if np.isfinite(shares).any()}


def _shares(values: Array, limits: Array) -> Array:
    known = np.sort(values[np.isfinite(values)])
    return np.searchsorted(known, limits, side="right") / len(known) if len(known) else np.full(len(limits), np.nan)


def _coverage(record: Record) -> Figure | None:
    """Share of errors within an interval against the probability that it should hold them with."""
    p = np.linspace(0.0, 0.999, 200)
    found = observed_coverage(record, p)
    if not found:
        return None
    looks = [replace(style(i), width=1.1) for i in range(len(found))]
    looks[-1] = JOINT if "all together" in found else looks[-1]
    tips = (("stated", "@x{0.000}"), ("observed", "@y{0.000}"))
    lines = [Line(p, shares, look, tips=tips) for shares, look in zip(found.values(), looks, strict=True)]
    diagonal = Line(np.array([0.0, 1.0]), np.array([0.0, 1.0]), EXPECTED)
    window = (-0.02, 1.02)
    panel = Panel(
        Axis("stated probability", window=window), Axis("share of errors inside", window=window), (diagonal, *lines),
        f"Coverage of {record.name}", height=340,
    )  # fmt: skip
    keys = (Key("expected", EXPECTED), *(Key(name, look) for name, look in zip(found, looks, strict=True)))
    caption = (
        "Coverage: share of errors inside the interval that should hold them with the stated probability, over all "
        "steps of all runs. On the diagonal the covariance is right; below it is overconfident, above conservative."
    )
    return Figure("Coverage", caption, (panel,), (Sheet((panel,), 2.0, keys=keys),), keys)


# --- innovations ------------------------------------------------------------------------------------


def _innovations(record: Record, verdict: Verdict) -> Figure | None:
    """NIS over its degrees of freedom, averaged over runs."""
    if record.nis is None or record.nis_dof is None:
        return None
    clock = clock_of(record.t)
    known = np.isfinite(record.nis) & (record.nis_dof > 0)
    dof = np.where(known, record.nis_dof, 0.0).sum(axis=0)
    ratio = np.where(dof > 0, np.where(known, record.nis, 0.0).sum(axis=0) / np.maximum(dof, 1.0), np.nan)
    low, high = (distributions.chi2.ppf(q, np.maximum(dof, 1.0)) / np.maximum(dof, 1.0) for q in (0.025, 0.975))
    marks = (
        Band(clock.values, np.where(dof > 0, low, np.nan), np.where(dof > 0, high, np.nan), SHADE),
        Rule("y", 1.0, EXPECTED),
        Points(clock.values, ratio, replace(style(0), size=2.0, alpha=0.7)),
    )
    judged = verdict.innovations is not None and verdict.innovations.judged
    caption = (
        "NIS over its degrees of freedom; 1 is expected (line). Shaded: where one step of white innovations lies with "
        f"95 %.{'' if judged else ' Reported, not judged: no optimal gain is declared.'}{clock.note}"
    )
    y = Axis("NIS / dof", log=wide([ratio]))
    panel = Panel(clock.axis, y, marks, f"NIS over degrees of freedom of {record.name}", height=240)
    keys = (Key("95 % band of one step", SHADE, "band"), Key("expected", EXPECTED))
    return Figure("Innovations", caption, (panel,), (Sheet((panel,), 1.8, keys=keys),), keys)
