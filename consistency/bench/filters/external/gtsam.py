"""gtsam 4.x in the bench: smoothers of all data so far and of a window, and the smoother of the whole trial.

gtsam chooses the order of elimination, linearises again what has moved, solves, and gives the marginals; the models are
those of the belief (:mod:`consistency.bench.filters.external.gtsam_factors`). iSAM2: Kaess et al., Int. J. Robotics
Research 31(2), 2012. Systems are solved by QR, because a step is nearly certain across the heading.

gtsam's smoothers change in place: a state is good for one step forward, and no older one can be gone back to.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import gtsam
import numpy as np

from consistency.bench.filters.external.gtsam_factors import PlanarStereo, landmark_key, pose_key
from consistency.bench.filters.filter_declarations import problem_of
from consistency.bench.filters.kernel.linalg import definiteness
from consistency.bench.protocols import Problem
from consistency.bench.scenario import Belief
from consistency.bench.types import Control, Estimates, Gaussian, Map, Observation, Trial
from consistency.referee.errors import InputError
from consistency.referee.types import Array, Failure

World = Callable[[Problem], Any]  # gives what PlanarStereo has: moved, motion, placed, sight, point, origins
MOVED = 1e-3  # m, rad, 1/m: change from which a variable is linearised again; a few per cent of the least sigma here
AGAIN = 1  # further iterations after an observation
LAG = 50  # steps that poses stay in the window, 5 s
WINDOW = 25  # steps that the smoother of the whole trial adds at a time, so that it starts near the solution
SETTLED, PASSES = 1e-6, 50  # change (m, rad, 1/m) below which that smoother has arrived, and iterations at most


class Unsolved(ArithmeticError):
    """gtsam could not solve its equations."""


@contextmanager
def _solving() -> Iterator[None]:
    """gtsam's complaints in one line."""
    try:
        yield
    except RuntimeError as error:
        raise Unsolved(" ".join(str(error).strip().split("\n\n")[0].split())) from error


def _isam(moved: float) -> gtsam.ISAM2Params:
    params = gtsam.ISAM2Params()
    params.setRelinearizeThreshold(moved)
    params.relinearizeSkip = 1
    params.setFactorization("QR")
    return params


@dataclass(frozen=True)
class SmootherState:
    """The smoother with all that it was given, and what it is to be given next."""

    engine: Any  # gtsam.ISAM2 or gtsam.IncrementalFixedLagSmoother
    world: Any
    guess: Array  # (3,), the last pose: the estimate, or what motion makes of it
    step: int = 0
    factors: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)
    values: gtsam.Values = field(default_factory=gtsam.Values)  # of new variables

    def moved(self, control: Control) -> SmootherState:
        step, guess = self.step + 1, self.world.moved(self.guess, control)
        self.factors.add(self.world.motion(step, control))
        self.values.insert(pose_key(step), guess)
        return replace(self, step=step, guess=guess)

    def seen(self, observation: Observation) -> None:
        for label, z in zip(observation.landmarks, observation.z, strict=True):
            if int(label) not in self.world.origins:
                self.values.insert(landmark_key(int(label)), self.world.placed(int(label), self.guess, z))
        if len(observation.landmarks):
            self.factors.add(self.world.sight(self.step, observation))

    def solved(self) -> SmootherState:
        """With the last pose as estimated, and nothing left to be given."""
        guess = self.engine.calculateEstimateVector(pose_key(self.step))
        return replace(self, guess=guess, factors=gtsam.NonlinearFactorGraph(), values=gtsam.Values())

    def marginal(self, key: int) -> Gaussian:
        """Estimate (3,) of a variable and its covariance (3, 3)."""
        P = self.engine.marginalCovariance(key)
        return Gaussian(self.engine.calculateEstimateVector(key), (P + P.T) / 2.0)

    def pose(self, step: int) -> Gaussian:
        """Pose (3,) of a step; the first has no uncertainty across the heading of the start, not even by rounding."""
        marginal = self.marginal(pose_key(step))
        if step > 1:
            return marginal
        heading = self.world.problem.start[2]
        across = np.array([-np.sin(heading), np.cos(heading), 0.0])
        along = np.eye(3) - np.outer(across, across)
        return Gaussian(marginal.mean, along @ marginal.covariance @ along)

    def map(self) -> dict[int, Gaussian]:
        return {label: self.world.point(label, self.marginal(landmark_key(label))) for label in self.world.origins}


