"""Any filter through a trial, step by step, by its name or as an object."""

from __future__ import annotations

import sysconfig
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from consistency.bench.filters import filter_names, get_filter, usable_names
from consistency.bench.filters.filter_inputs import problem_for, random_numbers
from consistency.bench.filters.kernel.linalg import definiteness
from consistency.bench.protocols import Filter, WholeTrial, error_of, name_of, rejects
from consistency.bench.scenario import Belief
from consistency.bench.scenario.toml_tables import UNITS
from consistency.bench.types import Estimates, Info, Map, Trial
from consistency.referee.errors import InputError
from consistency.referee.geometry import ADDITIVE
from consistency.referee.parsing import one_line, require_name
from consistency.referee.types import Array, Failure, Indices

SYMMETRY = 1e-8  # relative to the largest entry, as nees() demands
LONGEST = 1000  # characters of an exception's message that are kept


@dataclass(frozen=True)
class RunRecord:
    """What a filter has said so far in a run, written as it goes; the arrays may lie where another process reads them.

    Rows are of steps 1..T. Those of the step in which the filter is may be half written.
    """

    at: Indices  # (1,), the step in which it is, 0 before the start
    pose: Array  # (T, 3)
    covariance: Array  # (T, 3, 3)
    own: Array  # (T, 3, 3), of its own error; of no meaning where that is the additive one
    nis: Array  # (T,)
    dof: Array  # (T,)
    log_det: Array  # (T,)
    rejected: Array  # (M,), bool

    @classmethod
    def empty(cls, steps: int, observations: int) -> RunRecord:
        """Room for one run."""
        at, rejected = np.zeros(1, np.int64), np.zeros(observations, bool)
        pose, covariance, own = (np.empty((steps, *shape)) for shape in ((3,), (3, 3), (3, 3)))
        nis, dof, log_det = (np.empty(steps) for _ in range(3))
        return cls(at, pose, covariance, own, nis, dof, log_det, rejected).begun()

    def begun(self) -> RunRecord:
        """The same arrays, as they are before the first step."""
        self.at[:], self.dof[:], self.rejected[:] = 0, 0, False
        for array in (self.pose, self.covariance, self.own, self.nis, self.log_det):
            array[:] = np.nan
        return self

    def estimates(
        self, name: str, run: int, error: str = ADDITIVE, *, reason: str = "", map_: Map | None = None,
        guarded: bool = False,
    ) -> Estimates:  # fmt: skip
        """Copies of what was said; with a ``reason`` the run has failed in the step in which it is."""
        step = max(int(self.at[0]), 1)
        failure = Failure(name, run, step, reason) if reason else None
        said = (self.pose, self.covariance, self.own, self.nis, self.dof, self.log_det)
        pose, covariance, own, nis, dof, log_det = (array.copy() for array in said)
        if failure is not None:
            for array in (pose, covariance, own, nis, log_det):
                array[step - 1 :] = np.nan
            dof[step - 1 :] = 0
        return Estimates(
            name, run, pose, covariance, nis, dof.astype(np.int64), failure, error, None if error == ADDITIVE else own,
            map_ if failure is None else None, self.rejected.copy() if guarded else None, log_det,
        )  # fmt: skip


NOT_THE_USERS = [str(Path(__file__).parents[2]), *map(sysconfig.get_path, ("stdlib", "purelib", "platlib"))]


def run_filter(filter_: Filter, trial: Trial, belief: Belief, record: RunRecord | None = None) -> Estimates:
    """A whole trial through a filter, compiled where it can be.

    An exception, an estimate that is not finite or a pose covariance that is not positive definite ends the run as a
    :class:`Failure` of that step.

    Raises
    ------
    InputError
        The filter's error is not a convention, nothing gives its covariance, or a whole trial's estimates have another.
    """
    if isinstance(filter_, WholeTrial):
        estimates, error = filter_.run(trial, belief), error_of(filter_)
        if estimates.error != error or (estimates.own is None) != (error == ADDITIVE):
            raise InputError(f"filter '{name_of(filter_)}': its estimates must be of the error '{error}' and carry it")
        return estimates
    return step_through(filter_, trial, belief, record)


class _Unusable(Exception):
    """What a filter gave cannot be used; the message is the whole reason."""


