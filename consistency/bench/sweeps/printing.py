"""A map, and advice from it, on a terminal and as JSON."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from consistency.bench.sweeps.cell import CellResult, plain_numbers
from consistency.bench.sweeps.plan import values_of
from consistency.bench.sweeps.recommend import Advice, MapPlace, NearFilter
from consistency.bench.sweeps.regime import Regime
from consistency.bench.sweeps.rig import AxisPlace
from consistency.referee.diagnostics.verdict.as_dictionary import plain
from consistency.referee.diagnostics.verdict.parts import STATUSES
from consistency.referee.diagnostics.words.sentences import plural, short
from consistency.referee.document.blocks import Block, Cell, Column, Quantity, Status, Table, Text, table
from consistency.referee.document.wording import NONE

MOST_CELLS = 48  # for a table of all cells on a terminal; map.csv has any number
WIDEST = 36  # characters of a value in it
OF_ADVICE = (
    *map(Column, ("filter", "there")),
    *(Column(head, number=True) for head in ("cells around", "RMSE m", "RMSE deg", "cost")),
    Column("runs here"),
)


def by_verdict(regime: Regime) -> tuple[list[str], list[tuple[Cell, ...]]]:
    """Statuses that occur; for each filter its name, the number of cells with each, and the median cost."""
    by_filter = {name: [r for (_, n), r in regime.results.items() if n == name] for name in regime.sweep.filters}
    counts = {name: Counter(r.status for r in results) for name, results in by_filter.items()}
    statuses = [status for status in STATUSES if any(count[status] for count in counts.values())]
    rows: list[tuple[Cell, ...]] = []
    for name, results in by_filter.items():
        costs = [r.cost for r in results if np.isfinite(r.cost)]
        cost = f"×{np.median(costs):.2g}" if costs else NONE
        rows.append((name, *(str(counts[name][status]) for status in statuses), cost))
    return statuses, rows


def regime_blocks(regime: Regime) -> tuple[Block, ...]:
    """A row for each filter, number of cells by verdict and the cost of a step; then the cells, if they are few."""
    statuses, rows = by_verdict(regime)
    heads = (Column("filter"), *(Column(head, number=True) for head in (*statuses, "cost")))
    blocks: list[Block] = [table(heads, rows, "Cells by verdict")]
    cells = regime.sweep.cells
    if len(cells) <= MOST_CELLS:
        blocks += [Text(""), _cells_table(regime), Text("verdict, and ratio of true to stated covariance")]
    lines = [f"{len(cells)} cells; cost: CPU time of a step against {regime.sweep.reference}, median over the cells"]
    if alone := sum(bool(regime.trusted(cell)) for cell in cells):
        lines.append(f"in {alone} of {len(cells)} cells some filter is consistent")
    if regime.missing:
        lines.append(f"{regime.missing} of {len(cells) * len(regime.sweep.filters)} are not there yet")
    return *blocks, *map(Text, lines)


def _cells_table(regime: Regime) -> Table:
    """A row for each cell: its values, and the verdict and covariance ratio of each filter."""
    sweep = regime.sweep
    axes = [axis for axis in sweep.grid if len(axis.values) > 1] or list(sweep.grid)
    columns = (
        *(Column(axis.key.rpartition(".")[2], number=axis.numeric, most=WIDEST) for axis in axes),
        *((Column("otherwise", most=WIDEST),) if sweep.alone else ()),
        *map(Column, sweep.filters),
    )
    rows: list[tuple[Cell, ...]] = []
    for cell in sweep.cells:
        found = regime.at(cell)
        rows.append((*values_of(sweep, axes, cell), *(_verdict(found.get(name)) for name in sweep.filters)))
    return table(columns, rows, "Cells")


def _verdict(result: CellResult | None) -> Cell:
    if result is None:
        return "-"
    ratio = "" if np.isnan(result.ratio) else f" {'∞' if np.isinf(result.ratio) else short(result.ratio)}"
    return Status(result.status, ratio)


# --- advice -----------------------------------------------------------------------------------------


def advice_blocks(advice: Advice) -> tuple[Block, ...]:
    """Where the rig lies, a row a filter, and the answer in sentences."""
    first = [f"{advice.rig.name}: {'; '.join(place.text for place in advice.here.places)}"]
    first += [f"  {note}" for note in notes_of(advice)]
    first.append(f"nearest cell of the map: {advice.here.nearest.text}")
    if advice.beyond is not None:
        first.append(f"and of the map of single axes: {advice.beyond.nearest.text}")
    rows = [_row(candidate) for candidate in advice.candidates]
    return *map(Text, first), table(OF_ADVICE, rows, "Filters"), Text(""), *map(Text, sentences_of(advice))


def _row(c: NearFilter) -> tuple[Cell, ...]:
    near = c.nearest
    there = near if c.beyond is None or near.status != "consistent" else c.beyond  # of the map that does not agree
    said = "not run" if c.verdict is None else Status(c.verdict.status)
    return (
        c.filter, Status(there.status), f"{c.agreeing} of {c.around}", Quantity(near.rmse_position, digits=".3f"),
        Quantity(np.rad2deg(near.rmse_heading), digits=".2f"), f"×{near.cost:.2g}" if np.isfinite(near.cost) else "-",
        said,
    )  # fmt: skip


def notes_of(advice: Advice) -> list[str]:
    """What was assumed, counted otherwise, or is not on the map."""
    notes = []
    if advice.equivalent is not None:
        own, counted = advice.equivalent
        notes.append(
            f"its baseline of {own:.3g} m counts as {counted:.3g} m, which makes depths as exact with the map's camera"
        )
    if advice.rig.assumed:
        notes.append(f"taken from the map: {', '.join(advice.rig.assumed)}")
    if advice.unlike:
        notes.append(f"no cell of the map is like the rig in: {', '.join(advice.unlike)}")
    if advice.lacking and advice.best is not None:
        notes.append(f"its sweep is not finished: the nearest cell lacks {', '.join(advice.lacking)}")
    return notes


def sentences_of(advice: Advice) -> list[str]:
    """The answer, how sure it is, and why."""
    best = advice.best
    if best is None:
        if contradicted := [c for c in advice.candidates if c.sure == "no"]:
            names = ", ".join(f"{c.filter} ({c.verdict.status})" for c in contradicted if c.verdict is not None)
            more = f" Not run: {', '.join(advice.untried)} (--confirm)." if advice.untried else ""
            found = f"the map has one, but {plural(advice.runs, 'run')} of this rig find: {names}"
            return [f"No filter to trust: {found}.{more}"]
        if advice.lacking:
            there, sweep = ", ".join(c.filter for c in advice.candidates), advice.here.regime.sweep
            return [
                f"No answer yet: of {advice.here.nearest.text} the map lacks {', '.join(advice.lacking)}. Of those "
                f"there ({there}) none is consistent. {advice.here.regime.missing} of its "
                f"{len(sweep.cells) * len(sweep.filters)} results are missing; finish the sweep: the same "
                "'consistency sweep' goes on."
            ]
        where = f" Nearest cell where one is consistent: {advice.elsewhere}." if advice.elsewhere else ""
        return [f"No filter of the map is consistent near this rig.{where}"]
    return [
        f"Take {best.filter}: {best.sure}. {_why(advice, best)}",
        *([_confirmed(advice, best)] if best.verdict is not None else []),
        *(_contradiction(advice, c) for c in advice.candidates if c.sure == "no"),
    ]


def _why(advice: Advice, best: NearFilter) -> str:
    maps = "map" if advice.beyond is None else "maps"
    inside = f"The rig lies inside the {maps}" if advice.inside else f"The rig lies outside the {maps}: a hint only"
    cells = f"all {best.around}" if best.agreeing == best.around else f"{best.agreeing} of the {best.around}"
    where = f"{cells} cells around it" if best.around > 1 else "the cell where it lies"
    unlike = "; no cell is as the rig is" if advice.unlike else ""
    alone = " By the map alone: the filter was not run on this rig." if best.verdict is None else ""
    return f"{inside}{unlike}; the filter is consistent in {where}.{alone}"


def _confirmed(advice: Advice, best: NearFilter) -> str:
    """What the confirming runs said, and what they could have missed."""
    assert best.verdict is not None
    rule = advice.here.regime.sweep.rule
    rate = 100.0 * rule.false_alarm
    ratio, (low, high) = best.verdict.inflation, best.verdict.inflation_interval
    runs = plural(advice.runs, "run")
    shown = "show it consistent" if best.verdict.status == "consistent" else "find no fault, and do not decide"
    found = f"{runs} of this rig {shown} (a right filter would fail in {rate:g} %)"
    scale = f"the ratio of true to stated covariance is {short(ratio)} [{short(low)}, {short(high)}]"
    power = f"a covariance too small by ×{short(best.detectable)} would have been found with probability {rule.power:g}"
    return f"{found}; {scale}; {power}."


def _contradiction(advice: Advice, c: NearFilter) -> str:
    assert c.verdict is not None
    runs = plural(advice.runs, "run")
    return f"Not {c.filter}: consistent on the map, but {runs} of this rig say {c.verdict.reasons[0]}."


def advice_json(advice: Advice) -> dict[str, Any]:
    """The advice for programs; NaN becomes null."""
    best = advice.best
    return {
        "rig": advice.rig.name, "map": advice.here.regime.sweep.name, "inside": advice.inside,
        "take": None if best is None else best.filter, "sure": None if best is None else best.sure,
        "answer": sentences_of(advice), "notes": notes_of(advice), "nearest_cell": advice.here.nearest.text,
        "axes": _axes_json(advice.here.places), "beyond": _beyond_json(advice.beyond),
        "runs": advice.runs,
        "filters": [
            {"filter": c.filter, "sure": c.sure or None, "cells_around": c.around, "agreeing": c.agreeing}
            | {"nearest": plain_numbers(c.nearest)}
            | {"beyond": None if c.beyond is None else plain_numbers(c.beyond)}
            | {"confirmed": None if c.verdict is None else _verdict_json(c)}
            for c in advice.candidates
        ],
    }  # fmt: skip


def _axes_json(places: Sequence[AxisPlace]) -> dict[str, Any]:
    return {place.axis.key: {"value": plain(place.value), "inside": place.inside} for place in places}


def _beyond_json(beyond: MapPlace | None) -> dict[str, Any] | None:
    """The place in the second map, where that is looked at."""
    if beyond is None:
        return None
    name, near = beyond.regime.sweep.name, beyond.nearest.text
    return {"map": name, "nearest_cell": near, "axes": _axes_json(beyond.places)}


def _verdict_json(c: NearFilter) -> dict[str, Any]:
    assert c.verdict is not None
    numbers = {"inflation": c.verdict.inflation, "interval": c.verdict.inflation_interval, "detectable": c.detectable}
    return {"status": c.verdict.status, "reason": c.verdict.reasons[0]} | {k: plain(v) for k, v in numbers.items()}
