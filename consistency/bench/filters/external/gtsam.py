"""gtsam 4.x in the bench: smoothers of all data so far, of a window, and of the whole trial, with their factors.

gtsam chooses the order of elimination, linearises again what has moved, solves, and gives the marginals; the models are
those of the belief. iSAM2: Kaess et al., Int. J. Robotics
Research 31(2), 2012. Systems are solved by QR, because a step is nearly certain across the heading.

gtsam's smoothers change in place: a state is good for one step forward, and no older one can be gone back to.

A pose is (x, y, heading), m and rad, in the world; its error is additive. A landmark is azimuth, elevation (rad) and
inverse range (1/m) about a fixed point, the place from which it was first seen by the estimate of that time. That is
a choice of variables alone: the estimate that maximises a likelihood, and its covariance to first order, do not
depend on it, but in these variables the likelihood of stereo is nearly Gaussian.

The motion of a step has noise in v and omega alone, two numbers for three: across the heading a step is certain. The
factor gives it ``ACROSS`` of the noise along, little enough that a covariance of rank two is taken for one.

A disparity is reported only inside the search range [l, h], so its density is a normal one over Z, the probability
that it is reported. With ``lam`` and ``kappa`` mean and variance of the normal cut to [l, h], in units of sigma, the
derivative of -log density by the expected disparity e is -(d - e - sigma lam) / sigma^2 and its Fisher information
kappa / sigma^2: those of a normal observation d* = e + (d - e - sigma lam) / kappa with variance sigma^2 / kappa.
Gauss-Newton on d*,
taken again in each iteration, is scoring, and ends where the likelihood with its Z is greatest. What is not modelled:
that a landmark out of view was not seen.

Where expected and measured pixels are more than ``FAR`` standard deviations apart, as on the way back to the start, the
projection would lead astray: the landmark may be expected behind the sensor. There the projection is linearised at the
measured point, which leads to the region where the likelihood itself is climbed. An observation that is still so far
off at the end, a gross error, stays linearised.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import gtsam
import numpy as np

from consistency.bench.filters.filter_inputs import bias_at, disparity_sigma, problem_of
from consistency.bench.filters.kernel.linalg import definiteness
from consistency.bench.filters.textbook import basics
from consistency.bench.filters.textbook.basics import heading_matrix, mounted
from consistency.bench.filters.textbook.inverse_range import unit_vectors, untruncated_disparity
from consistency.bench.protocols import Problem
from consistency.bench.scenario import Belief, models
from consistency.bench.types import Control, Estimates, Gaussian, Map, Observation, Trial
from consistency.referee.errors import InputError
from consistency.referee.types import Array, Failure

World = Callable[[Problem], Any]  # gives what PlanarStereo has: moved, motion, placed, sight, point, origins
MOVED = 1e-3  # m, rad, 1/m: change from which a variable is linearised again; a few per cent of the least sigma here
AGAIN = 1  # further iterations after an observation
LAG = 50  # steps that poses stay in the window, 5 s
WINDOW = 25  # steps that the smoother of the whole trial adds at a time, so that it starts near the solution
SETTLED, PASSES = 1e-6, 50  # change (m, rad, 1/m) below which that smoother has arrived, and iterations at most
FAR = 10.0  # standard deviations between what is seen and what is expected, see above
ACROSS = 1e-7  # of the noise along the heading; a covariance with a correlation above 1 - 1e-12 counts as singular
Error = Callable[[list[Array]], tuple[Array, list[Array]]]  # values to the error (r,) and its Jacobians (r, 3)


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


@dataclass
class PlanarStereo:
    """A robot in the plane with a stereo sensor, as the belief has them."""

    problem: Problem
    origins: dict[int, Array] = field(default_factory=dict)  # (3,), the point that each landmark is told from, by label

    def __post_init__(self) -> None:
        self.offset, self.axes = mounted(self.problem.belief.sensor)

    # --- motion ----------------------------------------------------------------------------------

    def moved(self, pose: Array, control: Control) -> Array:
        """Pose (3,) after a step without noise."""
        return basics.pose_after(pose, control)

    def motion(self, step: int, control: Control) -> gtsam.CustomFactor:
        """From the pose before to that of ``step``: the way in the frame of the pose before, and the turn."""
        start, noise, dt = self.problem.start, self.problem.belief.motion, control.dt
        told = np.array([dt * control.v, 0.0, dt * control.omega])
        sigmas = dt * np.array([noise.sigma_v, ACROSS * noise.sigma_v, noise.sigma_omega])

        def error(poses: list[Array]) -> tuple[Array, list[Array]]:
            before, after = poses if step > 1 else (start, *poses)
            by_after = heading_matrix(before[2]).T
            way = by_after @ (after - before)
            by_before = -by_after
            by_before[:2, 2] = way[1], -way[0]
            return way - told, [by_before, by_after] if step > 1 else [by_after]

        return custom_factor([pose_key(k) for k in (step - 1, step) if k > 0], sigmas, error)

    # --- observation -----------------------------------------------------------------------------

    def placed(self, label: int, pose: Array, z: Array) -> Array:
        """A landmark (3,) by its first observation; where it is told from is kept."""
        R, z = heading_matrix(pose[2]), z - bias_at(z[None], self.problem.belief.sensor)[0]
        way = R @ self.axes @ self._points(z)
        self.origins[label] = np.array([pose[0], pose[1], 0.0]) + R @ self.offset
        r = float(np.linalg.norm(way))
        return np.array([np.arctan2(way[1], way[0]), np.arcsin(way[2] / r), 1.0 / r])

    def sight(self, step: int, observation: Observation) -> gtsam.CustomFactor:
        """All that is seen in a step, in standard deviations."""
        labels = [int(label) for label in observation.landmarks]
        origins, n = np.array([self.origins[label] for label in labels]), 3 * len(labels)
        sensor = self.problem.belief.sensor
        bias = bias_at(observation.z, sensor)
        z = observation.z - bias
        sigma, of_d = np.tile(sensor.sigma, (len(z), 1)), disparity_sigma(z[:, 2], sensor)
        sigma[:, 2] = of_d
        points, rows = self._points(z), np.arange(n).reshape(-1, 3)

        def error(values: list[Array]) -> tuple[Array, list[Array]]:
            q, rho, by_pose, by_landmark = self.scaled(values[0], np.array(values[1:]), origins)
            expected, by_q, by_rho = self.projected(q, rho)
            far = (q[:, 0] <= 0.0) | ~(np.abs(expected - z) < FAR * sigma).all(axis=1)
            d, variance = self._unsearched(z[:, 2], expected[:, 2], of_d, bias[:, 2])
            if far.any():  # as projected at what is measured
                by_q[far] = self.projected(points[far], np.ones((far.sum(), 1)))[1] / rho[far, :, None]
                by_rho[far] = -(by_q[far] @ q[far, :, None])[..., 0] / rho[far]
                expected[far] = z[far] + (by_q[far] @ (q - rho * points)[far, :, None])[..., 0]
            aim, sigmas = z.copy(), sigma.copy()
            aim[~far, 2], sigmas[~far, 2] = d[~far], np.sqrt(variance[~far])
            by_landmark = by_q @ by_landmark
            by_landmark[:, :, 2] += by_rho
            blocks = np.zeros((len(labels), n, 3))
            blocks[np.arange(len(labels))[:, None], rows] = by_landmark / sigmas[:, :, None]
            return ((expected - aim) / sigmas).ravel(), [(by_q @ by_pose / sigmas[:, :, None]).reshape(n, 3), *blocks]

        return custom_factor([pose_key(step), *map(landmark_key, labels)], np.ones(n), error)

    def scaled(self, pose: Array, landmarks: Array, origins: Array) -> tuple[Array, Array, Array, Array]:
        """Landmarks (m, 3) in the frame of the sensor, times their inverse range: finite however far they are.

        In the robot's frame that is R'(ray + rho (origin - p)).

        Returns
        -------
        The points q (m, 3), rho (m, 1), and the Jacobians (m, 3, 3) of q by the pose and by the landmark
        """
        (sa, se), (ca, ce), rho = np.sin(landmarks[:, :2]).T, np.cos(landmarks[:, :2]).T, landmarks[:, 2:]
        turn = heading_matrix(pose[2])
        axes = turn @ self.axes  # of the sensor in the world
        apart = origins - [pose[0], pose[1], 0.0]
        body = (np.array([ce * ca, ce * sa, se]).T + rho * apart) @ turn
        by_pose, by_landmark = np.empty((len(rho), 3, 3)), np.empty((len(rho), 3, 3))
        by_pose[:, :, :2] = -rho[:, :, None] * axes[:2].T
        by_pose[:, :, 2] = np.array([body[:, 1], -body[:, 0]]).T @ self.axes[:2]
        by_landmark[:, :, 0] = np.array([-ce * sa, ce * ca]).T @ axes[:2]
        by_landmark[:, :, 1] = np.array([-se * ca, -se * sa, ce]).T @ axes
        by_landmark[:, :, 2] = apart @ axes - self.offset @ self.axes
        return (body - rho * self.offset) @ self.axes, rho, by_pose, by_landmark

    def projected(self, q: Array, rho: Array) -> tuple[Array, Array, Array]:
        """(u, v, d) (m, 3) of points q / rho, and the Jacobians by q (m, 3, 3) and by rho (m, 3)."""
        f, B = self.problem.belief.sensor.f or 0.0, self.problem.belief.sensor.B or 0.0
        x, y, h = q.T
        z = np.array(models.project(x, y, h, f, B)).T
        z[:, 2:] *= rho
        by_q = np.moveaxis(np.reshape(models.project_jacobian(x, y, h, f, B), (3, 3, -1)), -1, 0)
        by_q[:, 2] *= rho
        by_rho = np.zeros((len(q), 3))
        by_rho[:, 2] = f * B / q[:, 0]
        return z, by_q, by_rho

    def _points(self, z: Array) -> Array:
        sensor = self.problem.belief.sensor
        u, v, d = z.T
        return np.array(models.triangulate(u, v, d, sensor.f or 0.0, sensor.B or 0.0)).T

    def _unsearched(self, d: Array, expected: Array, sigma: Array | float, shift: Array) -> tuple[Array, Array]:
        """Disparities (m,) and their variances without the search range, where there is one.

        ``sigma`` is their standard deviation in px, ``shift`` (m,) the bias in px that was subtracted from them.
        """
        sensor = self.problem.belief.sensor
        if sensor.disparity is None:
            return d, np.full(len(d), sigma**2)
        low, high = sensor.disparity
        return untruncated_disparity(d, expected, sigma, (low - shift, high - shift))

    # --- landmarks -------------------------------------------------------------------------------

    def point(self, label: int, landmark: Gaussian) -> Gaussian:
        """A landmark as a point in the world, m."""
        rho, (ray, by_angles) = landmark.mean[2], unit_vectors(landmark.mean)
        J = np.column_stack([by_angles, -ray / rho]) / rho
        P = J @ landmark.covariance @ J.T
        return Gaussian(self.origins[label] + ray / rho, (P + P.T) / 2.0)


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


def pose_key(step: int) -> int:
    """Key of the pose of a step, from 1 on; the start is not a variable."""
    return int(gtsam.symbol("x", step))


def landmark_key(label: int) -> int:
    """Key of a landmark."""
    return int(gtsam.symbol("l", label))


def custom_factor(keys: Sequence[int], sigmas: Array, error: Error) -> gtsam.CustomFactor:
    """A factor with an error of vectors (3,); a sigma of 0 makes a constraint."""

    def evaluate(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        residual, J = error([values.atVector(key) for key in keys])
        if jacobians is not None:
            for i, block in enumerate(J):
                jacobians[i] = block
        return residual

    return gtsam.CustomFactor(gtsam.noiseModel.Diagonal.Sigmas(sigmas), list(keys), evaluate)