class Incremental:
    """Maximum a posteriori of all data so far, by iSAM2, judged like a filter: in each step the last pose."""

    sensors = ("uvd",)
    innovates = False  # so that no guard can judge what it is given

    def __init__(self, name: str, world: World = PlanarStereo) -> None:
        self.name, self.world = name, world

    def init(self, problem: Problem) -> SmootherState:
        return SmootherState(self._engine(), self.world(problem), problem.start.copy())

    def predict(self, state: SmootherState, control: Control) -> SmootherState:
        return state.moved(control)

    def update(self, state: SmootherState, observation: Observation) -> tuple[SmootherState, None]:
        state.seen(observation)
        with _solving():
            self._solve(state)
            state = state.solved()
            for _ in range(AGAIN if len(observation.landmarks) else 0):
                self._solve(state)
            return state.solved(), None

    def pose(self, state: SmootherState) -> Gaussian:
        with _solving():
            return state.pose(state.step)

    def map(self, state: SmootherState) -> dict[int, Gaussian]:
        with _solving():
            return state.map()

    def _engine(self) -> Any:
        return gtsam.ISAM2(_isam(MOVED))

    def _solve(self, state: SmootherState) -> None:
        """Give the smoother what is new, and iterate once."""
        state.engine.update(state.factors, state.values)


class FixedLag(Incremental):
    """Of the poses only the last ``lag`` steps are kept, the landmarks all: older poses are marginalised for good."""

    def __init__(self, name: str, lag: int, world: World = PlanarStereo) -> None:
        super().__init__(name, world)
        self.lag = lag

    def _engine(self) -> Any:
        return gtsam.IncrementalFixedLagSmoother(float(self.lag), _isam(MOVED))

    def _solve(self, state: SmootherState) -> None:
        now = float(state.step)
        stamps = {landmark_key(label): now for label in state.world.origins}
        state.engine.update(state.factors, state.values, stamps | {pose_key(state.step): now})


class WholeTrialSmoother:
    """Maximum a posteriori of the whole trial: each pose by all data, also later ones.

    Only in the last step is that what a filter may know: there it is the ceiling.
    """

    sensors = ("uvd",)
    causal = False
    innovates = False

    def __init__(self, name: str, world: World = PlanarStereo) -> None:
        self.name, self.world = name, world

    def run(self, trial: Trial, belief: Belief) -> Estimates:
        """All poses by all data; a run that fails has none."""
        T = trial.steps
        pose, covariance, map_, failure = np.full((T, 3), np.nan), np.full((T, 3, 3), np.nan), None, None
        try:
            with _solving():
                state = self._solved(trial, belief)
                marginals = [state.pose(step) for step in range(1, T + 1)]
                map_ = _map(state.map())
            _require_definite(marginals)
            pose, covariance = np.array([m.mean for m in marginals]), np.array([m.covariance for m in marginals])
        except Unsolved as error:
            failure, map_ = Failure(self.name, trial.run, 1, str(error)), None
        return Estimates(
            self.name, trial.run, pose, covariance, np.full(T, np.nan), np.zeros(T, np.int64), failure, map=map_
        )

    def is_ready(self, trial: Trial, belief: Belief) -> bool:
        """True: there is nothing to compile."""
        return True

    def compile(self, trial: Trial, belief: Belief) -> None:
        """Nothing to do."""

    def _solved(self, trial: Trial, belief: Belief) -> SmootherState:
        state = SmootherState(gtsam.ISAM2(_isam(SETTLED)), self.world(problem_of(trial, belief)), trial.start)
        for step in range(1, trial.steps + 1):
            state = state.moved(trial.control(step))
            state.seen(trial.observation(step))
            if step % WINDOW == 0 or step == trial.steps:
                state.engine.update(state.factors, state.values)
                _settle(state.engine, step)
                state = state.solved()
        return state

    def _refuse(self, *_: Any) -> Any:
        raise InputError(
            f"filter '{self.name}' smooths whole trials and cannot be stepped; give it a trial, by run(trial, belief)"
        )

    init = predict = update = pose = _refuse


def _settle(engine: gtsam.ISAM2, step: int) -> None:
    for _ in range(PASSES):
        engine.update()
        change = np.abs(engine.getDelta().vector()).max()
        if change < SETTLED:
            return
    raise Unsolved(f"by step {step} the estimate still changes by {change:.2g} after {PASSES} iterations")


def _require_definite(marginals: list[Gaussian]) -> None:
    """As for a filter: finite, and positive definite from the first covariance of full rank on."""
    full = False
    for step, marginal in enumerate(marginals, start=1):
        rank = definiteness(marginal.covariance)
        if not np.isfinite(marginal.mean).all() or rank < 0 or (full and rank == 0):
            raise Unsolved(f"the pose of step {step} is not finite, or its covariance not positive definite")
        full = full or rank == 1


def _map(landmarks: dict[int, Gaussian]) -> Map:
    labels = sorted(landmarks)
    mean = np.array([landmarks[label].mean for label in labels]).reshape(-1, 3)
    covariance = np.array([landmarks[label].covariance for label in labels]).reshape(-1, 3, 3)
    return Map(np.array(labels, np.int64), mean, covariance)


SMOOTHERS = (Incremental("gtsam-batch-uvd"), FixedLag("gtsam-lag-uvd", LAG), WholeTrialSmoother("gtsam-map-uvd"))
FILTERS = {smoother.name: smoother for smoother in SMOOTHERS}
