"""A textbook filter joined with its compiled kernels: the same numbers, a whole trial at once."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np
from threadpoolctl import ThreadpoolController

from consistency.bench.filters.compiled_guard import guard_part
from consistency.bench.filters.compiler.dispatch import fits, require_fitting
from consistency.bench.filters.compiler.jit import Outlook
from consistency.bench.filters.filter_inputs import bias_at, problem_for, sensor_noise
from consistency.bench.filters.guard import Guarded
from consistency.bench.filters.kernel.loop import Outcome, trial_kernel
from consistency.bench.filters.kernel.part_functions import Data, Slam, landmark_width
from consistency.bench.filters.kernel.update_steps import REASONS
from consistency.bench.filters.parts.local import LOCAL_FROM, Local
from consistency.bench.filters.parts.parking import Parking
from consistency.bench.protocols import Filter, Problem, is_realisable, name_of
from consistency.bench.scenario import Belief, GuardSettings
from consistency.bench.types import GUARDS, Estimates, Map, Trial
from consistency.referee.errors import InputError
from consistency.referee.geometry import ADDITIVE
from consistency.referee.types import Array, Failure

# models of sensors by what the name of a filter ends in
SENSORS = {"xyz": ("xyz", "uvd"), "uvd": ("uvd",), "xy": ("relative-xy",), "rb": ("range-bearing",)}

Parts = Callable[[Problem, Array, bool], Slam]

_lock = threading.Lock()
_inside: list[Any] = []  # the limit in force, once for every trial that is running


@cache
def _libraries() -> Any:
    return ThreadpoolController()  # looking for them takes longer than a short trial


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """The last bits depend on the number of BLAS threads, and matrices of this size are slower with two."""
    with _lock:
        _inside.append(_inside[-1] if _inside else _libraries().limit(limits=1))
    try:
        yield
    finally:
        with _lock:
            limit = _inside.pop()
            if not _inside:
                limit.restore_original_limits()


class Compiled:
    """``init``, ``predict``, ``update``, ``pose``, ``map`` of the textbook's filter, and ``run`` of the kernels.

    Parameters
    ----------
    textbook : the filter in plain NumPy, with ``name`` and ``uvd``: whether it works on (u, v, d); if not, such data
        are turned into points by eq. 21
    parts : gives the parts of a filter for a problem, the controls (T, 3) of a trial, and ``uvd``
    sensors : models of sensors whose data it takes
    changes : parts in the place of those, by role

    ``local_from`` is the number of variables in the state from which the kernels update locally, where the parts
    allow it; the numbers are the same. What else ``textbook`` declares is declared of this: ``innovations`` and
    ``realisable`` (:class:`consistency.bench.protocols.Filter`), ``error``
    (:mod:`consistency.referee.geometry`), and ``needs``, the keys of ``belief.sensor`` that it cannot do
    without and others can.
    """

    local_from = LOCAL_FROM

    def __init__(self, textbook: Any, parts: Parts, sensors: tuple[str, ...], **changes: Any) -> None:
        self.textbook, self.sensors, self.uvd = textbook, sensors, textbook.uvd
        self._parts, self._changes = parts, changes
        self.innovations: str | None = getattr(textbook, "innovations", None)
        self.error: str = getattr(textbook, "error", ADDITIVE)
        self.name: str = textbook.name
        self.realisable: bool = is_realisable(textbook)
        self.needs: tuple[str, ...] = getattr(textbook, "needs", ())
        self.guard: str | None = textbook.kind if isinstance(textbook, Guarded) else None
        self.init, self.predict, self.update = textbook.init, textbook.predict, textbook.update
        self.pose, self.map = textbook.pose, textbook.map

    def guarded(self, kind: str) -> Compiled:
        """This filter behind a guard, with the textbook's behind the same guard in plain Python."""
        return Compiled(Guarded(self.textbook, kind), self._parts, self.sensors, **self._changes)

    def parts(self, problem: Problem, controls: Array) -> Slam:
        """Parts of the filter for a problem and the controls (T, 3) of a trial."""
        return self._parts(problem, controls, self.uvd)._replace(**self._changes)

    def own_covariance(self, state: Any) -> Array:
        """Covariance (3, 3) of the error that the filter declares."""
        own: Array = self.pose(state).covariance if self.error == ADDITIVE else self.textbook.own_covariance(state)
        return own

    def is_ready(self, trial: Trial, belief: Belief) -> bool:
        """Whether ``run`` starts at once on this trial, or spends seconds on compiling first."""
        return trial_kernel.is_ready(*self._arguments(trial, belief))

    def outlook(self, trial: Trial, belief: Belief) -> Outlook:
        """What ``run`` on this trial has to compile first, and how long that will take."""
        return trial_kernel.outlook(*self._arguments(trial, belief))

    def compile(self, trial: Trial, belief: Belief) -> None:
        """Compile what ``run`` needs on this trial, or load it from disk."""
        trial_kernel.compile(*self._arguments(trial, belief))

    def run(self, trial: Trial, belief: Belief) -> Estimates:
        """Estimates of all steps of ``trial``; raises InputError where it lacks what the filter needs."""
        arguments = self._arguments(trial, belief)
        with one_blas_thread():
            out: Outcome = trial_kernel(*arguments)
        failure = Failure(self.name, trial.run, out.step, REASONS[out.code]) if out.step else None
        own = None if self.error == ADDITIVE else out.own
        labels = np.flatnonzero(np.isfinite(out.points[:, 0]))
        map_ = Map(labels, out.points[labels], out.spread[labels], out.joint) if out.code == 0 else None
        return Estimates(
            self.name, trial.run, out.pose, out.covariance, out.nis, out.nis_dof, failure, self.error, own, map_,
            None if self.guard is None else out.rejected, out.log_det,
        )  # fmt: skip

    def _arguments(self, trial: Trial, belief: Belief) -> tuple[Slam, Data, int]:
        problem = problem_for(self, trial, belief)
        slam = self.parts(problem, np.array(trial.controls, float))
        z, R = sensor_noise(trial.z, belief.sensor, converted=belief.sensor.model == "uvd" and not self.uvd)
        # copies: writable and C-contiguous, so that one compiled signature serves every caller
        shift = bias_at(trial.z, belief.sensor)[:, -1]
        controls, z, R, shift, start = (
            np.array(a, float, order="C") for a in (trial.controls, z, R, shift, trial.start)
        )
        first, landmark = (np.array(a, np.int64, order="C") for a in (trial.first, trial.landmark))
        data = Data(controls, first, landmark, z, R, shift, start, trial.n_landmarks)
        w = landmark_width(slam.landmark)
        slam = self._with_covariance_update(slam, 3 + w * trial.n_landmarks)
        if self.guard is not None:
            most = int(np.diff(first).max(initial=1))
            slam = slam._replace(guard=guard_part(self.guard, belief.guard or GuardSettings(), z.shape[1], most))
        return slam, data, 3 + w * len(np.unique(landmark))

    def _with_covariance_update(self, slam: Slam, most: int) -> Slam:
        """Local updating, which takes longer to compile, only in a world in which the state may grow so large."""
        if isinstance(slam.covariance, Parking):
            slam = slam._replace(covariance=slam.covariance._replace(start=self.local_from))
        local = slam._replace(covariance=Local(self.local_from))
        slam = local if most >= self.local_from and fits(local) else slam
        require_fitting(slam)
        return slam