def step_through(filter_: Any, trial: Trial, belief: Belief, record: RunRecord | None = None) -> Estimates:
    """A whole trial through a filter by its ``init``, ``predict``, ``update`` and ``pose``.

    ``own_covariance`` is asked in each step of a filter whose error is not the additive one, ``rejected`` in each step
    of one that has it, ``map`` and ``joint`` after the last step. The filter has arrays of its own, so that it changes
    nothing for others. What it says is written into ``record`` step by step, where one is given.

    Raises
    ------
    InputError
        The filter's error is not a convention, or nothing gives its covariance; it needs the truth and there is none.
    """
    T, name, error = trial.steps, name_of(filter_), error_of(filter_)
    record = record or RunRecord.empty(T, len(trial.landmark))
    given, rank = own_arrays(trial), _Rank(error)
    reason, map_ = "", None
    problem = replace(problem_for(filter_, given, belief), rng=random_numbers(given, name))
    state: Any = None
    for step in range(1, T + 1):
        record.at[0] = step
        try:
            if step == 1:
                state = filter_.init(problem)
            state = filter_.predict(state, given.control(step))
            updated: Any = filter_.update(state, given.observation(step))
            if not isinstance(updated, tuple) or len(updated) != 2:
                raise TypeError("update must return (state, info)")
            state, info = updated
            if rejects(filter_):
                record.rejected[: trial.first[step]] = filter_.rejected(state)
            mean, covariances = _pose_and_covariances(filter_, state, error)
            if info is not None and len(info.innovation):
                record.nis[step - 1], record.dof[step - 1] = _nis(info), len(info.innovation)
                record.log_det[step - 1] = info.log_det
            _require_finite("the pose", mean)
            rank.require(covariances)
            map_ = _map(filter_, state, trial) if step == T else None
        except (Exception, GeneratorExit, SystemExit) as exception:  # whatever a user's filter throws is a result
            reason = reason_of(exception)
            break
        record.pose[step - 1], record.covariance[step - 1], record.own[step - 1] = mean, covariances[0], covariances[-1]
    return record.estimates(name, trial.run, error, reason=reason, map_=map_, guarded=rejects(filter_))


def own_arrays(trial: Trial) -> Trial:
    """The trial with read-only arrays that no one else has."""
    copies: dict[str, Any] = {name: a.copy() for name, a in vars(trial).items() if isinstance(a, np.ndarray)}
    return replace(trial, **copies)


def reason_of(exception: BaseException) -> str:
    """Why a run failed, in one sentence, whatever the exception is."""
    if isinstance(exception, _Unusable):
        return str(exception)
    try:
        text = str(exception)
    except BaseException as error:
        text = f"its message cannot be read ({type(error).__name__})"
    what = "out of memory" if isinstance(exception, MemoryError) else type(exception).__name__
    text = text if len(text) <= LONGEST else f"{text[:LONGEST]} ..."
    return f"{what}: {one_line(text.encode(errors='backslashreplace').decode(), 8 * LONGEST)}{_line_of(exception)}"


def _line_of(exception: BaseException) -> str:
    """Which method of the user's raised, and in which file and line, in brackets; empty where it was not their code."""
    frames = traceback.extract_tb(exception.__traceback__)
    own = [frame for frame in frames if not frame.filename.startswith(tuple(NOT_THE_USERS))]
    if not own:
        return ""
    return f" (in {own[0].name}, {Path(own[-1].filename).name}:{own[-1].lineno})"


def _nis(info: Info) -> float:
    """NIS of an update whose innovation (k,) and S (k, k) are finite, and S positive definite."""
    innovation = _array(info.innovation, (len(info.innovation),), "update")
    S = _array(info.S, (len(innovation), len(innovation)), "update")
    _require_finite("the innovation or its covariance", innovation, S)
    try:
        np.linalg.cholesky(S)
    except np.linalg.LinAlgError:
        raise _Unusable("the innovation covariance is not positive definite") from None
    nis = info.nis
    _require_finite("the NIS", nis)
    return nis


def _pose_and_covariances(filter_: Any, state: Any, error: str) -> tuple[Array, list[Array]]:
    """Mean (3,) of the pose and its covariance (3, 3), with that of the filter's own error where it has one."""
    estimate = filter_.pose(state)
    if not (hasattr(estimate, "mean") and hasattr(estimate, "covariance")):
        raise TypeError(f"pose must return cs.Gaussian(mean, covariance), not {type(estimate).__name__}")
    mean, P = _array(estimate.mean, (3,)), _array(estimate.covariance, (3, 3))
    if error == ADDITIVE:
        return mean, [P]
    return mean, [P, _array(filter_.own_covariance(state), (3, 3), "own_covariance")]


class _Rank:
    """Demands covariances that are finite, symmetric and, from the first own one of full rank on, positive definite."""

    def __init__(self, error: str) -> None:
        self.names, self.full = ("the pose covariance", f"the covariance of the error '{error}'"), False

    def require(self, covariances: list[Array]) -> None:
        """Raise for covariances (3, 3) that are not as they must be; the last one is of the filter's own error."""
        for name, P in zip(self.names, covariances, strict=False):
            _require_finite(name, P)
            _require_symmetric(name, P)
        rank = definiteness(covariances[-1])
        if rank < 0 or (self.full and rank == 0):
            raise _Unusable(f"{self.names[len(covariances) - 1]} is not positive definite")
        self.full = self.full or rank == 1
        if self.full and definiteness(covariances[0]) != 1:
            raise _Unusable(f"{self.names[0]} is not positive definite")


