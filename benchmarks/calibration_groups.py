"""Do groups of runs and steps keep their promises (``--by``)? False groups, controls, power, and the group named.

Columns are fixed before the errors are: by chance, or from what a right filter has measured so far. Controls select on
the outcome; no fault may be stated in any of them. ``calibration.py`` puts the rows into its table.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from calibration_cases import DETECT, FALSE_ALARM, POWER
from calibration_gates import Draw, first_order, row, shared, standard

import consistency as cs
from consistency.diagnostics import Settings, Verdict, judge, make_record
from consistency.errors import InputError
from consistency.referee.diagnostics.groups import column_of, groups_of
from consistency.referee.diagnostics.number_of_runs import group_runs
from consistency.referee.diagnostics.sample import Sample
from consistency.referee.diagnostics.scale import equivalence
from consistency.referee.diagnostics.verdict_parts import GROUP
from consistency.referee.types import Array

GATES, CONTROLS, POWERS = 1000, 200, 500
QUICK_GATES, QUICK_CONTROLS, QUICK_POWERS = 60, 12, 40
CLEARS, QUICK_CLEARS = 1000, 100
RATIO, OF, FOUND, NAMED, STEPS = 1.5, 5, 0.9, 0.95, 20
FALSE, CLEAR, OUTCOME = "groups, false alarm", "groups, wrong all-clear", "groups, selected on the outcome"
FINDS, NAMES = "groups, power", "groups, the right one named"

Grouped = tuple[Array, Array, Array]  # errors (R, T, n), covariances (R, T, n, n) and values of a column (R, T)


class Groups(NamedTuple):
    """Errors of a right filter with a column that was fixed before them."""

    draw: Callable[[np.random.Generator, int], Grouped]
    runs: tuple[int, ...]
    bins: int
    about: str


def _slow(rng: np.random.Generator, runs: int, n: int, steps: int = STEPS) -> tuple[Array, Array]:
    """One error in all steps of a run."""
    gate = standard(np.repeat(rng.standard_normal((runs, 1, n)), steps, axis=1))
    assert gate.error is not None
    return gate.error, np.asarray(gate.covariance)


def words(rng: np.random.Generator, runs: int) -> Grouped:
    names = np.array(["rain", "sun", "snow", "fog", "hail"])
    return *_slow(rng, runs, 3), rng.choice(names, (runs, STEPS), p=[0.5, 0.3, 0.14, 0.05, 0.01])


def settings_of_runs(rng: np.random.Generator, runs: int) -> Grouped:
    """A number for each run, and errors that are AR(.95)."""
    error = first_order(Draw(rng, runs, STEPS), np.float64(0.95), 3)
    return error, shared(np.eye(3), error), np.repeat(rng.standard_exponential((runs, 1)), STEPS, axis=1)


def slow_runs(rng: np.random.Generator, runs: int) -> Grouped:
    """20 % of the runs have one error in all steps, the others independent ones; two groups of runs."""
    error = rng.standard_normal((runs, STEPS, 1))
    slow = rng.random(runs) < 0.2
    error[slow] = error[slow, :1]
    return error, shared(np.eye(1), error), np.repeat(rng.choice(["a", "b"], (runs, 1)), STEPS, axis=1)


def fixes(rng: np.random.Generator, runs: int) -> Grouped:
    """Dead reckoning with fixes at random: the time since the last one, which P grows with."""
    since, variance, error = np.zeros(runs), np.full(runs, 0.1), np.sqrt(0.1) * rng.standard_normal((runs, 2))
    rows = []
    for _ in range(3 * STEPS):
        variance, since = variance + 0.05, since + 1.0
        error = error + np.sqrt(0.05) * rng.standard_normal((runs, 2))
        fixed = rng.random(runs) < 0.15
        gain = np.where(fixed, variance / (variance + 0.2), 0.0)
        error = error - gain[:, None] * (error + np.sqrt(0.2) * rng.standard_normal((runs, 2)))
        variance, since = (1.0 - gain) * variance, np.where(fixed, 0.0, since)
        rows.append((error, variance, since))
    errors, variances, times = (np.stack([each[i] for each in rows], axis=1) for i in range(3))
    return errors, variances[..., None, None] * np.eye(2), times


def _innovations(rng: np.random.Generator, runs: int) -> tuple[Array, Array, Array]:
    """A scalar Kalman filter: errors, covariances, and innovations (R, T) over their standard deviations."""
    variance, error, rows = 1.0, rng.standard_normal(runs), []
    for _ in range(5 * STEPS):
        variance, error = variance + 0.1, error + np.sqrt(0.1) * rng.standard_normal(runs)
        innovation, gain = error + rng.standard_normal(runs), variance / (variance + 1.0)
        scaled = innovation / np.sqrt(variance + 1.0)
        error, variance = error - gain * innovation, (1.0 - gain) * variance
        rows.append((error, np.full(runs, variance), scaled))
    errors, variances, scaled_all = (np.stack([each[i] for each in rows], axis=1) for i in range(3))
    return errors[..., None], variances[..., None, None], scaled_all


def mean_nis(rng: np.random.Generator, runs: int) -> Grouped:
    """Mean NIS so far: how long a run is in a group depends on what is measured later."""
    error, covariance, innovation = _innovations(rng, runs)
    return error, covariance, np.cumsum(innovation**2, axis=1) / np.arange(1, innovation.shape[1] + 1)


def sum_of_innovations(rng: np.random.Generator, runs: int) -> Grouped:
    error, covariance, innovation = _innovations(rng, runs)
    return error, covariance, np.cumsum(innovation, axis=1)


def satellites(rng: np.random.Generator, runs: int) -> Grouped:
    """A whole number that changes slowly, by which P is larger, and errors that are AR(.9)."""
    level = first_order(Draw(rng, runs, 2 * STEPS), np.float64(0.95), 1)[..., 0]
    count = np.clip(np.round(8.0 + 2.5 * level), 4, 13)
    white = first_order(Draw(rng, runs, 2 * STEPS), np.float64(0.9), 2)
    return white / np.sqrt(count)[..., None], np.eye(2) / count[..., None, None], count


def ragged(rng: np.random.Generator, runs: int) -> Grouped:
    """Runs of 1 to 40 steps with one error in all of them, by the step."""
    error, covariance = _slow(rng, runs, 2, 2 * STEPS)
    steps = np.arange(2 * STEPS)
    error = np.where((steps < rng.integers(1, 2 * STEPS + 1, (runs, 1)))[..., None], error, np.nan)
    return error, covariance, np.broadcast_to(1.0 * steps, (runs, 2 * STEPS))


WORLDS = {
    "words of unlike size": Groups(words, (25, 100), OF, "one error in all steps, five words in 50 to 1 % of them"),
    "setting of the run": Groups(settings_of_runs, (100, 400), 20, "AR(.95), each run in one of 20 bins"),
    "two kinds of runs": Groups(slow_runs, (45, 150), 2, "one state, 20 % of the runs slow, two groups of runs"),
    "time since a fix": Groups(fixes, (25, 100), OF, "dead reckoning and fixes at random, by the time since the last"),
    "mean NIS so far": Groups(mean_nis, (25, 100), OF, "a scalar Kalman filter, by its mean NIS so far"),
    "sum of innovations": Groups(sum_of_innovations, (25, 100), 10, "the same filter, by its innovations added up"),
    "satellites": Groups(satellites, (25, 100), OF, "AR(.9), by a whole number that changes slowly, as P does"),
    "steps of ragged runs": Groups(ragged, (25, 100), 20, "one error in all steps of runs of 1 to 40, by the step"),
}
QUICK_WORLDS = {"words of unlike size": 25, "mean NIS so far": 100}


# --- what selects on the outcome ------------------------------------------------------------------------------


class Rows(dict[str, Array]):
    """A table in memory."""

    @property
    def columns(self) -> list[str]:
        return list(self)


def _table(truth: Array, estimate: Array, variance: Array, column: str, values: Array) -> Rows:
    """A table of independent runs of a few steps, (R, T)."""
    runs, steps = truth.shape
    run, step = np.divmod(np.arange(runs * steps), steps)
    flat = {"x": estimate, "true_x": truth, "P_x_x": variance, column: values}
    return Rows(run=run, step=step + 1, **{name: array.ravel() for name, array in flat.items()})


def of_truth(rng: np.random.Generator) -> tuple[Rows, str]:
    """A right Bayesian estimate of a random truth, by the size of the truth."""
    truth = rng.standard_normal((100, STEPS))
    measured = truth + rng.standard_normal(truth.shape)
    return _table(truth, 0.5 * measured, np.full(truth.shape, 0.5), "far", np.abs(truth)), "far"


def of_estimate(rng: np.random.Generator) -> tuple[Rows, str]:
    """Least squares, by the size of the estimate."""
    truth = rng.standard_normal((100, STEPS))
    estimate = truth + rng.standard_normal(truth.shape)
    return _table(truth, estimate, np.ones(truth.shape), "far", np.abs(estimate)), "far"


def of_sigma(rng: np.random.Generator) -> tuple[Rows, str]:
    """A sigma from five residuals, by itself."""
    error, variance = rng.standard_normal((100, STEPS)), rng.chisquare(5, (100, STEPS)) / 5.0
    return _table(np.zeros_like(error), -error, variance, "quality", np.sqrt(variance)), "quality"


def of_nees(rng: np.random.Generator) -> tuple[Rows, str]:
    """A right estimator, by its NEES."""
    error = rng.standard_normal((100, STEPS))
    return _table(np.zeros_like(error), -error, np.ones(error.shape), "score", error**2), "score"


CONTROL = {
    "size of the truth": (of_truth, "a right Bayesian estimate of a random truth, by the size of the truth"),
    "size of the estimate": (of_estimate, "least squares, by the size of the estimate"),
    "sigma of 5 residuals": (of_sigma, "a sigma from five residuals, by that sigma"),
    "the NEES": (of_nees, "a right estimator, by its NEES, which is refused"),
}
EACH, THROUGH = "each run in one group", "runs through all groups"
ABOUT = {
    **{world: groups.about for world, groups in WORLDS.items()},
    **{world: about for world, (_, about) in CONTROL.items()},
    EACH: "one error in all steps of a run, which is in one of five groups",
    THROUGH: "one error in all steps of a run, which passes through five groups",
    FALSE: "a right filter is found at fault in some group",
    CLEAR: "a group whose covariance is wrong by `detect` is called consistent",
    OUTCOME: "a fault in a group is stated where the column selects on the outcome",
    FINDS: "a covariance wrong by the ratio in one of five groups is found, with the runs of `plan --groups 5`",
    NAMES: "of these, the group that is named first is the wrong one",
}


def rows(quick: bool, seed: int) -> list[dict[str, Any]]:
    return [*_false(quick, seed), *_clear(quick, seed), *_outcome(quick, seed), *_power(quick, seed)]


def grouped(error: Array, covariance: Array, values: Array, bins: int | Sequence[float]) -> Verdict:
    groups = groups_of(column_of("by", values), bins, np.isfinite(error[..., 0]))
    return judge(make_record("grouped", error, covariance, groups=groups), Settings(FALSE_ALARM, DETECT, POWER))


def _false(quick: bool, seed: int) -> Iterator[dict[str, Any]]:
    gates = QUICK_GATES if quick else GATES
    for k, (world, of) in enumerate(WORLDS.items()):
        for runs in of.runs:
            if quick and QUICK_WORLDS.get(world) != runs:
                continue
            rng = np.random.default_rng((seed, 121, k, runs))
            found = sum(GROUP in grouped(*of.draw(rng, runs), of.bins).faults for _ in range(gates))
            yield row(world, FALSE, 1.0, runs, FALSE_ALARM, "<=", gates, found)


def _clear(quick: bool, seed: int) -> Iterator[dict[str, Any]]:
    """Groups, of studies in which all have a ratio at either end of the interval, that are called consistent."""
    studies, settings = QUICK_CLEARS if quick else CLEARS, Settings(FALSE_ALARM, DETECT, POWER)
    for k, world in enumerate(list(QUICK_WORLDS) if quick else list(WORLDS)):
        of, runs = WORLDS[world], WORLDS[world].runs[-1]
        for ratio in (DETECT, 1.0 / DETECT):
            rng, count, found = np.random.default_rng((seed, 124, k, int(ratio > 1.0))), 0, 0
            for _ in range(studies):
                error, covariance, values = of.draw(rng, runs)
                n, nees = error.shape[-1], ratio * _nees(error, covariance)
                groups = groups_of(column_of("by", values), of.bins, np.isfinite(nees))
                sample = Sample(make_record(world, nees=nees, dof=n, groups=groups), nees, n)
                number = int(rng.integers(len(groups.names)))
                one = sample.in_group(number)
                if len(one.values):
                    count += 1
                    found += equivalence(one.values, n, one.steps, settings, weights=one.counts).shown
            yield row(world, CLEAR, ratio, runs, round(1.0 - POWER, 3), "<=", count, found)


def _nees(error: Array, covariance: Array) -> Array:
    """Of errors whose covariances are diagonal, (R, T)."""
    return np.asarray((error**2 / np.diagonal(covariance, axis1=-2, axis2=-1)).sum(axis=-1))


def _outcome(quick: bool, seed: int) -> Iterator[dict[str, Any]]:
    gates = QUICK_CONTROLS if quick else CONTROLS
    for k, (world, (draw, _)) in enumerate(CONTROL.items()):
        rng = np.random.default_rng((seed, 122, k))
        found = sum(_states_a_group(*draw(rng)) for _ in range(gates))
        yield row(world, OUTCOME, 1.0, 100, 0.0, "<=", gates, found)


def _states_a_group(table: Rows, by: str) -> bool:
    """Is a fault in a group stated? It is not where the column is refused."""
    try:
        record = cs.read(table, state=["x"], by=by)
    except InputError:
        return by != "score"
    verdict = cs.judge(record)
    assert verdict.by_group is not None
    return by == "score" or GROUP in verdict.faults or any(group.status for group in verdict.by_group.groups)


def _power(quick: bool, seed: int) -> Iterator[dict[str, Any]]:
    gates, each = QUICK_POWERS if quick else POWERS, group_runs(3, RATIO, OF)
    for k, (world, runs) in enumerate({EACH: OF * each, THROUGH: each}.items()):
        rng, found, named, clear = np.random.default_rng((seed, 123, k)), 0, 0, 0
        for _ in range(gates):
            verdict, wrong = _with_one_wrong(rng, runs, world == EACH)
            assert verdict.by_group is not None
            found += GROUP in verdict.faults
            named += GROUP in verdict.faults and verdict.by_group.worst.name == wrong
            clear += any(g.status == "consistent" for g in verdict.by_group.groups if g.name == wrong)
        yield row(world, FINDS, RATIO, runs, FOUND, ">=", gates, found)
        yield row(world, NAMES, RATIO, runs, NAMED, ">=", max(found, 1), named)
        yield row(world, CLEAR, RATIO, runs, round(1.0 - POWER, 3), "<=", gates, clear)


def _with_one_wrong(rng: np.random.Generator, runs: int, alone: bool) -> tuple[Verdict, str]:
    """A verdict where P is too small by the ratio in one of five groups, and the name of the group."""
    error, covariance = _slow(rng, runs, 3)
    group, wrong = np.arange(STEPS) % OF + np.zeros((runs, 1), int), int(rng.integers(OF))
    if alone:
        group = np.repeat(np.arange(runs)[:, None] % OF, STEPS, axis=1)
    error[group == wrong] *= np.sqrt(RATIO)
    return grouped(error, covariance, np.array(list("abcde"))[group], OF), f"by is {'abcde'[wrong]}"
