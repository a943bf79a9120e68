"""Verdicts and findings as tables on a terminal and as JSON."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table as RichTable

from consistency.bench.types import Finding, outcome
from consistency.referee.diagnostics import Interval, MapScore, Verdict
from consistency.referee.diagnostics.export import map_text, rejection_text
from consistency.referee.diagnostics.monitor import CAVEAT, accepted_scales
from consistency.referee.diagnostics.wording import percent, short
from consistency.referee.diagnostics.wording import plain as ratio_text
from consistency.referee.geometry.conventions import ADDITIVE, PLANAR
from consistency.referee.system.provenance import plain
from consistency.referee.verdicts.comparison import Compared
from consistency.referee.verdicts.monitoring import Watched

COLOURS = {
    "consistent": "green", "overconfident": "red", "conservative": "yellow", "biased": "red", "heavy-tailed": "red",
    "inconsistent": "red", "failed": "red", "undecided": "yellow",
    "reproduced": "green", "not reproduced": "yellow", "refuted": "red", "holds": "green",
    "does not hold": "yellow",
}  # fmt: skip


def open_console() -> Console:
    """Standard output: coloured on a terminal, plain and wide elsewhere."""
    # pipes and files get plain wide lines, so that nothing is cut
    return Console(file=sys.stdout, width=None if sys.stdout.isatty() else 160, highlight=False)


def print_verdicts(verdicts: dict[str, Verdict], reasons: bool = False) -> None:
    """Print a row for each filter; with ``reasons`` also why. ``ratio``: true over stated covariance, 95 % interval.

    A filter that is judged in an error of its own has a second row, in the additive error of the world. Scores of maps
    stand in a line below the table.
    """
    table = RichTable(box=None, pad_edge=False)
    own = any(verdict.world is not None for verdict in verdicts.values())
    columns = (
        "filter", *["error"] * own, "verdict", "ANEES", "ratio", "RMSE m", "RMSE deg", "NIS/dof", "failed",
    )  # fmt: skip
    for column in columns:
        table.add_column(column, justify="left" if column in ("filter", "error", "verdict") else "right")
    for name, verdict in verdicts.items():
        of = (verdict.convention or ADDITIVE) if verdict.world is not None else ADDITIVE
        table.add_row(escape(name), *[of] * own, *_cells(verdict))
        if verdict.world is not None:
            status, anees, ratio, *_ = _cells(verdict.world)
            table.add_row("", f"{ADDITIVE}, beside it", status, anees, ratio)
    console = open_console()
    console.print(table)
    for line in _below(verdicts):
        console.print(line, markup=False, soft_wrap=not console.is_terminal)
    if reasons:
        for name, verdict in verdicts.items():
            first, *rest = verdict.reasons
            console.print(f"\n{name} is {first}", markup=False, soft_wrap=not console.is_terminal)
            for reason in rest:
                console.print(f"  - {reason}", markup=False, soft_wrap=not console.is_terminal)


def _cells(verdict: Verdict) -> list[str]:
    """Verdict, ANEES, ratio, RMSE of position and heading in the world, NIS over dof, and failures."""
    scale, accuracy, innovations = verdict.scale, verdict.in_world.accuracy, verdict.innovations
    colour = COLOURS[verdict.status]
    return [
        f"[{colour}]{verdict.status}[/{colour}]{' (NIS only)' if scale is None else ''}",
        _number(scale.mean_anees if scale else None, ".2f"),
        _interval(scale.inflation) if scale else "-",
        _number(accuracy.rmse_position if accuracy else None, ".3f"),
        _number(np.rad2deg(accuracy.rmse_heading) if accuracy else None, ".2f"),
        _number(innovations.ratio if innovations else None, ".3f"),
        f"{len(verdict.failures)} of {verdict.runs}",
    ]


def _below(verdicts: dict[str, Verdict]) -> list[str]:
    """What the errors are, where filters have some of their own; then the maps, and what guards rejected."""
    lines = []
    if errors := list(dict.fromkeys(v.convention for v in verdicts.values() if v.world is not None and v.convention)):
        texts = "; ".join(f"{error}: {PLANAR[error]}" for error in (*errors, ADDITIVE))
        lines.append(f"error {texts}. Each filter is judged in its own; RMSE is of position and heading in the world.")
    if worst := [(name, *v.worst_axis) for name, v in verdicts.items() if v.worst_axis is not None]:
        texts = "; ".join(f"{name} {axis}, {ratio_text(ratio)}" for name, axis, ratio in worst)
        lines.append(f"ratio of the worst axis: {texts}")
    maps = {name: v.map for name, v in verdicts.items() if v.map is not None and v.map.landmarks}
    if maps:
        judged = "" if any(m.verdict is not None for m in maps.values()) else ", not judged"
        scores = "; ".join(f"{name} {_map_cells(m)}" for name, m in maps.items())
        lines.append(f"map after the last step, mean NEES / 3{judged}: {scores}")
    guarded = {name: v.rejection for name, v in verdicts.items() if v.rejection is not None}
    return lines + [f"{name} rejected {rejection_text(score)}" for name, score in guarded.items()]


def _map_cells(m: MapScore) -> str:
    """NEES of landmarks over 3, and the verdict on the map with the ratio of pose and map together."""
    text = map_text(m)
    if m.verdict is None:
        return text
    joint = m.verdict.joint
    together = "" if joint is None or not joint.runs else f" (together with the pose {short(joint.both.value)})"
    return f"{m.verdict.status}, {text}{together}"


def print_findings(findings: Sequence[Finding]) -> None:
    """Published beside measured, one row a finding."""
    table = RichTable(box=None, pad_edge=False)
    for column in ("finding", "published", "measured", "verdict"):
        table.add_column(column, overflow="fold")
    for finding in findings:
        said = outcome(finding.source, finding.verdict)
        colour = COLOURS[said]
        texts = (escape(text) for text in (finding.id, finding.published, finding.measured))
        table.add_row(*texts, f"[{colour}]{said}[/{colour}]")
    open_console().print(table)


def verdicts_json(verdicts: dict[str, Verdict]) -> str:
    """Status, reasons and statistics by filter; NaN becomes null."""
    data = {
        name: {"status": v.status, "reasons": v.reasons, "statistics": plain(v.statistics)}
        for name, v in verdicts.items()
    }
    return json.dumps(data, indent=2, allow_nan=False)


def print_plan(planned: dict[str, Any]) -> None:
    """Runs that a verdict takes, in two lines."""
    p = planned
    side = "small" if p["detect"] > 1.0 else "large"
    factor = p["detect"] if p["detect"] > 1.0 else 1.0 / p["detect"]
    print(
        f"{p['runs']} runs: a verdict at false alarm {p['false_alarm']:g} then finds a covariance too {side} by "
        f"x{factor:.3g} with power {p['power']:g}"
    )
    if "lost" in p:
        print(f"{p['lost_runs']} runs, none of them lost, show that at most {percent(p['lost'])} of all are")
    print(
        f"{p['one_step']} runs would do for a single chi-square test of one step, at the same rates; "
        f"--until-decided asks everything after {', '.join(map(str, p['looks']))}, ... runs and stops when it is clear"
    )
    for name, like in p.get("like", {}).items():
        print(
            f"{like['runs']} runs do where steps depend on each other as those of {name} in {like['pilot_runs']} pilot "
            f"runs: a run is worth {like['effective_dof']:.3g} degrees of freedom or more, {p['dof']} in the worst case"
        )


def print_comparisons(compared: Sequence[Compared]) -> None:
    """One table a pair: both values, their ratio or difference with its interval, and a sentence."""
    console = open_console()
    for each in compared:
        c = each.comparison
        table = RichTable(box=None, pad_edge=False)
        heads = (each.a, f"{each.b} (reference)") if each.a != each.b else ("now", "reference")
        for column in ("", *heads, "ratio", "difference", "95 % interval"):
            table.add_column(escape(column), justify="left" if not column else "right")
        for d in c.differences:
            share = "coverage" in d.name
            values = (f"{100 * v:.1f} %" if share else f"{v:.3g}" for v in (d.a, d.b))
            ratio = "" if share else f"x{d.difference:.3g}"
            gap = f"{100 * d.difference:+.1f} %" if share else ""
            ends = f"{100 * d.low:+.1f} to {100 * d.high:+.1f} %" if share else f"{d.low:.3g} to {d.high:.3g}"
            table.add_row(d.name, *values, ratio, gap, ends)
        console.print(table)
        console.print(each.sentence + "\n", markup=False, soft_wrap=not console.is_terminal)


def comparisons_json(compared: Sequence[Compared]) -> str:
    """Every pair with its differences; NaN becomes null."""
    data = [
        {"a": each.a, "b": each.b, "worse": each.worse, "sentence": each.sentence, "failures": each.failures}
        | {key: plain(value) for key, value in asdict(each.comparison).items()}
        for each in compared
    ]
    return json.dumps(data, indent=2, allow_nan=False)


def print_watched(watched: Watched) -> None:
    """What the monitor said of a run: one row of numbers and a sentence."""
    monitor = watched.monitor
    gated = monitor.gate is not None
    table = RichTable(box=None, pad_edge=False)
    heads = ["innovations", "steps", "judged", *["rejected"] * gated, "NIS/dof", *["scale"] * gated]
    for column in (*heads, "e-value", "largest", "alarm at"):
        table.add_column(column, justify="left" if column == "innovations" else "right")
    cells = [escape(watched.name), f"{monitor.steps}", f"{monitor.innovations}", *[f"{monitor.rejections}"] * gated]
    cells += [_number(monitor.ratio, ".3f"), *[_number(monitor.scale, ".3f")] * gated]
    table.add_row(
        *cells, *(f"{value:.3g}" for value in (monitor.evidence, monitor.largest)), f"{monitor.threshold:.4g}"
    )
    console = open_console()
    console.print(table)
    console.print(f"\n{_sentence(watched)}", markup=False, soft_wrap=not console.is_terminal)


def _sentence(watched: Watched) -> str:
    monitor = watched.monitor
    if watched.alarm is None:
        sentence = f"no alarm: no evidence that the NIS is off ({accepted_scales(monitor.tolerance)}). {CAVEAT}."
    else:
        sentence = str(watched.alarm)
        if np.isfinite(watched.alarm_t):
            sentence += f" Alarm at t = {watched.alarm_t:.10g} s, since t = {watched.since_t:.10g} s."
    if monitor.gate is not None and monitor.rejections:
        sentence += (
            f" The gate rejected {100 * monitor.rejections / monitor.measurements:.2g} % of the measurements "
            f"(designed for {100 * (1 - monitor.gate):.2g} %), which is not judged."
        )
    return sentence


def watched_json(watched: Watched) -> str:
    """What the monitor said of a run; NaN and infinity become null."""
    monitor, alarm = watched.monitor, watched.alarm
    data = {
        "innovations": watched.name, "steps": monitor.steps, "measurements": monitor.measurements,
        "rejected": monitor.rejections, "judged": monitor.innovations, "nis_ratio": monitor.ratio,
        "scale": monitor.scale, "evidence": monitor.evidence, "largest_evidence": monitor.largest,
        "threshold": monitor.threshold, "false_alarm": monitor.false_alarm, "tolerance": monitor.tolerance,
        "gate": monitor.gate, "mission": monitor.mission, "note": CAVEAT,
        "alarm": None if alarm is None else {
            "step": alarm.step, "since": alarm.since, "t": watched.alarm_t, "since_t": watched.since_t,
            "direction": alarm.direction, "evidence": alarm.evidence, "scale": alarm.scale, "sentence": str(alarm),
        },
    }  # fmt: skip
    return json.dumps(plain(data), indent=2, allow_nan=False)


def _interval(interval: Interval) -> str:
    if not np.isfinite(interval.value):
        return "-"
    return escape(f"{short(interval.value)} [{short(interval.low)}, {short(interval.high)}]")


def _number(value: Any, form: str) -> str:
    return "-" if value is None or not np.isfinite(value) else format(value, form)
