"""Baselines: a row for each run of every filter, kept as a small file for later comparisons."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np

from consistency.referee.column_names import POSE
from consistency.referee.diagnostics.comparison import RunSummary, summary
from consistency.referee.diagnostics.records.record import Record, numbered_axes
from consistency.referee.diagnostics.records.skipped_start import Skip
from consistency.referee.diagnostics.verdict.as_dictionary import plain
from consistency.referee.errors import InputError
from consistency.referee.parsing import HUGE, read_json, reading
from consistency.referee.system.atomic import write_whole
from consistency.referee.system.folders import writing
from consistency.referee.system.provenance import SCHEMA_VERSION, manifest_of
from consistency.referee.types import Array
from consistency.referee.verdicts.judge_sources import Source, skip_asked, source_of

HIGHEST_DOF = 1000  # of an error in a baseline
FILTER_KEYS = ("runs", "dof", "nees", "squared", "covered", "failures")


@dataclass(frozen=True)
class Baseline:
    """A row for each run of every filter: the data for a later comparison, and their origin."""

    name: str
    scenario: str | None
    origin: tuple[Any, Any]  # scenario hash and seed, or what a log or truth holds: the same trials have the same
    filters: dict[str, RunSummary]
    failures: dict[str, int]
    axes: dict[str, tuple[str, ...]]  # names of the components of each filter's error
    skip: str | None = None  # first steps that were left out: 20, 2s
    # of runs of a program: what each was made of, its seed or recorded file and its truth, by run
    trials: Mapping[int, str] = field(default_factory=dict)

    def of_the_trials_of(self, other: Baseline) -> bool:
        """Whether both are of the same trials, so that runs of one number belong together."""
        return self is other or (self.origin[0] is not None and self.origin == other.origin)


def baseline(
    of: Source | Sequence[Record],
    name: str = "results",
    skip: str | float | Skip | None = None,
    truth: Path | None = None,
) -> Baseline:
    """Summaries of all filters, with the first steps of each run left out where ``skip`` says so.

    Parameters
    ----------
    of : records, or a source of them
    truth : file, or folder of them, beside which the estimates were read; the same trials have the same

    Raises
    ------
    InputError
        A filter has no NEES, or nothing of it is left.
    """
    first = skip_asked(skip)
    filters = {}
    failures = {}
    axes = {}
    of_runs: dict[int, str] = {}
    source = source_of(of)
    if not source.has_truth:
        raise InputError(f"{name}: has no truth; only filters with a NEES can be compared")
    for each in source.filters:
        record = source.record(each).without_first(first)
        if record.nees is None:
            raise InputError(f"{name}: has no truth of {each}; give it with --truth, as only a NEES can be compared")
        of_runs |= record.trials
        failures[each] = len(record.failures)
        axes[each] = tuple(record.axes)
        own = record
        if not record.unshown:
            own = record.as_runs
        world = own.in_world
        filters[each] = summary(cast(Array, own.nees), own.dof, world.error, world.covariance, own.run_numbers)
    trials = source.trials
    if truth is not None:
        trials = (_digest(truth), None)
    return Baseline(name, source.scenario, trials, filters, failures, axes, _option(first), of_runs)


def _option(skip: Skip | None) -> str | None:
    """Value of the option that leaves these steps out."""
    if skip is None:
        return None
    return skip.option


def _digest(truth: Path) -> str:
    digest = hashlib.sha256()
    paths = [truth]
    if not truth.is_file():
        paths = sorted(path for path in truth.rglob("*") if path.is_file())
    for path in paths:
        with path.open("rb") as file:
            own = hashlib.sha256()
            for piece in iter(lambda: file.read(2**20), b""):
                own.update(piece)
            digest.update(own.digest())
    return digest.hexdigest()


def write_baseline(base: Baseline, path: Path, overwrite: bool = False) -> None:
    """Keep a baseline as a small JSON file, for version control.

    Raises
    ------
    InputError
        The file exists or cannot be written.
    """
    if path.exists() and not overwrite:
        raise InputError(f"--out {path}: exists already; name another file or add --overwrite")
    filters = {}
    for name, rows in base.filters.items():
        filters[name] = plain(vars(rows)) | {"failures": base.failures[name], "axes": list(base.axes[name])}
    data = manifest_of(
        kind="baseline",
        scenario=base.scenario,
        origin=list(base.origin),
        skip=base.skip,
        trials={str(run): trial for run, trial in base.trials.items()},
        filters=filters,
    )
    with writing(path):
        write_whole(path, (json.dumps(data, indent=1, allow_nan=False) + "\n").encode("utf-8"))


def is_baseline(path: Path) -> bool:
    """Whether a file looks like one of :func:`write_baseline`, whatever its name."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(64).lstrip().startswith(b"{")


def read_baseline(path: Path, skip: str | float | Skip | None = None) -> Baseline:
    """Read a file of :func:`write_baseline`.

    Parameters
    ----------
    skip : first steps that it was written without

    Raises
    ------
    InputError
        It is not a baseline, is damaged, or was written with other first steps.
    """
    data = read_json(path)
    if not isinstance(data, dict) or data.get("kind") != "baseline" or data.get("schema_version") != SCHEMA_VERSION:
        raise InputError(f"{path}: is not a baseline; write one with 'consistency baseline DIR --out {path}'")
    with reading(path, "damaged; write it again"):
        for key in ("scenario", "origin", "filters"):
            if key not in data:
                raise ValueError(f"key '{key}': missing")
        scenario, origin, left_out = data["scenario"], data["origin"], data.get("skip")  # files written before lack it
        for key, value in (("scenario", scenario), ("skip", left_out)):
            if not isinstance(value, str | None):
                raise ValueError(f"key '{key}': not a text")
        if not isinstance(origin, list) or len(origin) != 2:
            raise ValueError("key 'origin': not a list of two")
        if not isinstance(data["filters"], dict):
            raise ValueError("key 'filters': not a table")
        trials = _trials_of(data.get("trials", {}))  # files written before lack it
        rows = {name: _filter_of(row, f"filters.{name}") for name, row in data["filters"].items()}
    filters = {}
    failures = {}
    axes = {}
    for name, row in rows.items():
        filters[name], failures[name], axes[name] = row
    base = Baseline(str(path), scenario, (origin[0], origin[1]), filters, failures, axes, left_out, trials)
    return require_skip(base, skip)


def require_skip(base: Baseline, skip: str | float | Skip | None) -> Baseline:
    """The baseline, if the same first steps were left out of it.

    Raises
    ------
    InputError
        They were not.
    """
    asked = _option(skip_asked(skip))
    if base.skip != asked:
        own = f"with --skip {base.skip}"
        wanted = f"with --skip {asked}"
        if base.skip is None:
            own = "of all steps"
        if asked is None:
            wanted = "without --skip"
        raise InputError(f"{base.name}: was written {own}; write it again {wanted}, or compare by the same steps")
    return base


def _filter_of(table: Any, place: str) -> tuple[RunSummary, int, tuple[str, ...]]:
    """One filter in the file, values of R runs: a summary as the referee takes it, failed runs, names of components."""
    _known(table, place, FILTER_KEYS, optional=("axes",))  # files written before lack it
    runs = _list(table["runs"], f"{place}.runs")
    for k, run in enumerate(runs):
        _whole(run, f"{place}.runs.{k}", 0, 2**63)
    if len(set(runs)) < len(runs):
        raise ValueError(f"key '{place}.runs': a run is duplicated")
    parts = [np.array(_numbers(table["nees"], f"{place}.nees"), float)]
    for key in ("squared", "covered"):
        rows = _list(table[key], f"{place}.{key}")
        parts.append(np.array([_numbers(row, f"{place}.{key}.{k}", HIGHEST_DOF) for k, row in enumerate(rows)], float))
    if {len(part) for part in parts} != {len(runs)} or parts[1].shape != parts[2].shape:
        raise ValueError(f"key '{place}': its lists are not equally long")
    dof = _whole(table["dof"], f"{place}.dof", 1, HIGHEST_DOF + 1)
    axes = _list(table.get("axes", POSE), f"{place}.axes", HIGHEST_DOF)
    if not all(isinstance(axis, str) for axis in axes):
        raise ValueError(f"key '{place}.axes': not all are names")
    if axes == [f"e{i + 1}" for i in range(len(axes))]:  # of components without names, in files written before
        axes = list(numbered_axes(len(axes)))
    failures = _whole(table["failures"], f"{place}.failures", 0)
    return RunSummary(np.array(runs, np.int64), dof, *parts), failures, tuple(axes)


def _trials_of(table: Any) -> dict[int, str]:
    """What each run was made of, by run."""
    if not isinstance(table, dict) or not all(isinstance(trial, str) for trial in table.values()):
        raise ValueError("key 'trials': not a table of texts")
    return {int(run): trial for run, trial in table.items()}


def _known(table: Any, place: str, keys: Sequence[str], optional: Sequence[str] = ()) -> None:
    """Refuse what is not a table of these keys and no others."""
    if not isinstance(table, dict):
        raise ValueError(f"key '{place}': not a table")
    if missing := [key for key in keys if key not in table]:
        raise ValueError(f"key '{place}.{missing[0]}': missing")
    if unknown := [key for key in table if key not in (*keys, *optional)]:
        raise ValueError(f"key '{place}.{unknown[0]}': unknown")


def _list(values: Any, place: str, longest: int | None = None) -> list[Any]:
    if not isinstance(values, list) or (longest is not None and len(values) > longest):
        most = ""
        if longest is not None:
            most = f" of at most {longest}"
        raise ValueError(f"key '{place}': not a list{most}")
    return values


def _numbers(values: Any, place: str, longest: int | None = None) -> list[float | None]:
    """Numbers of 0 or more; None where a run has no value."""
    for k, value in enumerate(_list(values, place, longest)):
        if value is not None and not (type(value) in (int, float) and 0.0 <= value <= HUGE**4):
            raise ValueError(f"key '{place}.{k}': not a number from 0 to {HUGE**4:g}")
    return list(values)


def _whole(value: Any, place: str, least: int, end: int | None = None) -> int:
    if type(value) is not int or value < least or (end is not None and value >= end):
        below = ""
        if end:
            below = f" to below {end}"
        raise ValueError(f"key '{place}': not a whole number from {least}{below}")
    return value