def _require_symmetric(name: str, P: Array) -> None:
    if np.abs(P - P.T).max() > SYMMETRY * np.abs(P).max():
        raise _Unusable(f"{name} is not symmetric")


def _require_finite(name: str, *values: Array | float) -> None:
    if not all(np.isfinite(each).all() for each in values):
        raise _Unusable(f"{name} is not finite")


def _map(filter_: Any, state: Any, trial: Trial) -> Map | None:
    """What ``map`` of the filter gives, sorted by label; None without that method."""
    if not callable(getattr(filter_, "map", None)):
        return None
    landmarks = filter_.map(state)
    if not isinstance(landmarks, Mapping):
        raise TypeError("map must return a dictionary of landmarks by label")
    if unknown := [label for label in landmarks if label not in range(trial.n_landmarks)]:
        raise ValueError(f"map() has a landmark {unknown[0]!r}; they are numbered 0 to {trial.n_landmarks - 1}")
    labels = sorted(int(label) for label in landmarks)
    mean, covariance = np.empty((len(labels), 3)), np.empty((len(labels), 3, 3))
    for i, label in enumerate(labels):
        estimate = landmarks[label]
        mean[i], covariance[i] = _array(estimate.mean, (3,), "map"), _array(estimate.covariance, (3, 3), "map")
        _require_finite(f"landmark {label} in the map", mean[i], covariance[i])
        _require_symmetric(f"the covariance of landmark {label} in the map", covariance[i])
    return Map(
        np.array(labels, np.int64), mean, covariance, _joint(filter_, state, [int(label) for label in landmarks])
    )


def _joint(filter_: Any, state: Any, labels: list[int]) -> Array | None:
    """Covariance of pose and landmarks, these sorted by label; ``labels`` in the order of ``map``.

    None without a method ``joint``.
    """
    if not callable(getattr(filter_, "joint", None)):
        return None
    n = 3 + 3 * len(labels)
    P = _array(filter_.joint(state).covariance, (n, n), "joint")
    _require_finite("the joint covariance of pose and map", P)
    _require_symmetric("the joint covariance of pose and map", P)
    order = np.append(0, 1 + np.argsort(labels))
    rows = (3 * order[:, None] + np.arange(3)).ravel()
    return P[np.ix_(rows, rows)]


def _array(value: Any, shape: tuple[int, ...], method: str = "pose") -> Array:
    given = np.asarray(value)
    if given.dtype.kind not in "biufO":
        raise TypeError(f"{method}() gave numbers of type {given.dtype}, not real ones")
    array = np.array(value, dtype=float)
    if array.shape != shape:
        raise ValueError(f"{method}() gave an array of shape {array.shape}, not {shape}")
    return array


def resolve_filters(
    filters: str | Filter | Sequence[str | Filter], belief: Belief, log: str | None = None
) -> list[Filter]:
    """Filters by name or as they are, checked against the sensor, of the log in a folder or of a scenario."""
    filters = [filters] if isinstance(filters, str | Filter) else filters
    instances = [get_filter(f) if isinstance(f, str) else f for f in filters]
    if not instances:
        raise InputError(f"no filter given; known: {', '.join(filter_names())}")
    for filter_ in instances:
        if isinstance(filter_, type) or not isinstance(filter_, Filter):
            hint = (
                "give an object of it, with ()" if isinstance(filter_, type) else "it needs init, predict, update, pose"
            )
            raise InputError(f"{filter_!r} is not a filter: {hint}")
    names = [name_of(f) for f in instances]
    if len(set(names)) < len(names):
        raise InputError(f"a filter is given twice: {', '.join(sorted({n for n in names if names.count(n) > 1}))}")
    built_in = filter_names()
    for given, name in zip(filters, names, strict=True):
        is_ours = isinstance(given, str) or type(given).__module__.startswith("consistency.")
        if name in built_in and not is_ours:
            raise InputError(f"filter '{name}': is a built-in filter; give yours another name")
    model = belief.sensor.model
    for filter_ in instances:
        require_name(name_of(filter_), "filter")
        error_of(filter_)
        sensors = getattr(filter_, "sensors", None)
        if sensors is not None and model not in sensors:
            fitting = [name for name in usable_names() if model in getattr(get_filter(name), "sensors", (model,))]
            raise InputError(
                f"filter '{name_of(filter_)}' works on a sensor {' or '.join(sensors)}, not '{model}'; "
                f"filters that fit: {', '.join(fitting)}"
            )
        for key in getattr(filter_, "needs", ()):
            if getattr(belief.sensor, key) is None:
                unit = f"{key}{UNITS.get(key, '')}"
                place = f"key 'belief.sensor.{unit}'" if log is None else f"{log}/sensor.toml: key '{unit}'"
                raise InputError(f"{place}: missing; filter '{name_of(filter_)}' needs it, so add it or leave it out")
    return instances
