"""The input of a gate, of one estimator or of a candidate and its reference.

It is checked, with messages that name run and step, and handed to the referee.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from consistency.referee.column_names import POSE
from consistency.referee.diagnostics.comparison import Comparison, FailedRuns, RunSummary, compare, summary_of_runs
from consistency.referee.diagnostics.number_of_runs import gate_runs
from consistency.referee.diagnostics.record import InnovationRecord, Record, Skip, skip_of
from consistency.referee.diagnostics.verdict_parts import Settings
from consistency.referee.diagnostics.whiteness import nis_of
from consistency.referee.errors import InputError
from consistency.referee.gating.session import Terms
from consistency.referee.readers.formats.archives import steps_of
from consistency.referee.readers.options import make_reading
from consistency.referee.readers.pipeline.arrays_in_memory import (
    in_memory,
    masked_steps,
    record_of_arrays,
    record_of_statement,
)
from consistency.referee.readers.pipeline.read_files import checked_options
from consistency.referee.readers.pipeline.relative_motions import rows_as_declared
from consistency.referee.readers.runs_to_record import Track, judged_rows, longest_start, symmetric
from consistency.referee.types import Array, Failure, Indices
from consistency.referee.verdicts.judge_sources import Source

if TYPE_CHECKING:
    from consistency.referee.verdicts.compare_sources import Baseline

NONE_FAILED = FailedRuns(0, 0)


def record_of_checked(
    name: str,
    errors: ArrayLike | None = None,
    covariances: ArrayLike | None = None,
    deviations: ArrayLike | None = None,
    bounds: ArrayLike | None = None,
    level: str | float | Mapping[str, Any] | None = None,
    gaussian: bool = False,
    ends: str | None = None,
    members: ArrayLike | None = None,
    truth: ArrayLike | str | None = None,
    ensemble: int | None = None,
    independent: bool = False,
    nees: ArrayLike | None = None,
    dof: ArrayLike | None = None,
    nis: ArrayLike | None = None,
    nis_dof: ArrayLike | None = None,
    innovations: ArrayLike | None = None,
    innovation_covariances: ArrayLike | None = None,
    axes: Sequence[str] | None = None,
    subsets: Mapping[str, Sequence[int]] | None = None,
    optimal_gain: bool = False,
    skip: str | float | Skip | None = None,
) -> Record:
    """One estimator with checked arrays; arguments and errors as :func:`consistency.testing.assert_consistent`."""
    sizes = {"covariances": covariances, "deviations": deviations, "bounds": bounds}
    there = [name for name, value in sizes.items() if value is not None]
    if len(there) > 1:
        raise ValueError(f"give {' or '.join(there)}, not both")
    key = there[0] if there else "covariances"
    size = sizes[key]
    options = make_reading(level=level, gaussian=gaussian or None, ends=ends, ensemble=ensemble)
    if options.given(("level", "ends")) and bounds is None and not gaussian:
        raise ValueError("level and ends go with bounds")
    if errors is None and size is not None:
        raise ValueError(f"{key} without errors: give both")
    if errors is not None and size is None and members is None:
        raise ValueError("errors without covariances: give both")
    if errors is not None and nees is not None:
        raise ValueError("give errors and covariances, or nees and dof, not both")
    if nees is not None and dof is None:
        raise ValueError("nees without dof: give dof, the dimension of the error")
    for option, value in (("axes", axes), ("subsets", subsets)):
        if value is not None and errors is None and (option == "subsets" or members is None):
            raise ValueError(f"{option} needs errors and covariances: the nees does not know its components")
    if subsets is not None and deviations is not None:
        raise ValueError("subsets needs covariances: of deviations each component is judged by itself")
    record = Record(name)
    stated = nees is not None or errors is not None or members is not None or truth is not None
    of_vectors = {"members": members, "truth": truth, "ensemble": ensemble, "independent": independent or None}
    lost = [option for option, value in of_vectors.items() if value is not None]
    if lost and (nees is not None or not stated):
        raise ValueError(f"{', '.join(lost)}: needs errors; NEES, NIS and innovations do not have them")
    if nees is not None and dof is not None:
        record = record_of_arrays({"nees": nees, "dof": dof}, axes, name)
    elif stated:
        of_errors: dict[str, ArrayLike] = {} if size is None else {key: size}
        reading = checked_options(options)
        record = record_of_statement(errors, of_errors, members, truth, axes, name, independent, reading)
        record = rows_as_declared(record)
        if dof is not None and dof != record.errors.dof:
            raise ValueError(f"dof is {dof}, but the errors have {record.errors.dof} components")
    of_gain, failures = _innovations(name, nis, nis_dof, innovations, innovation_covariances, _gone(record))
    if not stated and of_gain.nis is None:
        raise ValueError("nothing to judge: give errors and covariances, or nees and dof, or nis and nis_dof")
    if not stated and not optimal_gain:
        raise ValueError(
            "innovations alone are judged only with optimal_gain=True: those of any other gain are not white, nor of "
            "the stated size, even if the filter is right"
        )
    record = _ended(replace(record, innovations=replace(of_gain, optimal_gain=optimal_gain)), failures)
    return _without_first(record, skip)


def planned_runs(record: Record, terms: Terms | Settings, rate: float) -> int:
    """Runs with which a right record is shown to be right, or a wrong one is found, at a false-alarm ``rate``.

    Of bounds those that show right ones, however steps depend on each other; a million at most.
    """
    bounded = record.errors.bounded
    if bounded is not None:
        from consistency.referee.diagnostics.exceedance import LARGEST, runs_to_show

        return max(runs_to_show(bound.level, terms.detect, terms.power) or LARGEST for bound in bounded.bounds)
    detect = planned_detect(record, terms.detect)
    return gate_runs(planned_dof(record), detect, rate / rate_shares(record), terms.power, terms.allow, terms.lost)


def planned_detect(record: Record, detect: float) -> float:
    """The ratio of mean squares to plan for: of ranks and members it is nearer to 1 than that of the covariance."""
    tables = [table for part in record.errors.parts or (None,) if (table := record.table(part)) is not None]
    if not tables:
        return detect
    shown = min(table.factor(max(detect, 1.0 / detect)) for table in tables)
    shown = max(np.floor(1000.0 * shown), 1001.0) / 1000.0
    return float(shown if detect > 1.0 else 1.0 / shown)


def planned_dof(record: Record) -> int:
    """Degrees of freedom that one run is sure to bring: of an error, or else of the innovations of a run.

    Those of the smallest part where components are judged by themselves.
    """
    if record.errors.parts:
        return min(map(len, record.errors.parts))
    if record.errors.dof or record.innovations.nis_dof is None:
        return record.errors.dof
    return max(1, int(np.nansum(record.innovations.nis_dof, axis=1).min()))


def rate_shares(record: Record) -> int:
    """Parts that divide the false-alarm rate among them; see ``Record.parts``."""
    shares = len(record.errors.parts)
    if shares and record.innovations.optimal_gain and record.innovations.nis is not None:
        shares += 1
    return max(shares, 1)


def record_of_filter(
    results: Source, filter_name: str | None, name: str | None = None, skip: str | float | Skip | None = None
) -> Record:
    """Return the record of one filter of the bench's own results, with its failed runs.

    Steps whose covariance is rank-deficient are left out, as everywhere in the bench.

    Raises
    ------
    ValueError
        No such filter, or more than one to choose from; ``skip`` leaves nothing.
    """
    if filter_name is None:
        if len(results.filters) != 1:
            raise ValueError(f"filter: name one of {', '.join(results.filters)}")
        filter_name = results.filters[0]
    record = results.record(filter_name).without_first(skip_of(skip))
    return replace(record.errors_alone, name=name or filter_name)


def record_of_read(
    record: Record, name: str | None, optimal_gain: bool = False, skip: str | float | Skip | None = None
) -> Record:
    """Return a record of :func:`consistency.read` as a gate judges it.

    Raises
    ------
    ValueError
        ``skip`` leaves nothing.
    """
    record = _without_first(rows_as_declared(record), skip)
    record = record.with_optimal_gain() if optimal_gain else record
    return replace(record, name=name or record.name)


def _without_first(record: Record, skip: str | float | Skip | None) -> Record:
    """The record without its first steps; a ValueError names the argument, not the flag of a command."""
    try:
        return record.without_first(skip_of(skip))
    except InputError as error:
        raise ValueError(str(error).removeprefix("--")) from None


# --- arrays ----------------------------------------------------------------------------------------


def _gone(record: Record) -> Array | None:
    """Steps of runs from their failure on, (runs, steps) of bool; None without errors, NEES and NIS."""
    some = next((a for a in (record.errors.error, record.errors.nees, record.innovations.nis) if a is not None), None)
    if some is None:
        return None
    gone = np.zeros(some.shape[:2], bool)
    for failure in record.failures:
        gone[failure.run, failure.step - 1 :] = True
    return gone


def _ended(record: Record, failures: Sequence[Failure]) -> Record:
    """The record with further failed runs, each of which ends where anything of it failed first."""
    if not failures:
        return record
    first: dict[int, Failure] = {}
    for failure in sorted((*record.failures, *failures), key=lambda failure: failure.step):
        first.setdefault(failure.run, failure)
    record = replace(record, failures=tuple(first[run] for run in sorted(first)))
    gone = _gone(record)
    assert gone is not None

    return replace(record.changed(partial(_without, gone)), runs=record.runs)


def _without(gone: Array, array: Array) -> Array:
    """Values (runs, steps, ...) without the steps that are ``gone``: NaN, and 0 of whole numbers."""
    nothing = np.nan if array.dtype.kind == "f" else 0
    return np.where(gone.reshape(*gone.shape, *(1,) * (array.ndim - 2)), nothing, array)


def _require_some(name: str, there: Array, good: Array) -> None:
    """Raise where no run is good in a step in which some are there; both (runs, steps) of bool."""
    never = there.any(axis=0) & ~(there & good).any(axis=0)
    if never.any():
        step = int(np.argmax(never)) + 1
        raise ValueError(f"{name}, step {step}: not finite in any run; a run that failed has NaN from there on")


def _gone_of(name: str, shape: tuple[int, ...], gone: Array | None) -> Array:
    """Steps that are gone among innovations of this shape; none without errors."""
    if gone is None:
        return np.zeros(shape[:2], bool)
    if shape[:2] != gone.shape:
        raise ValueError(f"{name} has {shape[:2]} runs and steps, the errors have {gone.shape}")
    return gone


def _innovations(
    name: str, nis: ArrayLike | None, nis_dof: ArrayLike | None, vectors: ArrayLike | None,
    covariances: ArrayLike | None, gone: Array | None,
) -> tuple[InnovationRecord, list[Failure]]:  # fmt: skip
    """Innovations without the steps that are ``gone``, and the runs that fail in them."""
    if (nis is None) != (nis_dof is None):
        raise ValueError("give nis and nis_dof together")
    if (vectors is None) != (covariances is None):
        raise ValueError("give innovations and innovation_covariances together")
    found = InnovationRecord()
    failures: list[Failure] = []
    if vectors is not None and covariances is not None:
        v, S, failures = _vectors(name, vectors, covariances, gone)
        found = InnovationRecord(*nis_of(v, S), v, S)
    if nis is not None and nis_dof is not None:
        values, dof, more = _nis(name, nis, nis_dof, gone)
        found = replace(found, nis=values, nis_dof=dof)
        failures += more
    return found, failures


def _vectors(
    name: str, vectors: ArrayLike, covariances: ArrayLike, gone: Array | None
) -> tuple[Array, Array, list[Failure]]:
    """Innovations (runs, steps, m), their covariances, and failed runs, as of errors.

    A step without a measurement is masked in either, or, where the innovations are not masked, all NaN.
    """
    v = in_memory("innovations", vectors)
    S = in_memory("innovation_covariances", covariances)
    gone = _gone_of("innovations", v.shape, gone)
    if v.ndim != 3 or 0 in v.shape or S.shape != (*v.shape, v.shape[-1]):
        raise ValueError(
            "innovations and innovation_covariances must have shapes (runs, steps, m) and (runs, steps, m, m), "
            f"got {v.shape} and {S.shape}"
        )
    absent = masked_steps("innovations", vectors, v.shape[:2])
    absent |= masked_steps("innovation_covariances", covariances, v.shape[:2])
    if not isinstance(vectors, np.ma.MaskedArray):
        absent |= np.isnan(v).all(axis=-1)
    there: Array = np.asarray(~(absent | gone))
    _require_some("innovations", there, np.asarray(np.isfinite(v).all(axis=-1)))
    _require_some("innovation_covariances", there, np.asarray(np.isfinite(S).all(axis=(-2, -1))))
    used = np.zeros(there.shape, bool)
    tracks = []
    failures = []
    S = S.copy()
    for run, steps in enumerate(there):
        k = np.flatnonzero(steps)
        place = steps_of("innovation_covariances", run, k)
        S[run, k] = symmetric(S[run, k], place.__getitem__)
        tracks.append(Track(run, k, place, v[run, k], S[run, k]))
    longest = longest_start(tracks)
    for track in tracks:
        k = track.column
        (start, end, reason) = judged_rows(track, longest, "innovation")
        used[track.run, k[start:end]] = True
        if reason:
            reason = reason.replace("covariance", "innovation covariance")
            failures.append(Failure(name, track.run, int(k[end]) + 1, reason))
    return _without(~used, v), _without(~used, S), failures


def _nis(name: str, nis: ArrayLike, nis_dof: ArrayLike, gone: Array | None) -> tuple[Array, Indices, list[Failure]]:
    """NIS and its degrees of freedom, (runs, steps), which are 0 where it does not count, and failed runs."""
    values = in_memory("nis", nis)
    dof = in_memory("nis_dof", nis_dof)
    gone = _gone_of("nis", values.shape, gone)
    if values.ndim != 2 or 0 in values.shape:
        raise ValueError(f"nis must have shape (runs, steps), got {values.shape}")
    if dof.ndim not in (0, 2) or (dof.ndim == 2 and dof.shape != values.shape):
        raise ValueError(f"nis_dof must be a number or have the shape of nis, {values.shape}, got {dof.shape}")
    absent = masked_steps("nis", nis, values.shape) | gone
    if dof.ndim:
        absent |= masked_steps("nis_dof", nis_dof, values.shape)
    dof = np.where(absent, 0.0, np.broadcast_to(dof, values.shape))
    if not (np.isfinite(dof).all() and (dof >= 0).all() and (dof == np.round(dof)).all()):
        raise ValueError("nis_dof must hold whole numbers, 0 where there was no innovation")
    there = np.asarray(dof > 0)
    finite = np.asarray(np.isfinite(values))
    if (there & (values < 0)).any():
        run, step = np.argwhere(there & (values < 0))[0]
        raise ValueError(f"nis: negative in run {run}, step {step + 1}")
    _require_some("nis", there, finite)
    broken = there & ~finite
    failures = []
    for run in np.flatnonzero(broken.any(axis=1)):
        failures.append(Failure(name, int(run), int(np.argmax(broken[run])) + 1, "NIS is not finite"))
    return _without(gone, values), dof.astype(np.int64), failures


@dataclass(frozen=True)
class Sides:
    candidate: Record
    a: RunSummary
    b: RunSummary
    name_b: str
    axes: tuple[str, ...] | None
    paired: bool
    failures: FailedRuns = NONE_FAILED

    @property
    def failed_more(self) -> bool:
        return self.paired and self.failures.a > self.failures.b

    @property
    def usable_runs(self) -> int:
        """Runs that both have, or the fewer of the two where they are not paired."""
        a = self.a.runs[np.isfinite(self.a.nees)]
        b = self.b.runs[np.isfinite(self.b.nees)]
        if self.paired:
            return len(np.intersect1d(a, b))
        return min(len(a), len(b))

    def compare(self, false_alarm: float) -> Comparison:
        return compare(self.a, self.b, false_alarm, self.axes, self.paired)

    def reasons(self, c: Comparison) -> list[str]:
        """The outcome in a sentence, then every difference."""
        anees, outcome, where, runs = c.differences[0], "not worse", "nearer to", "runs"
        if c.worse or self.failed_more:
            outcome = "worse"
        if c.distance > 0:
            where = "farther from"
        if c.paired:
            runs = "paired runs"
        lines = [
            f"{outcome} than {self.name_b}: mean NEES {anees.a:.3g} against {anees.b:.3g}, {self.a.dof} expected; "
            f"its ratio to {self.a.dof} is {where} 1 by x{np.exp(abs(c.distance)):.3g} (p {c.p_value:.2g}, "
            f"{c.runs} {runs})"
        ]
        if self.failed_more:
            lines.append(f"{self.failures.a} runs failed, of {self.name_b} {self.failures.b}")
        for d in c.differences:
            kind = "ratio"
            if "coverage" in d.name:
                kind = "difference"
            interval = f"{d.difference:.3g} [{d.low:.3g}, {d.high:.3g}]"
            lines.append(f"{d.name} {d.a:.4g} against {d.b:.4g}: {kind} {interval}")
        return lines


def of_arrays(name: str, candidate: Mapping[str, Any], reference: Mapping[str, Any]) -> Sides:
    """Both sides from arguments of :func:`checked`, row i of both the same trial.

    Raises
    ------
    ValueError
        As :func:`consistency.testing.assert_not_worse`.
    """
    a, row_a = _side("candidate a", name, candidate)
    b, row_b = _side("reference b", name, reference)
    m = len(a.run_numbers)
    n = len(b.run_numbers)
    if m != n:
        raise ValueError(f"the candidate has {m} runs and the reference {n}; row i of both must be one trial")
    if a.errors.dof != b.errors.dof:
        raise ValueError(f"the errors have {a.errors.dof} and {b.errors.dof} components")
    failures = FailedRuns(len(a.failures), len(b.failures))
    return Sides(a, row_a, row_b, "the reference", tuple(a.errors.axes) or None, paired=True, failures=failures)


def _side(side: str, name: str, arrays: Mapping[str, Any]) -> tuple[Record, RunSummary]:
    try:
        case = record_of_checked(name, **arrays)
    except ValueError as error:
        raise ValueError(f"{side}: {error}") from None
    assert case.errors.nees is not None
    return case, summary_of_runs(case)


def of_filters(
    results: Source,
    filter_name: str | None,
    than: str | None,
    reference: Baseline | None,
    name: str | None,
    skip: str | float | Skip | None = None,
) -> Sides:
    """Both sides from results, or from results and a baseline of an earlier state.

    Raises
    ------
    ValueError
        No such filter, or nothing to compare with.
    """
    from consistency.referee.verdicts.compare_sources import baseline, require_skip

    if reference is None and than is None:
        raise ValueError("than: name the filter to compare with, or give other results as reference")
    candidate = record_of_filter(results, filter_name, name, skip=skip)
    new = baseline(results, skip=skip)
    old = new
    if reference is not None:
        old = require_skip(reference, skip)
    of_a = filter_name or results.filters[0]
    of_b = than or of_a
    if of_b not in old.filters:
        raise ValueError(f"filter '{of_b}' is not in the reference; there are: {', '.join(old.filters)}")
    paired = new.of_the_trials_of(old)
    label = of_b
    if old is not new:
        label = f"{of_b} in {old.name}"
    failures = FailedRuns(new.failures[of_a], old.failures[of_b])
    return Sides(candidate, new.filters[of_a], old.filters[of_b], label, tuple(POSE), paired, failures)
