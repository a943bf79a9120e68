"""Filters against each other on the same trials, and against a baseline.

A baseline is a small file with a row for each run of an earlier release.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from consistency.referee.column_names import POSE
from consistency.referee.defaults import DETECT, FALSE_ALARM, POWER
from consistency.referee.diagnostics.comparison import (
    FEWEST,
    Comparison,
    FailedRuns,
    RunSummary,
    compare,
    summary_of_runs,
)
from consistency.referee.diagnostics.record import Record, Skip, numbered_axes
from consistency.referee.diagnostics.verdict import plain
from consistency.referee.errors import InputError
from consistency.referee.parsing import HUGE, read_json, reading
from consistency.referee.readers.options import REPEATS, SourceOptions
from consistency.referee.show.blocks import Block, Document, Text
from consistency.referee.system import SCHEMA_VERSION, digest_of_file, manifest_of, write_whole, writing
from consistency.referee.verdicts.judge_sources import Source, skip_asked, source_of
from consistency.referee.verdicts.tables import comparison_table

HIGHEST_DOF = 1000  # of an error in a baseline
FILTER_KEYS = ("runs", "dof", "nees", "squared", "covered", "failures")


@dataclass(frozen=True)
class Compared:
    """Filter ``a`` against ``b``."""

    a: str
    b: str
    comparison: Comparison
    failures: FailedRuns
    note: str = ""
    same_runs: bool = True  # failures are of the same trials
    sources: tuple[str, str] = ("", "")  # files or folders of both, where they differ

    def __str__(self) -> str:
        return self.sentence

    @property
    def sentence(self) -> str:
        c = self.comparison
        own, reference = self.names
        found = "not shown to be less consistent"
        way = "as independent samples"
        if c.worse:
            found = "less consistent"
        if c.paired:
            way = "run by run on the same trials"
        if c.at_most < 0.0:
            found = f"at least {np.exp(-c.at_most):.3g} times nearer to consistent"
        text = f"{own} is {found} than {reference}: {c.runs} runs, {way}, p {c.p_value:.2g}"
        if c.distance == c.standard_error == 0.0:
            text += "; every run is the same in both"
        elif c.worse and c.conservative:
            text += (
                f"; its covariance is farther too large, unless rare runs with a large NEES are missing here: up to "
                f"{100.0 * c.unseen:.2g} % of all runs may be of a kind that {c.runs} do not show"
            )
        elif not c.worse and not c.at_most < 0.0:
            text += f"; {self._limit}"
            if not c.at_most < np.log(DETECT):
                text += (
                    f"; {c.needed_runs(DETECT)} runs find a covariance farther off by x{DETECT:g} with power {POWER:g}"
                )
        if any(self.failures):
            text += f"; failed runs: {self.failures.a} of {own}, {self.failures.b} of {reference}"
        if self.note:
            return f"{text}. {self.note}".rstrip(". ")
        return text

    @property
    def names(self) -> tuple[str, str]:
        """What both are called: by their sources where they have one name."""
        if self.a != self.b:
            return self.a, self.b
        own, other = self.sources
        if own == other:
            return self.a, "the reference"
        return f"{self.a} of {own}", f"{self.b} of {other}"

    @property
    def _limit(self) -> str:
        """How much farther off filter ``a`` may be that is not found worse."""
        most = self.comparison.at_most
        if not np.isfinite(most):
            return "no difference shown"
        return f"no difference shown; at most x{np.exp(most):.3g} farther off"

    @property
    def worse(self) -> bool:
        if self.comparison.worse or not (self.comparison.paired and self.same_runs):
            return self.comparison.worse
        return self.failures.a > self.failures.b


def compare_filters(base: Baseline, filters: Sequence[str], false_alarm: float = FALSE_ALARM) -> list[Compared]:
    """The first filter against each of the others, on the same trials."""
    names = list(filters) or list(base.filters)
    if len(names) < 2:
        raise InputError(
            f"{base.name}: give two filters with --filter, or another folder or a baseline to compare with"
        )
    return [_compared(base, names[0], base, other, true_pairs=True, false_alarm=false_alarm) for other in names[1:]]


def compare_with(
    new: Baseline, old: Baseline, filters: Sequence[str], false_alarm: float = FALSE_ALARM
) -> list[Compared]:
    """Each filter of ``new`` against the same in ``old``; run by run only where the trials are the same."""
    pairs = [(name, name) for name in filters or new.filters if filters or name in old.filters]
    if not pairs and len(new.filters) == len(old.filters) == 1:  # estimators that are named after their files
        pairs = [(next(iter(new.filters)), next(iter(old.filters)))]
    if not pairs:
        raise InputError(f"{new.name} and {old.name} have no filter in common; name one with --filter")
    same = new.of_the_trials_of(old)
    note = ""
    if new.trials and old.trials:
        old, common = _numbered_alike(new, old)
        same = common >= FEWEST
        note = f"{common} of {len(new.trials)} runs have the same seed and truth in both"
    elif not same:
        which = "Scenario or seed"
        if new.scenario is None and old.scenario is None:
            which = "Log or truth"
        note = f"{which} differ: the trials are not the same"
    comparisons = []
    for a, b in pairs:
        as_many = len(new.filters[a].runs) == len(old.filters[b].runs)
        comparisons.append(_compared(new, a, old, b, same, false_alarm, note, as_many or not new.trials))
    return comparisons


def _numbered_alike(new: Baseline, old: Baseline) -> tuple[Baseline, int]:
    """The old runs of a program with the numbers of the new ones of the same seed and truth, and how many these are.

    Runs without a counterpart have negative numbers.
    """
    number = {trial: run for run, trial in new.trials.items()}
    renamed = {run: number.get(trial, -1 - run) for run, trial in old.trials.items()}
    filters = {}
    for name, rows in old.filters.items():
        runs = [renamed.get(int(run), -1 - int(run)) for run in rows.runs]
        filters[name] = replace(rows, runs=np.array(runs, np.int64))
    return replace(old, filters=filters), sum(run >= 0 for run in renamed.values())


def _compared(
    a: Baseline,
    of_a: str,
    b: Baseline,
    of_b: str,
    true_pairs: bool,
    false_alarm: float,
    note: str = "",
    same_runs: bool = True,
) -> Compared:
    """Filter ``of_a`` of ``a`` against ``of_b`` of ``b``; run by run where these are ``true_pairs``."""
    for base, name in ((a, of_a), (b, of_b)):
        if name not in base.filters:
            raise InputError(f"--filter {name}: is not in {base.name}; there are: {', '.join(base.filters)}")
    axes = a.axes[of_a]
    if axes != b.axes[of_b]:
        raise InputError(
            f"{of_a} against {of_b}: their errors have different components, {', '.join(axes)} and "
            f"{', '.join(b.axes[of_b])}"
        )
    paired = None
    if not true_pairs:
        paired = False
    try:
        comparison = compare(a.filters[of_a], b.filters[of_b], false_alarm, axes, paired)
    except ValueError as error:
        raise InputError(f"{of_a} against {of_b}: {error}") from None
    failures = FailedRuns(a.failures[of_a], b.failures[of_b])
    if kind := a.filters[of_a].kind:
        note = f"{note}. Both are {kind}".removeprefix(". ")
    return Compared(of_a, of_b, comparison, failures, note, same_runs, (a.name, b.name))


def comparison_document(compared: Sequence[Compared]) -> Document:
    """Tables and sentences of comparisons, and their numbers."""
    blocks: list[Block] = []
    data: list[dict[str, Any]] = []
    for each in compared:
        blocks += [comparison_table(*each.names, each.comparison), Text(each.sentence), Text("")]
        numbers = {"a": each.a, "b": each.b, "worse": each.worse, "sentence": each.sentence, "failures": each.failures}
        data.append(numbers | asdict(each.comparison))
    return Document("", "", (), tuple(blocks), data)


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
        if record.errors.bounded:
            raise InputError(
                f"{record.name}: bounds are not compared: 'analyse' finds the factor of each estimator, with its "
                "interval; with --gaussian bounds are read as covariances, which are"
            )
        if record.errors.nees is None:
            raise InputError(f"{name}: has no truth of {each}; give it with --truth, as only a NEES can be compared")
        of_runs |= record.runs.trials
        failures[each] = len(record.failures)
        axes[each] = tuple(record.errors.axes)
        own = record
        if not record.origin.unshown:
            own = record.as_runs
        filters[each] = summary_of_runs(own)
    trials = source.trials
    if SourceOptions(truth=truth).repeats:
        trials = (REPEATS, None)  # runs of one number are taken as one trial
    elif truth is not None:
        trials = (_digest(truth), None)
    return Baseline(name, source.scenario, trials, filters, failures, axes, _option(first), of_runs)


def _option(skip: Skip | None) -> str | None:
    """Value of the option that leaves these steps out."""
    if skip is None:
        return None
    return skip.option


def _digest(truth: Path) -> str:
    paths = [truth]
    if not truth.is_file():
        paths = sorted(path for path in truth.rglob("*") if path.is_file())
    return hashlib.sha256(b"".join(map(digest_of_file, paths))).hexdigest()


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
        if not rows.kind:
            del filters[name]["kind"]
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
        of_runs = data.get("trials", {})  # files written before lack it
        if not isinstance(of_runs, dict) or not all(isinstance(trial, str) for trial in of_runs.values()):
            raise ValueError("key 'trials': not a table of texts")
        trials = {int(run): trial for run, trial in of_runs.items()}
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
    if not isinstance(table, dict):
        raise ValueError(f"key '{place}': not a table")
    if missing := [key for key in FILTER_KEYS if key not in table]:
        raise ValueError(f"key '{place}.{missing[0]}': missing")
    if unknown := [key for key in table if key not in (*FILTER_KEYS, "axes", "kind")]:  # files written before lack axes
        raise ValueError(f"key '{place}.{unknown[0]}': unknown")
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
    kind = table.get("kind", "")
    if not isinstance(kind, str):
        raise ValueError(f"key '{place}.kind': not a text")
    nees, squared, covered = parts
    return RunSummary(np.array(runs, np.int64), dof, nees, squared, covered, kind), failures, tuple(axes)


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
