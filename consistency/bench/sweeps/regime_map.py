"""The map of a sweep: where each filter is consistent, how accurate it is there, and what it costs."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from consistency.bench.scenario import data_folder
from consistency.bench.sweeps.run_sweep import (
    CellResult,
    SweepFolder,
    describe,
    open_sweep,
    plain_numbers,
    result_from,
    sweep_from,
)
from consistency.bench.sweeps.sweep_file import Cell as GridCell
from consistency.bench.sweeps.sweep_file import Sweep, values_of
from consistency.referee.diagnostics.number_words import short
from consistency.referee.diagnostics.verdict_parts import STATUSES
from consistency.referee.errors import InputError
from consistency.referee.pages.write_pages import write_file
from consistency.referee.parsing import read_json, reading
from consistency.referee.show.blocks import NONE, Block, Cell, Column, Status, Table, Text, table
from consistency.referee.system import SCHEMA_VERSION, manifest_of

MAP_KIND = "map"
SHIPPED = "regime.json"
FIELDS = tuple(CellResult.__dataclass_fields__)
EQUAL = 0.02  # relative difference of two RMSE below which the cheaper filter comes first


@dataclass(frozen=True)
class Regime:
    """Results of a sweep by cell and filter; cells or filters may be missing."""

    sweep: Sweep
    results: Mapping[tuple[int, str], CellResult]  # by number of the cell and filter
    manifest: Mapping[str, Any]  # where it comes from

    @property
    def missing(self) -> int:
        """Filters in cells that are not there."""
        return len(self.sweep.cells) * len(self.sweep.filters) - len(self.results)

    def at(self, cell: GridCell) -> dict[str, CellResult]:
        """What is there of a cell, in the order of the filters."""
        there = [name for name in self.sweep.filters if (cell.number, name) in self.results]
        return {name: self.results[cell.number, name] for name in there}

    def trusted(self, cell: GridCell) -> list[tuple[str, CellResult]]:
        """Filters that are consistent in a cell, the most accurate first."""
        return ranked_by_cost({name: result for name, result in self.at(cell).items() if result.status == "consistent"})

    @cached_property
    def table(self) -> pd.DataFrame:
        """Rows by cell and filter: the value on each axis, the filter, and the fields of :class:`CellResult`."""
        axes, rows = self.sweep.axes, []
        for cell in self.sweep.cells:
            own = [axis.values[i] for axis, i in zip(axes, cell.indices, strict=True)]
            values = [value if isinstance(value, int | float | str) else json.dumps(value) for value in own]
            for name, result in self.at(cell).items():
                rows.append([*values, name, *(getattr(result, field) for field in FIELDS)])
        return pd.DataFrame(rows, columns=[*(axis.key for axis in axes), "filter", *FIELDS])


def ranked_by_cost(results: Mapping[str, CellResult]) -> list[tuple[str, CellResult]]:
    """Filters by RMSE of position; of those that differ by 2 % or less the cheaper one first."""

    def key(pair: tuple[str, CellResult]) -> tuple[float, float]:
        rmse, cost = pair[1].rmse_position, pair[1].cost
        step = np.inf
        if np.isfinite(rmse) and rmse > 0:
            step = round(float(np.log(rmse)) / EQUAL)
        return step, cost if np.isfinite(cost) else np.inf

    return sorted(results.items(), key=key)


# --- files ------------------------------------------------------------------------------------------


def regime_of(folder: SweepFolder) -> Regime:
    return Regime(folder.sweep, folder.results(), manifest_of(kind=MAP_KIND))


def write_regime(regime: Regime, out: Path) -> list[Path]:
    """``map.json``, the summary that :func:`read_regime` reads, and the same as ``map.csv`` and ``map.parquet``."""
    table = regime.table
    paths = [out / f"map.{kind}" for kind in ("json", "csv", "parquet")]
    contents = (
        dumped(regime).encode(), table.to_csv(index=False, float_format="%.6g").encode(),
        table.to_parquet(compression="zstd", index=False),
    )  # fmt: skip
    for path, content in zip(paths, contents, strict=True):
        write_file(path, content)
    return paths


def dumped(regime: Regime) -> str:
    """The map as JSON, a row a line."""
    manifest = dict(regime.manifest) | {"sweep": describe(regime.sweep), "columns": ["cell", "filter", *FIELDS]}
    result_rows = []
    for number, name in sorted(regime.results):
        numbers = plain_numbers(regime.results[number, name])
        result_rows.append(json.dumps([number, name, *numbers.values()], ensure_ascii=False))
    manifest_json = json.dumps(manifest, indent=1, ensure_ascii=False).removesuffix("\n}")
    return f'{manifest_json},\n "rows": [\n  ' + ",\n  ".join(result_rows) + "\n ]\n}\n"


def read_regime(path: Path | None = None) -> Regime:
    """A map from ``map.json``, from a folder of ``consistency sweep``, or the shipped one.

    Raises
    ------
    InputError
        There is none, or it is damaged.
    """
    if path is None:
        path = data_folder("reference") / SHIPPED
        path = path if path.is_file() else data_folder("reports") / "reference" / SHIPPED
        if not path.is_file():
            raise InputError(
                "no map is shipped with this version; make one with 'consistency sweep regime --out regime' (about 20 "
                "minutes) and read the map in that folder"
            )
    if path.is_dir():
        return regime_of(open_sweep(path))
    data = read_json(path)
    if not isinstance(data, dict) or data.get("kind") != MAP_KIND or data.get("schema_version") != SCHEMA_VERSION:
        raise InputError(f"{path}: is not a map; give a folder of 'consistency sweep', or its map.json")
    sweep = sweep_from(data, path)
    results: dict[tuple[int, str], CellResult] = {}
    with reading(str(path), "key 'rows' is damaged; write the map again"):
        for row in data["rows"]:
            numbers = dict(zip(data["columns"], row, strict=True))
            key = int(numbers.pop("cell")), str(numbers.pop("filter"))
            results[key] = result_from(numbers)
    return Regime(sweep, results, {k: v for k, v in data.items() if k not in ("rows", "columns", "sweep")})


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
    columns = [Column(axis.short, number=axis.numeric, most=WIDEST) for axis in axes]
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
