"""What is done for a run and what comes of it.

Kernels are compiled before they are needed. A run leaves NEES and NIS of its steps, or a failure.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import wait
from dataclasses import dataclass, field, replace
from functools import cached_property
from multiprocessing.connection import Connection
from typing import Any, NamedTuple, Protocol

import numpy as np
from joblib.externals.loky import ProcessPoolExecutor
from joblib.externals.loky.backend import get_context
from joblib.externals.loky.backend.reduction import dumps

from consistency.bench.filters.compiled import Compiled, one_blas_thread
from consistency.bench.filters.compiler import jit
from consistency.bench.filters.compiler.jit import Outlook
from consistency.bench.filters.kernel.linalg import definiteness
from consistency.bench.protocols import Filter, WholeTrial, name_of
from consistency.bench.runs.isolation import Isolation
from consistency.bench.scenario import Belief, Scenario
from consistency.bench.simulation import World, require_landmarks_in_view
from consistency.bench.store.parquet import Columns, Rejected, truth_columns
from consistency.bench.store.results import JOINT
from consistency.bench.types import Estimates, Map, Trial
from consistency.referee.column_names import COVARIANCE, OWN_COVARIANCE, POINT_COVARIANCE, POSE
from consistency.referee.diagnostics.maps import joint_nees
from consistency.referee.diagnostics.whitening import whiten
from consistency.referee.errors import InputError
from consistency.referee.geometry import planar_error, planar_map_error, pose_error
from consistency.referee.parsing import LARGEST_NUMBER
from consistency.referee.system import announce, away_from_signals, end_with_parent, link_to_parent, say
from consistency.referee.types import Array, Failure

NAMED = 3  # filters that are named where several are compiled
EACH = "10 to 60 s for each"
Wanted = tuple[Filter, Trial, Belief]  # a filter, and a trial that it is to run on


@dataclass(frozen=True)
class RunOutcome:
    """Results of one run: rows of the tables, by filter, and failures; ``machine`` did it, None for this one."""

    run: int
    estimates: dict[str, Columns]
    truth: Columns | None
    failures: tuple[Failure, ...]
    maps: dict[str, Columns] = field(default_factory=dict)
    rejections: tuple[Rejected, ...] = ()
    machine: dict[str, str] | None = None


Outcomes = Generator[RunOutcome, None, None]


@dataclass(frozen=True)
class Simulated:
    """Trials of a scenario.

    Raises
    ------
    InputError
        No landmark can ever be seen.
    """

    scenario: Scenario
    seed: int

    def __post_init__(self) -> None:
        _ = self._world

    def __call__(self, run: int) -> Trial:
        return self._world.trial(run, self.seed)

    def __reduce__(self) -> tuple[Any, ...]:
        return Simulated, (self.scenario, self.seed)

    @cached_property
    def _world(self) -> World:
        return require_landmarks_in_view(self.scenario)


@dataclass(frozen=True)
class Recorded:
    """Trials that are there, by number of their runs."""

    trials: Mapping[int, Trial]

    def __call__(self, run: int) -> Trial:
        return self.trials[run]


@dataclass(frozen=True)
class TrialWork:
    """Trials, and the filters through which each is put; it can be pickled.

    Runs are done in a ``with`` on ``isolation``.
    """

    trials: Callable[[int], Trial]
    isolation: Isolation

    def __call__(self, run: int) -> RunOutcome:
        trial = self.trials(run)
        return outcome_of(trial, self.isolation.run(trial))

    @property
    def filters(self) -> list[Filter]:
        return self.isolation.filters

    def only(self, runs: Sequence[int]) -> TrialWork:
        """Work with what these runs need: the trials of a log are many, those of a scenario are drawn."""
        if not isinstance(self.trials, Recorded):
            return self
        return replace(self, trials=Recorded({run: self.trials.trials[run] for run in runs}))

    def compile(self, trial: Trial, jobs: int) -> None:
        """Compile what a trial needs and is not yet compiled, in ``jobs`` processes at most, and say so."""
        belief = self.isolation.belief
        compile_all(((filter_, trial, belief) for filter_ in self.isolation.compiled), jobs)


class Workers(Protocol):
    """Who does runs. The bits do not depend on it: BLAS has one thread."""

    def prepare(self, work: TrialWork, run: int, /) -> None:
        """Compile what ``run`` needs, where that is done on this machine."""

    def outcomes(self, work: TrialWork, runs: Sequence[int], /) -> Outcomes:
        """What each run left, in the order in which they end; to be closed, which stops what is not done."""


def outcome_of(trial: Trial, estimates: Sequence[Estimates]) -> RunOutcome:
    """Rows of the tables for one trial; a failed run has none from the failed step on.

    A run whose pose, covariance, NEES or NIS is beyond :data:`LARGEST_NUMBER` has failed in that step.
    """
    estimates_and_rows = [_rows(trial, e) for e in estimates]
    estimates = [e for e, _ in estimates_and_rows]
    return RunOutcome(
        trial.run,
        {e.filter: columns for e, columns in estimates_and_rows},
        None if trial.truth is None else truth_columns(trial, trial.truth),
        tuple(e.failure for e in estimates if e.failure),
        {e.filter: _map_columns(trial, e, e.map) for e in estimates if e.map is not None and e.failure is None},
        tuple(_rejected(trial, e, e.rejected) for e in estimates if e.rejected is not None),
    )


def _rejected(trial: Trial, estimates: Estimates, rejected: Array) -> Rejected:
    """Counts over the observations up to the end of the run, or to the step before its failure."""
    rows = slice(trial.first[_last(trial, estimates)])
    spurious, rejected = trial.spurious[rows], rejected[rows]
    observation_counts = (len(rejected), spurious.sum(), rejected.sum(), (rejected & spurious).sum())
    return Rejected(estimates.filter, trial.run, *(int(count) for count in observation_counts))


def _rows(trial: Trial, estimates: Estimates) -> tuple[Estimates, Columns]:
    """Rows of ``estimates``, with what they are of: a run fails in the first step with a number that is too large."""
    last, own = _last(trial, estimates), estimates.own
    # an additive covariance that is computed from ``own`` has small variances where there are none, left by rounding
    decisive = (estimates.covariance if own is None else own)[:last]
    first = next((k for k in range(last) if definiteness(decisive[k]) == 1), last)  # that has full rank
    columns = _columns(trial, estimates, last, first)
    step, reason = _first_failure(columns, first, trial.truth is not None)
    map_numbers = () if estimates.map is None else (estimates.map.mean, estimates.map.covariance)
    if not step and not all((np.abs(values) <= LARGEST_NUMBER).all() for values in map_numbers):
        step, reason = last, f"a number in the map is beyond {LARGEST_NUMBER:g}"
    if not step:
        return estimates, columns
    failure = Failure(estimates.filter, estimates.run, step, reason)
    return replace(estimates, failure=failure, map=None), {key: values[: step - 1] for key, values in columns.items()}


def _first_failure(columns: Columns, first: int, has_truth: bool) -> tuple[int, str]:
    """First step with a number that is too large, and which; 0 without one. A NEES counts after step ``first``."""
    has_nees = columns["step"] > first if has_truth else np.zeros(len(columns["step"]), bool)
    every_step = np.ones(len(has_nees), bool)
    limited = {
        "NEES": (("nees", "own_nees"), has_nees), "NIS": (("nis",), columns["nis_dof"] > 0),
        "pose": (POSE, every_step), "covariance": ((*COVARIANCE, *OWN_COVARIANCE), every_step),
    }  # fmt: skip
    faults = []
    for kind, (names, steps) in limited.items():
        largest = np.max([np.abs(columns[name]) for name in names if name in columns], axis=0)  # NaN of any NaN
        too_large = steps & ~(largest <= LARGEST_NUMBER)
        if too_large.any():
            step = int(too_large.argmax())
            beyond = f"is beyond {LARGEST_NUMBER:g}" if np.isfinite(largest[step]) else "is not finite"
            faults.append((step + 1, f"the {kind} {beyond}"))
    return min(faults, key=lambda fault: fault[0], default=(0, ""))


def _last(trial: Trial, estimates: Estimates) -> int:
    """Steps with an estimate."""
    return estimates.failure.step - 1 if estimates.failure else trial.steps


def _columns(trial: Trial, estimates: Estimates, last: int, first: int) -> Columns:
    """Columns of steps 1..``last``; there is a NEES after step ``first``."""
    pose, P = estimates.pose[:last], estimates.covariance[:last]
    true = None if trial.truth is None else trial.truth[1 : last + 1]
    columns = {
        "run": np.full(last, estimates.run),
        "step": np.arange(1, last + 1),
        "t": trial.t[1 : last + 1],
        **dict(zip(POSE, pose.T, strict=True)),
        **{name: P[:, i, j] for name, (i, j) in COVARIANCE.items()},
        "nees": _nees(None if true is None else pose_error(true, pose), P, first),
        "nis": estimates.nis[:last],
        "nis_dof": estimates.nis_dof[:last],
    }
    if estimates.own is not None:
        P, error = estimates.own[:last], None if true is None else planar_error(true, pose, estimates.error)
        columns |= {name: P[:, i, j] for name, (i, j) in OWN_COVARIANCE.items()} | {"own_nees": _nees(error, P, first)}
    return columns


def _nees(error: Array | None, P: Array, first: int) -> Array:
    """NEES of one run, (T, 3) and (T, 3, 3) -> (T,); NaN before step ``first``."""
    nees = np.full(len(P), np.nan)
    if error is not None:
        # the filter has answered for P: what nees() checks need not be checked again
        with np.errstate(over="ignore"):
            whitened = whiten(error[first:], P[first:])
            nees[first:] = np.einsum("ki,ki->k", whitened, whitened)
    return nees


def is_flat(covariance: Array) -> bool:
    """Whether landmarks (K, 3, 3) are in a plane: their heights are not variables."""
    return not covariance[:, 2].any()


def _map_columns(trial: Trial, estimates: Estimates, map_: Map) -> Columns:
    """Rows of ``map.parquet``; without NEES where the id is not a landmark of the world, or its place is not known."""
    landmark_ids, count = map_.landmarks, len(map_.landmarks)
    nees, joint = np.full(count, np.nan), np.full(count, np.nan)
    if trial.landmarks is not None:
        judged = (landmark_ids < len(trial.landmarks)) & ~np.isin(landmark_ids, trial.things)
        dof = 2 if is_flat(map_.covariance) else 3
        landmark_error = trial.landmarks[landmark_ids[judged]] - map_.mean[judged]
        whitened_landmarks = whiten(landmark_error[:, :dof], map_.covariance[judged, :dof, :dof])
        with np.errstate(over="ignore"):
            nees[judged] = _capped(np.einsum("ki,ki->k", whitened_landmarks, whitened_landmarks))
        joint[judged] = _joint_nees(trial, estimates, map_, judged)
    return {
        "run": np.full(count, trial.run),
        "landmark": landmark_ids if trial.labels is None else trial.labels[landmark_ids],
        **dict(zip("xyz", map_.mean.T, strict=True)),
        **{name: map_.covariance[:, i, j] for name, (i, j) in POINT_COVARIANCE.items()},
        "nees": nees,
        JOINT: np.where(np.isinf(joint), joint, _capped(joint)),
    }


def _capped(nees: Array) -> Array:
    """NEES of landmarks, no more than a table may hold."""
    return np.minimum(nees, LARGEST_NUMBER)


def _joint_nees(trial: Trial, estimates: Estimates, map_: Map, judged: Array) -> Array:
    """Parts (K,) of the joint NEES, in the filter's own error, of the landmarks that are ``judged``; NaN if not known.

    The part of a landmark is that given the pose and the landmarks before it: independent of the others, and
    chi-square with 3 degrees of freedom, or 2 in the plane, if the joint covariance is right.
    """
    if map_.joint is None or trial.truth is None or trial.landmarks is None:
        return np.full(int(judged.sum()), np.nan)
    landmark_ids, P = map_.landmarks[judged], map_.joint
    if not judged.all():
        kept_rows = np.repeat(np.append(True, judged), 3)
        P = P[np.ix_(kept_rows, kept_rows)]
    with one_blas_thread():
        error, P = planar_map_error(
            trial.truth[-1], trial.landmarks[landmark_ids], estimates.pose[-1], map_.mean[judged], P, estimates.error
        )
        if is_flat(map_.covariance):
            flat = np.flatnonzero(np.append([1, 1, 1], np.tile([1, 1, 0], len(landmark_ids))))
            return joint_nees(error[flat], P[np.ix_(flat, flat)], dof=2)[1:]
        return joint_nees(error, P)[1:]


class Need(NamedTuple):
    """A kernel, and a filter that compiles it for a trial."""

    filter: Compiled
    trial: Trial
    belief: Belief
    outlook: Outlook


def compile_all(wanted: Iterable[Wanted], jobs: int = 1) -> list[Need]:
    """Compile each kernel that is not yet compiled, once, and say so before.

    Parameters
    ----------
    jobs : processes that compile side by side, at most; whatever they leave undone is compiled here

    Returns
    -------
    The kernels, those that were ready too
    """
    needs: dict[str, Need] = {}
    for filter_, trial, belief in wanted:
        if isinstance(filter_, Compiled):
            need = Need(filter_, trial, belief, filter_.outlook(trial, belief))
            needs.setdefault(need.outlook.key, need)
        elif isinstance(filter_, WholeTrial) and not filter_.is_ready(trial, belief):
            say(f"compiling {name_of(filter_)}")
            filter_.compile(trial, belief)
    missing = [need for need in needs.values() if not need.outlook.is_ready]
    if missing:
        shared_kernels = [need for need in missing if need.outlook.is_shared]
        workers = min(jobs, len(shared_kernels))
        if jit.folder_fault():
            workers = 1
        announce(f"{_label(missing)}, once: {EACH}")
        if workers > 1:
            _compile_side_by_side(shared_kernels, workers)
        away_from_signals(_compile_here, missing)
    return list(needs.values())


def first_trials(worlds: Iterable[tuple[Filter, Scenario]]) -> Iterator[Wanted]:
    """Filters and a trial of the scenario that each is for; nothing where no landmark comes into view."""
    trials: dict[str, Trial | None] = {}
    for filter_, world in worlds:
        if world.hash not in trials:
            trials[world.hash] = None
            with contextlib.suppress(InputError):
                trials[world.hash] = require_landmarks_in_view(world).trial(0, 0)
        if (trial := trials[world.hash]) is not None:
            yield filter_, trial, world.belief


def _compile_here(needs: Sequence[Need]) -> None:
    """Compile kernels one after the other; those that a process has kept on disk are loaded."""
    for need in needs:
        need.filter.compile(need.trial, need.belief)


def _label(missing: Sequence[Need]) -> str:
    filter_names = list(dict.fromkeys(name_of(need.filter) for need in missing))
    if len(missing) == 1:
        return f"compiling the kernel of {filter_names[0]}"
    further_filters = f" and {len(filter_names) - NAMED} more" if len(filter_names) > NAMED else ""
    return f"compiling {len(missing)} kernels of {', '.join(filter_names[:NAMED])}{further_filters}"


# --- side by side ---------------------------------------------------------------------------------


def _compile_side_by_side(needs: Sequence[Need], workers: int) -> None:
    """Compile in processes, which keep kernels on disk; what they fail at is said where it is compiled again."""
    context = get_context("loky")
    largest_first = sorted(needs, key=lambda need: need.outlook.size, reverse=True)
    initargs = link_to_parent(context)
    pool = ProcessPoolExecutor(workers, context=context, initializer=_begin_compiler, initargs=initargs)
    try:
        with contextlib.suppress(Exception):  # no more processes, or a filter that cannot be sent
            pickled_needs = [bytes(dumps((need.filter, need.trial, need.belief))) for need in largest_first]
            wait([pool.submit(_compile_one, pickled) for pickled in pickled_needs])
    finally:
        pool.shutdown(kill_workers=True)


def _begin_compiler(parent: int, alive: Connection) -> None:
    """In a process of its own: end with the parent, leave Ctrl-C to it, and say nothing."""
    end_with_parent(parent, alive)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nowhere, stream)


def _compile_one(pickled: bytes) -> None:
    filter_, trial, belief = pickle.loads(pickled)
    filter_.compile(trial, belief)
