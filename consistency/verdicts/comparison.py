"""Filters against each other on the same trials, and against a baseline kept from an earlier release."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from consistency.diagnostics import Comparison, Evidence, RunSummary, compare, summary
from consistency.diagnostics.comparison import FailedRuns
from consistency.diagnostics.skipping import Skip
from consistency.errors import InputError
from consistency.reading import HUGE, read_json, reading
from consistency.recording import Recording
from consistency.store.atomic import write_whole
from consistency.store.results import POSE, Tables, open_results
from consistency.store.storage import SCHEMA_VERSION, manifest_of, plain
from consistency.verdicts.curves import Curves, curves, steps_of
from consistency.verdicts.judge import evidence_of_windows, skip_asked

DETECT = 1.5  # ratio that a sentence speaks of
HIGHEST_DOF = 1000  # of an error in a baseline


@dataclass(frozen=True)
class Baseline:
    """One row a run of every filter: what a later comparison needs, and where it came from."""

    name: str
    scenario: str | None
    origin: tuple[Any, Any]  # scenario hash and seed, or what a log or truth holds: the same trials have the same
    filters: dict[str, RunSummary]
    failures: dict[str, int]
    manifest: dict[str, Any]
    axes: dict[str, tuple[str, ...]]  # names of the components of each filter's error
    skip: str | None = None  # first steps that were left out: 20, 2s

    def of_the_trials_of(self, other: Baseline) -> bool:
        """Whether both are of the same trials, so that runs of one number belong together."""
        return self is other or (self.origin[0] is not None and self.origin == other.origin)


@dataclass(frozen=True)
class Compared:
    """Filter ``a`` against ``b``."""

    a: str
    b: str
    comparison: Comparison
    failures: FailedRuns
    note: str = ""

    @property
    def sentence(self) -> str:
        """What the comparison says."""
        c = self.comparison
        way = "run by run on the same trials" if c.paired else "as independent samples"
        text = f"{self.a} is {'less consistent' if c.worse else 'not found less consistent'} than {self._reference}"
        text += f": {c.runs} runs, {way}, p {c.p_value:.2g}"
        if c.distance == c.standard_error == 0.0:
            text += "; every run is the same in both"
        elif c.worse and c.conservative:
            text += (
                f"; its covariance is farther too large, unless rare runs with a large NEES are missing here: up to "
                f"{100.0 * c.unseen:.2g} % of all runs may be of a kind that {c.runs} do not show"
            )
        elif not c.worse:
            text += f"; {self._limit}"
            if not c.at_most < np.log(DETECT):
                text += f"; {c.needed_runs(DETECT)} runs find a covariance farther off by x{DETECT:g} with power 0.95"
        if any(self.failures):
            text += f"; failed runs {self.failures.a}, {self.failures.b} in the reference"
        return f"{text}. {self.note}".rstrip(". ") if self.note else text

    @property
    def _limit(self) -> str:
        """How much farther off filter ``a`` may be that is not found worse."""
        most = self.comparison.at_most
        if most < 0.0:
            return f"nearer to consistent, by x{np.exp(-most):.3g} at least"
        return "no difference shown" + (f"; at most x{np.exp(most):.3g} farther off" if np.isfinite(most) else "")

    @property
    def _reference(self) -> str:
        return self.b if self.a != self.b else "the reference"

    @property
    def worse(self) -> bool:
        """Less consistent, or, on the same trials, with more failed runs."""
        return self.comparison.worse or (self.comparison.paired and self.failures.a > self.failures.b)


def baseline_of(results: Tables, name: str = "results", skip: str | float | Skip | None = None) -> Baseline:
    """Summaries of all filters, with the first steps of each run left out where ``skip`` says so.

    Raises
    ------
    InputError
        The results have no truth, or nothing is left.
    """
    first = skip_asked(skip)
    if not results.has_truth:
        raise InputError(f"{name}: has no truth; only filters with a NEES can be compared")
    steps = steps_of(results)
    filters = {
        each: _summary_of(curves(results, each, steps, maps=False).without_first(first)) for each in results.filters
    }
    failures = {each: int((results.failures["filter"] == each).sum()) for each in results.filters}
    scenario = results.scenario
    m = results.manifest
    origin = (m.get("scenario_hash") or m.get("log_sha256"), m.get("seed"))
    axes = dict.fromkeys(filters, tuple(POSE))
    return Baseline(name, scenario.name if scenario else None, origin, filters, failures, m, axes, _option(first))


def _option(skip: Skip | None) -> str | None:
    return None if skip is None else skip.option


def baseline_of_files(
    recordings: Sequence[Recording], name: str, truth: Path | None = None, skip: str | float | Skip | None = None
) -> Baseline:
    """Summaries of estimators whose files were read, with the first steps left out where ``skip`` says so.

    Parameters
    ----------
    truth : file, or folder of them, beside which the estimates were read; the same trials have the same

    Raises
    ------
    InputError
        An estimator has no NEES, or nothing of it is left.
    """
    filters, first = {}, skip_asked(skip)
    for r in recordings:
        r = r.without_first(first)
        if r.nees is None:
            raise InputError(f"{name}: has no truth of {r.name}; give it with --truth, as only a NEES can be compared")
        of = evidence_of_windows(r) if r.independent and not r.unshown else r
        assert of.nees is not None
        numbers = of.run_numbers if isinstance(of, Evidence) else r.runs
        filters[r.name] = summary(of.nees, r.dof, of.error, of.covariance, numbers)
    failures = {r.name: len(r.failures) for r in recordings}
    origin = (None if truth is None else _digest(truth), None)
    return Baseline(name, None, origin, filters, failures, {}, {r.name: r.axes for r in recordings}, _option(first))


def _digest(truth: Path) -> str:
    digest = hashlib.sha256()
    for path in [truth] if truth.is_file() else sorted(path for path in truth.rglob("*") if path.is_file()):
        with path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def _summary_of(c: Curves) -> RunSummary:
    nees = c.judged.nees
    assert nees is not None
    return summary(nees, len(POSE), c.error, c.covariance, c.runs)


def write_baseline(of: Tables | Baseline, path: Path, overwrite: bool = False) -> None:
    """Keep the summaries of results as a small JSON file, for version control.

    Raises
    ------
    InputError
        The file exists or cannot be written, or the results have no truth.
    """
    if path.exists() and not overwrite:
        raise InputError(f"--out {path}: exists already; name another file or add --overwrite")
    base = of if isinstance(of, Baseline) else baseline_of(of, str(path))
    data = manifest_of(
        kind="baseline",
        scenario=base.scenario,
        origin=list(base.origin),
        skip=base.skip,
        filters={
            name: {key: plain(value) for key, value in vars(s).items()}
            | {"failures": base.failures[name], "axes": list(base.axes[name])}
            for name, s in base.filters.items()
        },
    )
    try:
        write_whole(path, (json.dumps(data, indent=1, allow_nan=False) + "\n").encode("utf-8"))
    except OSError as error:
        raise InputError(f"--out {path}: cannot be written ({error.strerror})") from None


def is_baseline(path: Path) -> bool:
    """Whether a file looks like one of :func:`write_baseline`, whatever its name."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(64).lstrip().startswith(b"{")


def read_baseline(path: Path, skip: str | float | Skip | None = None) -> Baseline:
    """A results folder, or a file of :func:`write_baseline`.

    Parameters
    ----------
    skip : first steps to leave out; of a file those that it was written without

    Raises
    ------
    InputError
        Neither, or damaged.
    """
    if path.is_dir():
        return baseline_of(open_results(path), str(path), skip)
    data = read_json(path)
    if not isinstance(data, dict) or data.get("kind") != "baseline" or data.get("schema_version") != SCHEMA_VERSION:
        raise InputError(f"{path}: is no baseline; write one with 'consistency baseline DIR --out {path}'")
    with reading(path, "damaged; write it again"):
        rows = _Rows.model_validate(data)
        filters = {name: row.summary() for name, row in rows.filters.items()}
    failures = {name: row.failures for name, row in rows.filters.items()}
    axes = {name: tuple(row.axes) for name, row in rows.filters.items()}
    origin = rows.origin[0], rows.origin[1]
    return require_skip(Baseline(str(path), rows.scenario, origin, filters, failures, data, axes, rows.skip), skip)


def require_skip(base: Baseline, skip: str | float | Skip | None) -> Baseline:
    """The baseline, if the same first steps were left out of it.

    Raises
    ------
    InputError
        They were not.
    """
    asked = _option(skip_asked(skip))
    if base.skip != asked:
        own = "of all steps" if base.skip is None else f"with --skip {base.skip}"
        wanted = "without --skip" if asked is None else f"with --skip {asked}"
        raise InputError(f"{base.name}: was written {own}; write it again {wanted}, or compare by the same steps")
    return base


Number = Annotated[float, Field(ge=0.0, le=HUGE**4)] | None  # None where a run has no value
Row = Annotated[list[Number], Field(max_length=HIGHEST_DOF)]


class _Summary(BaseModel):
    """One filter in the file: values of R runs."""

    model_config = ConfigDict(extra="forbid", strict=True)
    runs: list[Annotated[int, Field(ge=0, lt=2**63)]]  # (R,)
    dof: Annotated[int, Field(ge=1, le=HIGHEST_DOF)]
    nees: list[Number]  # (R,)
    squared: list[Row]  # (R, n)
    covered: list[Row]  # (R, n)
    failures: Annotated[int, Field(ge=0)]
    axes: Annotated[list[str], Field(max_length=HIGHEST_DOF)] = list(POSE)  # files written before lack them

    def summary(self) -> RunSummary:
        """As the referee takes it; raises ValueError where the parts do not fit together."""
        if len(set(self.runs)) < len(self.runs):
            raise ValueError("a run is there twice")
        nees, squared, covered = (np.array(values, float) for values in (self.nees, self.squared, self.covered))
        if not len(self.runs) == len(nees) == len(squared) == len(covered) or squared.shape != covered.shape:
            raise ValueError("its lists are not equally long")
        return RunSummary(np.array(self.runs, np.int64), self.dof, nees, squared, covered)


class _Rows(BaseModel):
    """What a file of :func:`write_baseline` holds beside its provenance."""

    model_config = ConfigDict(strict=True)
    scenario: str | None
    origin: Annotated[list[Any], Field(min_length=2, max_length=2)]
    filters: dict[str, _Summary]
    skip: str | None = None  # files written before lack it


def compare_filters(base: Baseline, filters: Sequence[str], false_alarm: float = 0.05) -> list[Compared]:
    """The first filter against each of the others, on the same trials."""
    names = list(filters) or list(base.filters)
    if len(names) < 2:
        raise InputError(
            f"{base.name}: give two filters with --filter, or another folder or a baseline to compare with"
        )
    return [_compared(base, names[0], base, other, true_pairs=True, false_alarm=false_alarm) for other in names[1:]]


def compare_with(new: Baseline, old: Baseline, filters: Sequence[str], false_alarm: float = 0.05) -> list[Compared]:
    """Each filter of ``new`` against the same in ``old``; run by run only where the trials are the same."""
    pairs = [(name, name) for name in filters or new.filters if filters or name in old.filters]
    if not pairs and len(new.filters) == len(old.filters) == 1:  # estimators that are named after their files
        pairs = [(next(iter(new.filters)), next(iter(old.filters)))]
    if not pairs:
        raise InputError(f"{new.name} and {old.name} have no filter in common; name one with --filter")
    same = new.of_the_trials_of(old)
    which = "Log or truth" if new.scenario is None and old.scenario is None else "Scenario or seed"
    note = "" if same else f"{which} differ: the trials are not the same"
    return [replace(_compared(new, a, old, b, same, false_alarm), note=note) for a, b in pairs]


def _compared(a: Baseline, of_a: str, b: Baseline, of_b: str, true_pairs: bool, false_alarm: float) -> Compared:
    for base, name in ((a, of_a), (b, of_b)):
        if name not in base.filters:
            raise InputError(f"--filter {name}: is not in {base.name}; there are: {', '.join(base.filters)}")
    axes = a.axes[of_a]
    if axes != b.axes[of_b]:
        raise InputError(
            f"{of_a} against {of_b}: their errors have different components, {', '.join(axes)} and "
            f"{', '.join(b.axes[of_b])}"
        )
    paired = None if true_pairs else False
    try:
        comparison = compare(a.filters[of_a], b.filters[of_b], false_alarm, axes, paired)
    except ValueError as error:
        raise InputError(f"{of_a} against {of_b}: {error}") from None
    return Compared(of_a, of_b, comparison, FailedRuns(a.failures[of_a], b.failures[of_b]))
