"""Statistical gates for the tests of any estimator, with or without pytest; numpy and scipy are enough."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from numpy.typing import ArrayLike

from consistency.referee.diagnostics.comparison import FEWEST, Comparison
from consistency.referee.diagnostics.judge_record import judge
from consistency.referee.diagnostics.record import Record
from consistency.referee.diagnostics.verdict import Verdict
from consistency.referee.diagnostics.verdict_parts import Settings
from consistency.referee.gating.checked_input import (
    Sides,
    of_arrays,
    of_filters,
    planned_detect,
    planned_dof,
    planned_runs,
    rate_shares,
    record_of_checked,
    record_of_filter,
    record_of_read,
)
from consistency.referee.gating.gate_results import GateResult, entry_of, marker_text, runs_to_decide, write_page
from consistency.referee.gating.session import Terms, current, fault_text, few_to_compare, terms, undecided_text

if TYPE_CHECKING:
    from consistency.bench.store.results import Tables
    from consistency.referee.verdicts.compare_sources import Baseline
    from consistency.referee.verdicts.judge_sources import Source


class ConsistencyError(AssertionError):
    """A fault at the stated false-alarm rate, or failed runs; has the verdict, and the comparison of two filters."""

    def __init__(self, message: str, verdict: Verdict | None = None, comparison: Comparison | None = None) -> None:
        super().__init__(message)
        self.verdict = verdict
        self.comparison = comparison


class InsufficientTrials(ValueError):
    """No fault, but too few runs to have found one; carries the number needed and the verdict so far."""

    def __init__(self, message: str, needed: int = 0, runs: int = 0, verdict: Verdict | None = None) -> None:
        super().__init__(message)
        self.needed = needed
        self.runs = runs
        self.verdict = verdict


def assert_consistent(
    errors: ArrayLike | Record | Tables | None = None,
    covariances: ArrayLike | None = None,
    *,
    deviations: ArrayLike | None = None,
    bounds: ArrayLike | None = None,
    level: str | float | Mapping[str, Any] | None = None,
    gaussian: bool = False,
    ends: str | None = None,
    members: ArrayLike | None = None,
    truth: ArrayLike | str | None = None,
    ensemble: int | None = None,
    independent: bool = False,
    filter: str | None = None,
    nees: ArrayLike | None = None,
    dof: ArrayLike | None = None,
    false_alarm: float | None = None,
    detect: float | None = None,
    power: float | None = None,
    tolerance: float | None = None,
    allow: str | None = None,
    lost: float | None = None,
    axes: Sequence[str] | None = None,
    subsets: Mapping[str, Sequence[int]] | None = None,
    method: str = "max",
    innovations: ArrayLike | None = None,
    innovation_covariances: ArrayLike | None = None,
    nis: ArrayLike | None = None,
    nis_dof: ArrayLike | None = None,
    optimal_gain: bool = False,
    skip: int | str | None = None,
    name: str | None = None,
) -> Verdict:
    """Pass an estimator whose errors are shown to have the covariance that it states.

    The referee is :func:`consistency.diagnostics.judge`: a run is one observation, and a right filter is found at
    fault in any question with probability ``false_alarm`` at most. One whose ratio of true to stated covariance is
    ``detect`` or its inverse, or farther from 1, passes with probability 1 - ``power`` at most.

    Parameters
    ----------
    errors : (runs, steps, n), truth minus estimate, angles wrapped; or the results of ``consistency.run_trials``,
        with ``filter`` the name of one in them; or a record of :func:`consistency.read`, of files of any kind. Steps
        without a truth are masked (``numpy.ma``) and do not count
    covariances : (runs, steps, n, n), in the squared units of the errors
    deviations : (runs, steps, n), in place of covariances where only standard deviations are stated: each component is
        judged by itself, at a false-alarm rate that all share, see :func:`consistency.judge`
    bounds, level, gaussian, ends : in place of covariances, as for :func:`consistency.judge`: bounds pass where
        the factor by which they must grow is shown to lie within the root of ``detect``
    members, truth : in place of errors, draws (runs, steps, m, n) and the truth (runs, steps, n), as for
        :func:`consistency.judge`; or truth "repeats": errors are estimates of the same true values
    ensemble : number of members whose mean and sample covariance are given
    independent : each row is an independent run, as of images; errors may then be (N, n)
    nees, dof : (runs, steps) and the dimension of the error, in place of errors and covariances; ``dof`` may be of
        each step, (steps,) or (runs, steps), where the state grows or shrinks
    false_alarm : probability of rejecting a correct filter; 0.001 unless an argument, marker or session sets it
    detect : ratio of true to stated covariance, in all steps, that must not pass (1.5)
    power : probability that a filter at ``detect`` does not pass (0.95)
    tolerance : a ratio shown to lie in [1 / tolerance, tolerance] is not a fault; nothing is tolerated by default
    allow : "conservative" accepts a covariance that is too large
    lost : share of lost runs that must not pass. A run is lost if it failed, or if its mean NEES is above
        :func:`consistency.diagnostics.lost_bound` at ``false_alarm`` over the number of runs. No limit by default
    axes : names of the n components
    subsets : further groups of components to look at, name -> indices
    method : of the band over all steps, see :func:`consistency.diagnostics.simultaneous_band`
    innovations, innovation_covariances : (runs, steps, m), (runs, steps, m, m); all NaN in steps without any, or masked
        (``numpy.ma``), so that all NaN is a failed run
    nis, nis_dof : (runs, steps); nis_dof is 0 in steps without any, and may be one number
    optimal_gain : True judges the innovations: they are those of an optimal gain, and none was gated away
    skip : first steps of each run to leave out of the statistics (20), of results also seconds ("2s"); a number that
        was chosen on the same runs voids the false-alarm rate
    name : of the estimator, for messages

    Returns
    -------
    The verdict, of status "consistent"

    Raises
    ------
    ConsistencyError
        A fault at the stated false-alarm rate, however few the runs; or failed runs: of results, and those whose error
        or innovation is not finite or whose covariance of either is not positive definite. Steps in which the
        covariance is singular, as at a start that is known exactly, are left out up to the first of full rank.
    InsufficientTrials
        No fault, and too few runs to show that the ratio is in [1 / ``detect``, ``detect``], or that few runs are lost;
        :func:`consistency.diagnostics.gate_runs` gives a number that suffices for nearly every right filter.
    ValueError
        Input that cannot be judged: shapes that do not fit, a covariance that is not symmetric, a step that is not
        finite in any run; options that do not fit.
    """
    __tracebackhide__ = True
    demand = terms(false_alarm, detect, power, allow, tolerance, lost)
    arrays: dict[str, Any] = {
        "covariances": covariances, "deviations": deviations, "bounds": bounds, "level": level, "ends": ends,
        "gaussian": gaussian or None, "members": members, "truth": truth, "ensemble": ensemble,
        "independent": independent or None, "nees": nees, "dof": dof, "nis": nis, "nis_dof": nis_dof,
        "innovations": innovations, "innovation_covariances": innovation_covariances, "axes": axes,
    }  # fmt: skip
    if filter is not None or hasattr(errors, "estimates"):
        _refuse(arrays, "results bring their own")
        record = record_of_filter(_source(errors), filter, name, skip)
    elif isinstance(errors, Record):
        _refuse(arrays, "a record of consistency.read brings its own")
        record = record_of_read(errors, name, optimal_gain, skip)
    else:
        if nees is not None and dof is None:
            arrays["dof"] = current().marked.get("dof")
        there = {key: value for key, value in arrays.items() if value is not None}
        record = record_of_checked(
            name or "the estimator", cast("ArrayLike | None", errors), **there, subsets=subsets,
            optimal_gain=optimal_gain, skip=skip,
        )  # fmt: skip

    return _judged("assert_consistent", record, demand, subsets, method)


def assert_program_consistent(
    argv: Sequence[str],
    *,
    runs: int | None = None,
    estimates: str = "estimates.csv",
    truth: str | Path | None = None,
    out: str | Path | None = None,
    filter: str | None = None,
    false_alarm: float | None = None,
    detect: float | None = None,
    power: float | None = None,
    tolerance: float | None = None,
    allow: str | None = None,
    lost: float | None = None,
    **options: Any,
) -> Verdict:
    """Run a program many times, and pass it if the errors that it writes are shown to have the stated covariance.

    The runs are those of :func:`consistency.monte_carlo`, the verdict is that of :func:`assert_consistent`.

    Parameters
    ----------
    argv : words of the command, with ``{seed}``, ``{run}``, ``{out}`` and ``{here}``
    runs : number of runs; as many as ``detect`` and ``power`` need for the errors of the first run if not given
    estimates, truth, out, filter : as for :func:`consistency.monte_carlo`
    false_alarm, detect, power, tolerance, allow, lost : as for :func:`assert_consistent`
    options : further ones of :func:`consistency.monte_carlo`, as ``jobs``, ``timeout``, ``state``

    Returns
    -------
    The verdict, of status "consistent"

    Raises
    ------
    ConsistencyError
        A fault at the stated false-alarm rate, or failed runs.
    InsufficientTrials
        No fault, and too few runs.
    InputError
        The program does not exist, all of its first runs failed alike, or its tables cannot be read.
    """
    __tracebackhide__ = True
    from consistency.referee.programs.study import record_of_program

    demand = terms(false_alarm, detect, power, allow, tolerance, lost)
    settings = _settings(demand.planned, demand)
    record = record_of_program(argv, settings, runs, estimates, truth, out, filter, options)
    return _judged("assert_program_consistent", record, demand)


def assert_not_worse(
    errors_a: ArrayLike | Tables | None = None,
    covariances_a: ArrayLike | None = None,
    errors_b: ArrayLike | None = None,
    covariances_b: ArrayLike | None = None,
    *,
    deviations_a: ArrayLike | None = None,
    deviations_b: ArrayLike | None = None,
    filter: str | None = None,
    than: str | None = None,
    reference: Tables | Baseline | str | Path | None = None,
    members_a: ArrayLike | None = None,
    members_b: ArrayLike | None = None,
    truth: ArrayLike | str | None = None,
    ensemble: int | None = None,
    independent: bool = False,
    nees_a: ArrayLike | None = None,
    nees_b: ArrayLike | None = None,
    dof: int | None = None,
    false_alarm: float | None = None,
    detect: float | None = None,
    power: float | None = None,
    axes: Sequence[str] | None = None,
    skip: int | str | None = None,
    name: str | None = None,
) -> Comparison:
    """Pass a candidate a that is not less consistent than a reference b on the same trials, row by row.

    Worse means farther from consistent, in either direction: abs(log(ANEES / dof)), compared run by run
    (:func:`consistency.diagnostics.compare`).

    Parameters
    ----------
    errors_a, covariances_a, errors_b, covariances_b : as in :func:`assert_consistent`; row i of both is one trial
    deviations_a, deviations_b : in place of covariances, as in :func:`assert_consistent`; the mean NEES without cross
        terms is that of a right filter under any correlation
    members_a, members_b, truth, ensemble, independent : of both, as in :func:`assert_consistent`; ranks among as many
        members are compared. Bounds are not: two verdicts have their factors
    nees_a, nees_b, dof : (runs, steps) and the dimension of the error, in place of them
    filter, than : names of the candidate and its reference, in results given as ``errors_a``
    reference : other results, or a baseline or its file, in place of the same results; ``than`` is then ``filter``
        unless it is given. Trials of another scenario or seed are compared as independent samples.
    false_alarm : probability of rejecting a candidate that is as consistent as the reference
    detect : a covariance ratio farther from 1 by this factor must be found
    power : probability of finding it
    axes : names of the components
    skip : first steps of each run to leave out of both, as in :func:`assert_consistent`
    name : of the candidate, for messages

    Raises
    ------
    ConsistencyError
        The candidate is worse at the stated false-alarm rate, or has more failed runs on the same trials.
    InsufficientTrials
        Not worse, and fewer runs than ``detect`` and ``power`` need, given the spread between these runs.
    ValueError
        Input that :func:`assert_consistent` refuses, or different numbers of runs.
    """
    __tracebackhide__ = True
    demand = terms(false_alarm, detect, power, None)
    arrays: dict[str, Any] = {
        "covariances_a": covariances_a, "errors_b": errors_b, "covariances_b": covariances_b,
        "deviations_a": deviations_a, "deviations_b": deviations_b, "nees_a": nees_a, "nees_b": nees_b, "dof": dof,
        "axes": axes, "members_a": members_a, "members_b": members_b, "truth": truth, "ensemble": ensemble,
        "independent": independent or None,
    }  # fmt: skip
    if filter is not None or hasattr(errors_a, "estimates"):
        _refuse(arrays, "results bring their own; the reference is named by than and reference")
        sides = of_filters(_source(errors_a), filter, than, _baseline(reference, skip), name, skip)
    else:
        if than is not None or reference is not None:
            raise ValueError("than and reference need results in place of errors_a")
        if nees_a is not None and dof is None:
            dof = current().marked.get("dof")
        both: dict[str, Any] = {"dof": dof, "axes": axes, "skip": skip}
        both |= {"truth": truth, "ensemble": ensemble, "independent": independent}
        a = {"errors": errors_a, "covariances": covariances_a, "deviations": deviations_a, "nees": nees_a}
        b = {"errors": errors_b, "covariances": covariances_b, "deviations": deviations_b, "nees": nees_b}
        a |= {"members": members_a, **both}
        b |= {"members": members_b, **both}
        sides = of_arrays(name or "the candidate", a, b)
    return _compare(sides, demand)


def _judged(
    gate: str,
    record: Record,
    demand: Terms,
    subsets: Mapping[str, Sequence[int]] | None = None,
    method: str = "max",
) -> Verdict:
    """The verdict on one estimator, or what its gate raises."""
    __tracebackhide__ = True

    def look(rate: float) -> GateResult:
        verdict = judge(record, _settings(rate, demand, subsets, method))
        sure = bool(record.failures) or verdict.status == "failed"
        bad = verdict.status not in ("consistent", "undecided")
        return GateResult(bad, sure, verdict.p_value, verdict.status, list(verdict.reasons), verdict)

    def needed(rate: float) -> int:
        return planned_runs(record, demand, rate)

    result = _settle(gate, record, demand, look, needed)
    assert result.verdict is not None
    return result.verdict


def _compare(sides: Sides, demand: Terms) -> Comparison:
    __tracebackhide__ = True
    if sides.usable_runs < FEWEST:
        if sides.failed_more:
            fault = f"worse than {sides.name_b}: {sides.failures.a} runs failed, of {sides.name_b} {sides.failures.b}"
            verdict = judge(sides.candidate, _settings(demand.false_alarm, demand))
            raise ConsistencyError(fault_text("assert_not_worse", sides.candidate.name, [fault]), verdict)
        raise InsufficientTrials(
            f"assert_not_worse: {sides.usable_runs} runs are too few for a standard error; simulate {FEWEST} at least",
            FEWEST,
            sides.usable_runs,
        )

    def look(rate: float) -> GateResult:
        comparison = sides.compare(rate)
        worse = comparison.worse or sides.failed_more
        status = "worse" if worse else "not worse"
        reasons = sides.reasons(comparison)
        return GateResult(worse, sides.failed_more, comparison.p_value, status, reasons, None, comparison)

    def needed(rate: float) -> int:
        detect = planned_detect(sides.candidate, demand.detect)
        return sides.compare(rate).needed_runs(detect, demand.power)

    result = _settle("assert_not_worse", sides.candidate, demand, look, needed)
    assert result.comparison is not None
    return result.comparison


# --- code of both gates ----------------------------------------------------------------------------------


def _settle(
    gate: str, record: Record, demand: Terms, look: Callable[[float], GateResult], needed: Callable[[float], int]
) -> GateResult:
    __tracebackhide__ = True
    result, late = look(demand.false_alarm), None
    runs, dof = len(record.run_numbers), planned_dof(record)
    fault = result.bad and (demand.may_fail or result.sure)
    if not fault and demand.budget is not None and result.p_value <= demand.budget:
        late = look(max(result.p_value, 1e-300))  # in case the end of the session finds it
    least = needed(demand.planned)
    few = not fault and (runs < least if result.verdict is None else result.status == "undecided")
    outcome = "fault found" if fault else "too few runs" if few else "passed"
    if few:  # ask for what is enough at the end of the session too, and for more than there are
        least = max(needed(demand.false_alarm), runs_to_decide(result, runs))
    verdict = result.verdict
    if fault and verdict is None:
        verdict = judge(record, _settings(demand.false_alarm, demand))
    page = None
    if (fault or few or late is not None) and verdict is not None:
        page = write_page(record, verdict)
    current().keep(entry_of(gate, record, demand, result, late, outcome, least, page))
    if fault:
        assert verdict is not None
        raise ConsistencyError(fault_text(gate, record.name, result.reasons), verdict, result.comparison)
    if few:
        if result.verdict is None:
            text = few_to_compare(gate, record.name, runs, least, demand)
        else:
            share, detect = demand.false_alarm / rate_shares(record), planned_detect(record, demand.detect)
            each = replace(demand, false_alarm=share, detect=detect)
            level = record.errors.bounded.bounds[0].level if record.errors.bounded else None
            text = undecided_text(gate, record.name, result.reasons[0], least, dof, each, level)
            text += marker_text(dof, runs) if level is None else ""
        raise InsufficientTrials(text, least, runs, result.verdict)
    return result


def _settings(
    rate: float, demand: Terms, subsets: Mapping[str, Sequence[int]] | None = None, method: str = "max"
) -> Settings:
    return Settings(rate, demand.detect, demand.power, demand.tolerance, demand.allow, method, subsets, demand.lost)


def _source(results: Any) -> Source:
    """Results of the bench as a source of records."""
    if not hasattr(results, "batches"):
        raise ValueError("filter names one in the results of consistency.run_trials; give those in place of errors")
    from consistency.bench.runs.results_to_records import results_source

    return results_source(results)


def _baseline(reference: Tables | Baseline | str | Path | None, skip: int | str | None) -> Baseline | None:
    """Reference of a comparison: a baseline, its file, or results of the bench in memory or in a folder."""
    from consistency.referee.verdicts.compare_sources import Baseline, baseline, read_baseline

    if reference is None or isinstance(reference, Baseline):
        return reference
    if isinstance(reference, str | Path) and not Path(reference).is_dir():
        return read_baseline(Path(reference), skip)
    from consistency.bench.runs.results_to_records import results_source

    name = str(reference) if isinstance(reference, str | Path) else "results"
    return baseline(results_source(reference), name, skip)


def _refuse(arrays: Mapping[str, Any], why: str) -> None:
    extra = [key for key, value in arrays.items() if value is not None]
    if extra:
        raise ValueError(f"{', '.join(extra)}: {why}")


__all__ = [
    "ConsistencyError",
    "InsufficientTrials",
    "assert_consistent",
    "assert_not_worse",
    "assert_program_consistent",
]