def guarded(filter_: Filter, kind: str) -> Any:
    """A filter behind a guard, under its name with ``+kind``; one of the bench stays compiled.

    Parameters
    ----------
    filter_ : object with ``init``, ``predict``, ``update`` and ``pose`` whose ``update`` returns :class:`Info`
    kind : "gate", "joint" or "ransac"

    Raises
    ------
    InputError
        There is no such guard, or this filter cannot be guarded.

    >>> guarded(get_filter("ekf-uvd"), "gate").name  # doctest: +SKIP
    'ekf-uvd+gate'
    """
    name = name_of(filter_)
    if kind not in GUARDS:
        raise InputError(f"filter '{name}': unknown guard '{kind}'; known: {', '.join(GUARDS)}")
    if isinstance(filter_, Guarded) or isinstance(getattr(filter_, "textbook", None), Guarded):
        raise InputError(f"filter '{name}' has a guard already; it may have one")
    if getattr(filter_, "innovates", True) is False:
        raise InputError(f"filter '{name}' cannot be guarded: it gives no innovations to judge observations by")
    return filter_.guarded(kind) if isinstance(filter_, Compiled) else Guarded(filter_, kind)


def variants(
    textbook: Callable[..., Any], method: str, parts: Parts, suffixes: str = "xyz uvd xy rb", **changes: Any
) -> dict[str, Compiled]:
    """A method on points (``METHOD-xyz``), pixels (``-uvd``), relative positions (``-xy``), and by bearings (``-rb``).

    Returns them by name. ``textbook`` makes the plain filter of a name and ``uvd``; ``changes`` are as for
    :class:`Compiled`.
    """
    plain = {s: textbook(f"{method}-{s}", uvd=s == "uvd") for s in suffixes.split()}
    return {each.name: Compiled(each, parts, SENSORS[s], **changes) for s, each in plain.items()}
