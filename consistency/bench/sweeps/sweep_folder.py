"""The folder of a sweep: an atomic folder for each filter in each cell, so that it continues where it was stopped."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from consistency.bench.scenario import Scenario
from consistency.bench.store.folder_tables import write_tables
from consistency.bench.store.journal import Journal, Unfinished
from consistency.bench.sweeps.run_cell import CellOutcome, CellResult, plain_numbers, result_from
from consistency.bench.sweeps.sweep_file import Cell, Sweep, SweepFile, sweep_of
from consistency.referee.errors import InputError
from consistency.referee.parsing import reading
from consistency.referee.system.atomic import write_whole
from consistency.referee.system.folders import read_manifest
from consistency.referee.system.provenance import manifest_of

KIND, CELL_KIND = "sweep", "cell"
CELLS = "cells"  # folder of the cells in that of the sweep
# rooms whose code the numbers of a cell depend on
CODE = (
    "referee/diagnostics", "referee/geometry", "referee/verdicts", "bench/filters", "bench/models",
    "bench/runs/run_outcome.py", "bench/runs/run_until_decided.py", "bench/scenario", "bench/simulation", "bench/store",
)  # fmt: skip


@functools.cache
def code_digest() -> str:
    """Hash of the sources that the numbers of a cell depend on."""
    root, digest = Path(__file__).parents[2], hashlib.sha256()
    for name in CODE:
        place = root / name
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            digest.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:16]


@dataclass(frozen=True)
class CellWork:
    """One filter in one cell."""

    cell: Cell
    filter: str

    @property
    def text(self) -> str:
        return f"{self.filter}, {self.cell.text}"


class SweepFolder:
    """A sweep with the folder of its cells.

    Parameters
    ----------
    sweep : what is to be done
    path : folder; it need not be there
    """

    def __init__(self, sweep: Sweep, path: Path) -> None:
        self.sweep, self.path = sweep, path

    def place(self, work: CellWork) -> Path:
        """Folder of one filter in one cell."""
        return self.path / CELLS / work.cell.name / work.filter

    def inputs(self, work: CellWork) -> dict[str, Any]:
        """What the numbers of a cell depend on."""
        sweep = self.sweep
        return {
            "scenario": work.cell.scenario.hash, "filter": work.filter, "seed": sweep.seed_of(work.cell),
            **sweep.rule.model_dump(), "code": code_digest(),
        }  # fmt: skip

    def result(self, work: CellWork) -> CellResult | None:
        """The result that was made with these inputs; None where there is none.

        Raises
        ------
        InputError
            What is there is damaged.
        """
        path = self.place(work)
        if not path.exists() or self.changed_input(work):
            return None
        with reading(path / "manifest.json", "key 'result' is damaged; remove that folder"):
            return result_from(read_manifest(path)["result"])

    def changed_input(self, work: CellWork) -> str:
        """What the result that is there was made with and what differs now, in words; empty where all is the same."""
        cell_folder = self.place(work)
        inputs_before = read_manifest(cell_folder).get("inputs")
        if not isinstance(inputs_before, dict):
            raise InputError(f"{cell_folder}/manifest.json: key 'inputs' is missing; remove that folder")
        for key, value in self.inputs(work).items():
            if inputs_before.get(key) != value:
                input_name = "source code of the bench" if key == "code" else key
                return f"{cell_folder}: made with another {input_name} ({inputs_before.get(key)}, now {value})"
        return ""

    def require_usable(self, overwrite: bool) -> None:
        """Refuse before any work a folder of something else, and unless ``overwrite`` cells made with other inputs."""
        if not (self.path.exists() or self.path.is_symlink()):
            return
        try:
            kind = read_manifest(self.path).get("kind")
        except InputError as error:
            raise InputError(f"--out {self.path}: is not a folder of 'consistency sweep' ({error})") from None
        if kind != KIND:
            raise InputError(f"--out {self.path}: holds {kind}, not a sweep; choose another folder")
        if overwrite:
            return
        finished_cells = [work for work in self.all_work() if self.place(work).exists()]
        changed_cells = [text for work in finished_cells if (text := self.changed_input(work))]
        if changed_cells:
            more = f" (and {len(changed_cells) - 1} more)" if len(changed_cells) > 1 else ""
            raise InputError(
                f"{changed_cells[0]}{more}; add --overwrite to run such cells again, or give another --out to keep them"
            )

    def all_work(self) -> list[CellWork]:
        """Every filter in every cell, in an order that mixes the grid.

        Slow cells lie together in the grid; mixed, the time left is foreseen.
        """
        cells_in_mixed_order = sorted(self.sweep.cells, key=lambda cell: hashlib.sha256(cell.name.encode()).digest())
        return [CellWork(cell, name) for cell in cells_in_mixed_order for name in self.sweep.filters]

    def begin(self) -> None:
        """Make the folder, or take over the one that is there; other processes may do so at the same time."""
        manifest = manifest_of(kind=KIND, sweep=describe(self.sweep))
        if not self.path.exists():
            try:
                write_tables(self.path, {}, manifest)
                return
            except InputError:
                if not self.path.exists():
                    raise
        manifest_before = read_manifest(self.path)
        try:
            sweep_before = sweep_from(manifest_before, self.path)
        except InputError:
            sweep_before = self.sweep
        if replace(sweep_before, filters=()) == replace(self.sweep, filters=()):
            self.sweep = replace(self.sweep, filters=tuple(dict.fromkeys((*sweep_before.filters, *self.sweep.filters))))
        text = json.dumps(manifest | {"sweep": describe(self.sweep), "tables": []}, indent=2)
        write_whole(self.path / "manifest.json", f"{text}\n".encode())

    @contextmanager
    def at_work(self, work: CellWork) -> Iterator[Journal]:
        """The journal of what is finished of a cell; nobody else has it meanwhile, and it is gone with the cell's end.

        Raises
        ------
        Busy
            Another process is at work on the cell.
        """
        inputs = self.inputs(work)
        with Unfinished(self.place(work), resume=True, kind=CELL_KIND) as unfinished:
            journal = unfinished.journal
            if journal.study.get("inputs") != inputs:
                journal.clear()
                journal.begin({"inputs": inputs})
            yield journal
            unfinished.is_over = True

    def write(self, work: CellWork, outcome: CellOutcome, wall: float) -> None:
        """Put a result in its place as a whole; one that another process has put there meanwhile is replaced."""
        manifest = manifest_of(
            kind=CELL_KIND, wall=wall, inputs=self.inputs(work), cell=work.cell.text,
            seed=self.sweep.seed_of(work.cell), result=plain_numbers(outcome.result),
            scenario=work.cell.scenario.model_dump(mode="json"),
        )  # fmt: skip
        write_tables(
            self.place(work), {}, manifest,
            lambda at: outcome.runs.to_csv(at / "runs.csv", index=False, float_format="%.6g"), overwrite=True,
        )  # fmt: skip

    def results(self) -> dict[tuple[int, str], CellResult]:
        """What is there, by number of the cell and filter; results with other inputs are left out."""
        cell_results: dict[tuple[int, str], CellResult] = {}
        for cell in self.sweep.cells:
            for name in self.sweep.filters:
                result = self.result(CellWork(cell, name))
                if result is not None:
                    cell_results[cell.number, name] = result
        return cell_results


def describe(sweep: Sweep) -> dict[str, Any]:
    """A sweep as JSON, from which it can be made again."""
    values_alone = {axis.key: list(axis.values) for axis in sweep.alone}
    return {
        "name": sweep.name,
        "summary": sweep.summary,
        "base": sweep.base.model_dump(mode="json"),
        "grid": {axis.key: list(axis.values) for axis in sweep.grid},
        **({"alone": values_alone} if values_alone else {}),
        "filters": list(sweep.filters),
        "seed": sweep.seed,
        "rule": sweep.rule.model_dump(),
    }


def sweep_from(manifest: dict[str, Any], path: Path) -> Sweep:
    """The sweep that :func:`describe` described, under the key ``sweep`` of what ``path`` holds.

    Raises
    ------
    InputError
        It is damaged.
    """
    with reading(path, "key 'sweep' is damaged; write it again"):
        content = dict(manifest["sweep"])
        name, base = str(content.pop("name")), Scenario.model_validate(content.pop("base"))
        file = SweepFile.model_validate(content | {"base": base.name})
        try:
            sweep = sweep_of(name, file, base)
        except InputError as error:
            raise ValueError(str(error)) from None
        _ = sweep.cells  # each is checked when it is made
        return sweep


def open_sweep(path: Path) -> SweepFolder:
    """A folder of ``consistency sweep``; raises InputError where it is none."""
    manifest = read_manifest(path)
    if manifest.get("kind") != KIND:
        raise InputError(f"{path}: holds {manifest.get('kind')}, not a sweep; give a folder of 'consistency sweep'")
    return SweepFolder(sweep_from(manifest, path / "manifest.json"), path)
