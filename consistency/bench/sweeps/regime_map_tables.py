"""A map on a terminal."""

from __future__ import annotations

from collections import Counter, defaultdict

import numpy as np

from consistency.bench.sweeps.regime_map import Regime
from consistency.bench.sweeps.run_cell import CellResult
from consistency.bench.sweeps.sweep_file import values_of
from consistency.referee.diagnostics.verdict.parts import STATUSES
from consistency.referee.diagnostics.words.numbers import short
from consistency.referee.document.blocks import Block, Cell, Column, Status, Table, Text, table
from consistency.referee.document.wording import NONE

MOST_CELLS = 48  # for a table of all cells on a terminal; map.csv has any number
WIDEST = 36  # characters of a value in it


def by_verdict(regime: Regime) -> tuple[list[str], list[tuple[Cell, ...]]]:
    """Statuses that occur; for each filter its name, the number of cells with each, and the median cost."""
    counts, costs = Counter[tuple[str, str]](), defaultdict[str, list[float]](list)
    for (_, name), result in regime.results.items():
        counts[name, result.status] += 1
        if np.isfinite(result.cost):
            costs[name].append(result.cost)
    occurring = {status for _, status in counts}
    statuses = [status for status in STATUSES if status in occurring]
    rows: list[tuple[Cell, ...]] = []
    for name in regime.sweep.filters:
        cost = f"×{np.median(costs[name]):.2g}" if costs[name] else NONE
        rows.append((name, *(str(counts[name, status]) for status in statuses), cost))
    return statuses, rows


def regime_blocks(regime: Regime) -> tuple[Block, ...]:
    """A row for each filter, number of cells by verdict and the cost of a step; then the cells, if they are few."""
    statuses, rows = by_verdict(regime)
    heads = [Column("filter")]
    heads += [Column(head, number=True) for head in (*statuses, "cost")]
    blocks: list[Block] = [table(tuple(heads), rows, "Cells by verdict")]
    cells = regime.sweep.cells
    if len(cells) <= MOST_CELLS:
        blocks += [Text(""), _cells_table(regime), Text("verdict, and ratio of true to stated covariance")]
    reference = regime.sweep.reference
    blocks.append(Text(f"{len(cells)} cells; cost: CPU time of a step against {reference}, median over the cells"))
    if some := sum(bool(regime.trusted(cell)) for cell in cells):
        blocks.append(Text(f"in {some} of {len(cells)} cells some filter is consistent"))
    if regime.missing:
        blocks.append(Text(f"{regime.missing} of {len(cells) * len(regime.sweep.filters)} are not there yet"))
    return tuple(blocks)


def _cells_table(regime: Regime) -> Table:
    """A row for each cell: its values, and the verdict and covariance ratio of each filter."""
    sweep = regime.sweep
    axes = [axis for axis in sweep.grid if len(axis.values) > 1] or list(sweep.grid)
    columns = [Column(axis.key.rpartition(".")[2], number=axis.numeric, most=WIDEST) for axis in axes]
    if sweep.alone:
        columns.append(Column("otherwise", most=WIDEST))
    columns += map(Column, sweep.filters)
    rows: list[tuple[Cell, ...]] = []
    for cell in sweep.cells:
        results_of_cell = regime.at(cell)
        verdicts = [_verdict(results_of_cell.get(name)) for name in sweep.filters]
        rows.append((*values_of(sweep, axes, cell), *verdicts))
    return table(tuple(columns), rows, "Cells")


def _verdict(result: CellResult | None) -> Cell:
    if result is None:
        return "-"
    if np.isnan(result.ratio):
        return Status(result.status, "")
    return Status(result.status, " ∞" if np.isinf(result.ratio) else f" {short(result.ratio)}")
