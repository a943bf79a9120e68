"""Verdicts, maps, guards, comparisons and plans in rows and columns.

This module alone decides which figures stand where, in which order, and what they are called. Every place that shows
verdicts takes them from here: terminal, reports, notebooks, static pages. What a view shows is a tuple of
:class:`Measure`; to show another figure, write its function and put it into the views that have room for it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from consistency.referee.diagnostics.number_words import (
    UNCERTAIN,
    p_text,
    percent,
    plural,
    ratio_text,
    short,
    since_text,
    with_subject,
)
from consistency.referee.diagnostics.sentences import question_text
from consistency.referee.diagnostics.status import axis_at_fault
from consistency.referee.diagnostics.verdict import MapScore, Verdict
from consistency.referee.diagnostics.verdict_parts import REGIONS, Interval, RejectionScore
from consistency.referee.geometry import ADDITIVE, PLANAR
from consistency.referee.show.blocks import (
    NONE,
    PLAIN,
    Block,
    Cell,
    Column,
    Document,
    Facts,
    Quantity,
    Reason,
    Reasons,
    Status,
    Table,
    Text,
    brief,
    number,
    table,
    written,
)

if TYPE_CHECKING:
    from consistency.referee.diagnostics.comparison import Comparison, Difference
    from consistency.referee.show.blocks import Look

FILTER = Column("Filter")
IN_WORLD = 3  # of these are shown of the additive error, too
UNITS = dict.fromkeys(("RMSE x", "RMSE y", "RMSE z"), " (m)")
UNITS |= dict.fromkeys(("RMSE heading", "RMSE roll", "RMSE pitch", "RMSE yaw"), " (rad)")
MAP_COLUMNS = (
    Column("Verdict on the map", "Verdict on\nthe map", width="1.2fr"),
    Column("Mean NEES / 3 of landmarks", "Mean NEES / 3\nof landmarks", number=True),
    Column("Pose and map together, NEES / dof", "Pose and map\ntogether", number=True),
    Column("Map given the pose, NEES / dof", "Map given\nthe pose", number=True),
    Column("Runs", number=True),
    Column("Landmarks", number=True),
    Column("Landmarks left out", "Landmarks\nleft out", number=True),
)
REGION_COLUMNS = (
    Column("of the steps, %", width="2fr"),
    *(Column(head, number=True) for head in ("alert limit", *REGIONS)),
)
REJECTION_COLUMNS = (
    Column("Observations", number=True),
    Column("Spurious", number=True),
    Column("Rejected", number=True),
    Column("Precision, %", number=True),
    Column("Recall, %", number=True),
    Column("Right ones rejected, %", "Right ones\nrejected, %", number=True),
)


class Measure(NamedTuple):
    """A figure of a verdict: its column, and its cell."""

    column: Column
    cell: Callable[[Verdict], Cell]


def cells(view: Iterable[Measure], verdict: Verdict) -> tuple[Cell, ...]:
    """Cells of a row."""
    return tuple(measure.cell(verdict) for measure in view)


def columns(view: Iterable[Measure]) -> tuple[Column, ...]:
    """Heads of the columns."""
    return tuple(measure.column for measure in view)


def known_measures(view: Sequence[Measure], verdicts: Sequence[Verdict]) -> tuple[Measure, ...]:
    """The measures that any of the verdicts has a value of."""

    def has_value(cell: Cell) -> bool:
        return not isinstance(cell, Quantity) or not cell.is_empty

    return tuple(m for m in view if any(has_value(m.cell(v)) for v in verdicts))


# --- figures and views ------------------------------------------------------------------------------


def _mean_anees(v: Verdict, digits: str = "") -> Quantity:
    return Quantity(v.scale.mean_anees if v.scale else None, digits=digits)


def factor(v: Verdict) -> Quantity:
    """Ratio of true to stated covariance of the whole, which makes the stated covariance that of the errors."""
    return Quantity(v.inflation, v.inflation_interval, limit=UNCERTAIN, is_factor=True)


def true_over_stated(v: Verdict, whole: Quantity) -> Cell:
    """Ratio of true to stated covariance: of the axis that decides with its name, or of the whole; factor of bounds."""
    if v.bounds:
        from consistency.referee.diagnostics.bound_words import deciding, factor_text

        one = deciding(v.bounds)
        return f"{factor_text(one.factor)} in {one.name}"
    if v.status == "biased" and v.bias is not None and v.bias.inflation_without is not None:
        return f"{ratio_text(v.bias.inflation_without)} about the mean"
    return whole if v.axis is None else f"{ratio_text(v.axis[1])} in {v.axis[0]}"


def shown_inside(v: Verdict) -> Cell:
    """Whether the ratio of true to stated covariance was shown to lie where it should."""
    shown = v.equivalence
    if shown is None or not np.isfinite(shown.p_value):
        return NONE
    return "yes" if shown.shown else "no"


def _rmse_position(v: Verdict) -> Quantity:
    return Quantity(v.in_world.accuracy.rmse_position if v.in_world.accuracy else None, digits=".3f")


def _rmse_heading(v: Verdict) -> Quantity:
    accuracy = v.in_world.accuracy
    return Quantity(np.rad2deg(accuracy.rmse_heading) if accuracy else None, digits=".2f")


def _nis(v: Verdict, is_aside: bool = False) -> Quantity:
    """NIS per degree of freedom, in parentheses where it is not judged."""
    return Quantity(v.innovations.ratio if v.innovations else None, digits=".3f", is_aside=is_aside)


def _nis_expected(v: Verdict) -> Cell:
    if v.innovations is None or not np.isfinite(v.innovations.ratio):
        return NONE
    expected = " to ".join(number(end, ".3f") for end in v.innovations.interval)
    return f"{v.innovations.ratio:.3f} ({expected if v.innovations.judged else 'not judged'})"


def _coverage(v: Verdict) -> Cell:
    shares = np.empty(0) if v.accuracy is None else v.accuracy.coverage
    return " / ".join(number(100 * share, ".1f") for share in shares) if np.isfinite(shares).any() else NONE


def _worst_axis(v: Verdict) -> Cell:
    worst = axis_at_fault(v.worst_axis)
    return NONE if worst is None else f"{worst[0]}, {ratio_text(worst[1])}"


def _failed(v: Verdict) -> Cell:
    return f"{len(v.failures)} of {v.runs}"


BRIEF = (
    Measure(Column("Verdict"), lambda v: Status(v.status)),
    Measure(Column("Mean ANEES", "Mean\nANEES", number=True), _mean_anees),
    Measure(
        Column("True / stated covariance", "True / stated\ncovariance", number=True),
        lambda v: true_over_stated(v, factor(v)),
    ),
)
TERMINAL = (
    Measure(Column("verdict"), lambda v: Status(v.status, " (NIS only)" if v.scale is None and not v.bounds else "")),
    Measure(Column("ANEES", number=True), lambda v: _mean_anees(v, ".2f")),
    Measure(
        Column("true / stated", number=True),
        lambda v: true_over_stated(v, Quantity(v.inflation, v.inflation_interval, limit=UNCERTAIN)),
    ),
    Measure(Column("RMSE m", number=True), _rmse_position),
    Measure(Column("RMSE deg", number=True), _rmse_heading),
    Measure(Column("NIS/dof", number=True), _nis),
    Measure(Column("failed", number=True), _failed),
)
FURTHER = (
    Measure(
        Column("Mean ANEES accepted", "Mean ANEES\naccepted", number=True),
        lambda v: " to ".join(map(brief, v.scale.accepted)) if v.scale and np.isfinite(v.scale.accepted[0]) else NONE,
    ),
    Measure(
        Column("Covariance ratio that would be found", "Ratio that\nwould be found", number=True),
        lambda v: Quantity(v.scale.detectable if v.scale else None, digits=".2g", is_factor=True),
    ),
    Measure(Column("2-sigma coverage, all steps (%)", "Coverage 2σ (%)\nall steps", number=True), _coverage),
    Measure(
        Column("Noncredibility (dB)", "Noncredi-\nbility (dB)", number=True),
        lambda v: Quantity(v.accuracy.nci if v.accuracy else None, digits=".1f"),
    ),
    Measure(
        Column("Inclination (dB)", "Incli-\nnation (dB)", number=True),
        lambda v: Quantity(v.accuracy.inclination if v.accuracy else None, digits="+.1f"),
    ),
    Measure(Column("NIS / dof (95 % expected)", "NIS / dof\n(95 % expected)", number=True), _nis_expected),
)


def page(inside: str) -> tuple[Measure, ...]:
    """Of a report; ``inside`` is where the ratio of consistent filters is shown to be.

    Factors of bounds stand in a table of their own.
    """
    *first, ratio = BRIEF
    return (
        *first,
        Measure(ratio.column, lambda v: NONE if v.bounds else ratio.cell(v)),
        Measure(Column(f"Shown inside {inside}", f"Shown inside\n{inside}", number=True), shown_inside),
        Measure(Column("Worst axis", "Worst\naxis"), _worst_axis),
        Measure(Column("Mainly"), lambda v: v.subset or NONE),
        Measure(
            Column("Since step", "Since\nstep", number=True),
            lambda v: str(v.location.since) if v.location and v.location.since is not None else NONE,
        ),
        Measure(Column("RMSE position (m)", "RMSE\n(m)", number=True), _rmse_position),
        Measure(Column("RMSE heading (deg)", "RMSE\n(deg)", number=True), _rmse_heading),
        Measure(
            Column("NIS / dof", "NIS\n/ dof", number=True),
            lambda v: _nis(v, is_aside=v.innovations is not None and not v.innovations.judged),
        ),
        Measure(Column("Failed runs", "Failed\nruns", number=True), _failed),
    )


def reason(v: Verdict, name: str = "", look: Look | None = None, verbose: bool = True) -> Reason:
    """The sentence, and the figures behind it; ``verbose`` shows also those that a first reading leaves out."""
    sentence, *others = v.reasons
    if not verbose:
        others = [text for text in others if text not in v.details]
    return Reason(name or v.filter, sentence, tuple(others), look, v.consistent)


# --- one verdict ------------------------------------------------------------------------------------


def summary_blocks(v: Verdict) -> tuple[Block, ...]:
    """The sentence and the figures that matter."""
    return Reasons((replace(reason(v), others=v.causes),)), Facts(tuple(rows(v)))


def rows(v: Verdict) -> list[tuple[str, str]]:
    """The numbers that matter, with their names."""
    size = f" of {plural(v.steps, v.places[:-1])}" if v.unit == "run" else ""
    rows = [("evidence", f"{plural(v.runs, v.unit)}{size}")]
    if v.scale is not None and v.scale.judged_steps:
        s, shown = v.scale, v.scale.equivalence
        accepted = "not judged" if v.parts else f"{' to '.join(map(short, s.accepted))} accepted"
        rows.append(("mean NEES", f"{short(s.mean_anees)} ({s.dof} expected, {accepted})"))
        value, low, high = s.inflation
        where = since_text(v)
        ratio = f"{short(value)} [{short(low)}, {short(high)}], true / stated{where}"
        rows.append(("covariance ratio", ratio))
        if v.axis is not None:
            rows.append(("decided by", f"{v.axis[0]}, {ratio_text(v.axis[1])}"))
        elif (worst := axis_at_fault(v.worst_axis)) is not None:
            rows.append(("worst axis", f"{worst[0]}, {ratio_text(worst[1])}"))
        if s.within is not None:
            rows.append(("within the log", f"{ratio_text(s.within.ratio)}, if errors decorrelate as within it"))
        ends = f"[{short(1 / shown.factor)}, {short(shown.factor)}]"
        of_all = f", in all {v.places}" if where else ""
        rows.append(("shown inside", f"{ends}: {'yes' if shown.shown else 'no'} (p {p_text(shown.p_value)}){of_all}"))
        if v.lost is not None:
            rows.append((f"lost {v.unit}s", f"{v.lost.count} of {v.lost.runs}, at most {percent(v.lost.upper)} of all"))
    for one in v.bounds:
        from consistency.referee.diagnostics.bound_words import factor_text, level_text

        outside = f"outside in {percent(one.rate)} of the steps at {level_text(one.level)}"
        rows.append((one.name, f"factor {factor_text(one.factor)}, {outside}"))
    if v.accuracy is not None and v.axes is not None and np.isfinite(v.accuracy.coverage).any():
        inside = (f"{axis} {100 * c:.1f} %" for axis, c in zip(v.axes.names, v.accuracy.coverage, strict=True))
        rows.append(("2-sigma coverage", ", ".join(inside)))
    if v.innovations is not None and np.isfinite(v.innovations.ratio):
        judged = "" if v.innovations.judged else ", not judged"
        rows.append(("NIS / dof", f"{v.innovations.ratio:.3f}{judged}"))
    if v.joint is not None and v.joint.runs:
        value, low, high = v.joint.both
        rows.append(("pose and map", f"NEES / dof {short(value)} [{short(low)}, {short(high)}]"))
    if v.world is not None:
        rows.insert(0, ("error", f"{v.convention}: {PLANAR[v.convention or ADDITIVE]}"))
        scale = v.world.scale
        mean = f", mean NEES {short(scale.mean_anees)}" if scale is not None and scale.judged_steps else ""
        rows.append(("in the world", f"{v.world.status}{mean} (additive error, '{ADDITIVE}')"))
    if v.map is not None:
        rows.append(("map NEES / 3", f"{map_summary(v.map)}"))
    if v.rejection is not None:
        rows.append(("rejected", rejection_text(v.rejection)))
    rows.append((f"failed {v.unit}s", f"{len({f.run for f in v.failures})} of {v.runs}"))
    faults = [
        f"{question_text(v, a.question)} (p {p_text(a.adjusted)})" for a in v.answers if a.found and not a.tolerated
    ]
    rows.append(("faults", f"{', '.join(faults) or 'none'} of {plural(len(v.answers), 'question')}"))
    return rows


# --- several verdicts -------------------------------------------------------------------------------


def document(verdicts: Mapping[str, Verdict], title: str = "", reasons: bool = True, verbose: bool = False) -> Document:
    """A row for each filter, what goes for all of them below, and with ``reasons`` also why; the data are all numbers.

    ``true / stated``: ratio of the covariances, 95 % interval; of the axis that decides, where one does. A filter that
    is judged in an error of its own has a second row, in the additive error of the world.
    """
    own = any(v.world is not None for v in verdicts.values())
    rows: list[tuple[Cell, ...]] = []
    for name, v in verdicts.items():
        error = (v.convention or ADDITIVE) if v.world is not None else ADDITIVE
        rows.append((name, *[error] * own, *cells(TERMINAL, v)))
        if v.world is not None:
            rows.append(("", f"{ADDITIVE}, beside it", *cells(TERMINAL[:IN_WORLD], v.world)))
    heads = Column("filter"), *[Column("error")] * own, *columns(TERMINAL)
    blocks: list[Block] = [table(heads, rows, "Verdicts"), *map(Text, _below(verdicts))]
    if reasons:
        blocks.append(Reasons(tuple(reason(v, name, verbose=verbose) for name, v in verdicts.items())))
        blocks += region_tables(verdicts)
    return Document(title, "", (), tuple(blocks), dict(verdicts))


def _below(verdicts: Mapping[str, Verdict]) -> list[str]:
    """What the errors are, where filters have some of their own; maps, what guards rejected, the rate of all."""
    lines = []
    if errors := list(dict.fromkeys(v.convention for v in verdicts.values() if v.world is not None and v.convention)):
        texts = "; ".join(f"{error}: {PLANAR[error]}" for error in (*errors, ADDITIVE))
        lines.append(f"error {texts}. Each filter is judged in its own; RMSE is of position and heading in the world.")
    worst = {name: axis for name, v in verdicts.items() if (axis := axis_at_fault(v.worst_axis)) is not None}
    if worst and len(verdicts) > 1:  # the reasons of a single verdict have it
        texts = "; ".join(f"{name} {axis}, {ratio_text(ratio)}" for name, (axis, ratio) in worst.items())
        lines.append(f"ratio of the worst axis: {texts}")
    if maps := {name: v.map for name, v in verdicts.items() if v.map is not None}:
        lines += map_lines(maps)
    if guarded := {name: v.rejection for name, v in verdicts.items() if v.rejection is not None}:
        lines += [f"{name} rejected {rejection_text(score)}" for name, score in guarded.items()]
    if len(verdicts) > 1:
        rates = [v.settings.false_alarm for v in verdicts.values()]
        each, some = f"{max(rates):g}", f"{min(1.0, sum(rates)):.2g}"
        lines.append(f"false alarm {each} holds for each filter; for all {len(rates)} together it is at most {some}")
    return lines


def region_tables(verdicts: Mapping[str, Verdict]) -> list[Block]:
    """Shares of the steps (%) in the regions of the Stanford diagram, a table for each estimator with alert limits."""
    tables: list[Block] = []
    for name, v in verdicts.items():
        rows: list[tuple[Cell, ...]] = [
            (score.name, short(score.alerts.limit), *(Quantity(100.0 * s, digits=".3g") for s in score.alerts.shares))
            for score in v.bounds
            if score.alerts is not None
        ]
        if rows:
            label = f"Regions of the Stanford diagram of {name}"
            tables.append(table(REGION_COLUMNS, rows, label, caption=f"{label}: share of the steps (%)."))
    return tables


def comparison_table(a: str, b: str, c: Comparison) -> Table:
    """Both values of each quantity, their ratio or difference with its interval."""
    heads = (a, f"{b} (reference)") if b not in (a, "the reference") else ("now", "reference")
    numbers = (Column(head, number=True) for head in (*heads, "ratio", "difference", "95 % interval"))
    return table((Column(""), *numbers), [_row(d) for d in c.differences], f"{heads[0]} and {heads[1]}")


def _row(d: Difference) -> tuple[str, ...]:
    if "coverage" in d.name:
        values = (f"{100 * v:.1f} %" for v in (d.a, d.b))
        return d.name, *values, "", f"{100 * d.difference:+.1f} %", f"{100 * d.low:+.1f} to {100 * d.high:+.1f} %"
    name = d.name + UNITS.get(d.name, "")
    return name, f"{d.a:.3g}", f"{d.b:.3g}", f"x{d.difference:.3g}", "", f"{d.low:.3g} to {d.high:.3g}"


def map_cells(m: MapScore) -> tuple[Cell, ...]:
    """Cells of a page, as COLUMNS."""
    joint = None if m.verdict is None else m.verdict.joint
    together = (NONE, NONE) if joint is None or not joint.runs else (_ratio(joint.both), _ratio(joint.map))
    return (
        "not judged" if m.verdict is None else m.verdict.status, _ratio(m.ratio) if m.landmarks else NONE, *together,
        str(m.runs), str(m.landmarks), str(m.left_out),
    )  # fmt: skip


def _ratio(interval: Interval) -> Quantity:
    return Quantity(interval.value, interval[1:])


def map_text(m: MapScore) -> str:
    """Mean NEES over 3 of the landmarks in maps, with its interval."""
    left_out = f" ({m.left_out} of {m.left_out + m.landmarks} landmarks left out)" if m.left_out else ""
    return f"{written(_ratio(m.ratio) if m.landmarks else NONE, PLAIN)}{left_out}"


def map_summary(m: MapScore) -> str:
    """Also the sentence of the verdict on the map."""
    verdict = "not judged" if m.verdict is None else with_subject("the map", m.verdict.reasons[0])
    return f"{map_text(m)}, after the last step; {verdict}"


def map_lines(scores: Mapping[str, MapScore]) -> list[str]:
    """One line on the maps of several filters, with the verdicts on them; none where there is no map."""
    texts, judged = [], ", not judged"
    for name, m in scores.items():
        if not m.landmarks:
            continue
        text = map_text(m)
        if m.verdict is not None:
            judged, joint = "", m.verdict.joint
            together = "" if joint is None or not joint.runs else f" (together with the pose {short(joint.both.value)})"
            text = f"{m.verdict.status}, {text}{together}"
        texts.append(f"{name} {text}")
    return [f"map after the last step, mean NEES / 3{judged}: {'; '.join(texts)}"] if texts else []


def rejection_cells(r: RejectionScore) -> tuple[Cell, ...]:
    """Cells of a page, as COLUMNS."""
    shares = [_percent(share) for share in (r.precision, r.recall)] if r.spurious else [NONE, NONE]
    spurious = str(r.spurious) if r.spurious else NONE
    return str(r.offered), spurious, str(r.rejected), *shares, _percent(r.false_alarms)


def _percent(share: Interval) -> Quantity:
    value, low, high = (100 * end for end in share)
    return Quantity(value, (low, high))


def rejection_text(r: RejectionScore) -> str:
    """What a guard rejected, and where spurious observations are known precision and recall."""
    rejected = f"{r.rejected} of {r.offered} observations"
    if not r.spurious:
        return f"{rejected} ({_percent_text(r.false_alarms)})"
    return (
        f"{rejected}, {r.spurious} of them spurious: precision {_percent_text(r.precision)}, "
        f"recall {_percent_text(r.recall)}, right ones rejected {_percent_text(r.false_alarms)}"
    )


def _percent_text(share: Interval) -> str:
    value, low, high = (f"{100 * end:.3g}" for end in share)
    return f"{value if value != 'nan' else '-'} [{low}, {high}] %"


def bound_plan_lines(planned: dict[str, Any]) -> list[str]:
    """Runs that bounds of a level take, a line for each thing to be shown."""
    from consistency.referee.diagnostics.bound_words import level_text

    p = planned
    level, factor, power = level_text(p["level"]), f"{p['detect']:.3g}", p["power"]
    near = f"between {short(p['detect'] ** -0.5)} and {short(p['detect'] ** 0.5)}"

    def runs(key: str) -> str:
        return "more than a million" if p[key] is None else str(p[key])

    return [
        f"{runs('consistent')} runs show that the factor of a right bound of {level} is {near}, with power {power:g}, "
        "however steps depend on each other",
        f"{runs('small')} runs find a bound too small by x{factor} at false alarm {p['false_alarm']:g} with that power",
        f"{runs('large')} runs find a bound too large by x{factor}",
        f"with fewer than {p['fewest']} runs no bound of {level} is shown to hold or to be too large, as all may stay "
        "inside",
    ]


def plan_lines(planned: dict[str, Any]) -> list[str]:
    """Runs that a verdict takes, a line for each thing to be shown.

    A pilot tells how much its runs spread, and not how skewed they are: its power is that of axes and runs alike.
    """
    p = planned
    side, factor = "small", p["detect"]
    if factor <= 1.0:
        side, factor = "large", 1.0 / factor
    lines = [
        f"{p['runs']} runs: a verdict at false alarm {p['false_alarm']:g} then finds a covariance too {side} by "
        f"x{factor:.3g} with power {p['power']:g}"
    ]
    if "lost" in p:
        lines.append(f"{p['lost_runs']} runs, none of them lost, show that at most {percent(p['lost'])} of all are")
    if "groups" in p:
        lines.append(
            f"{p['group_runs']} runs, {p['runs_in_group']} in each of {p['groups']} groups, find that in one group by "
            f"itself (--by); {p['runs_in_group']} are enough where each run passes through all groups"
        )
    lines.append(
        f"{p['one_step']} runs would do for a single chi-square test of one step, at the same rates; "
        f"--until-decided asks everything after {', '.join(map(str, p['looks']))}, ... runs and stops when it is clear"
    )
    return lines + [
        f"{like['runs']} runs do where steps depend on each other as those of {name} in {like['pilot_runs']} pilot "
        f"runs: a run is worth {like['effective_dof']:.3g} degrees of freedom or more, {p['dof']} in the worst case; "
        f"where some axes or some runs alone are slow, it may take up to {p['runs']}"
        for name, like in p.get("like", {}).items()
    ]
