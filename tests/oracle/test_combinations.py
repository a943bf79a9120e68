"""Every registered combination of parts: Jacobians by finite differences, a Kalman filter at the truth, the twin.

The Kalman filter linearised at the truth is exact in a world of first order. A filter that linearises elsewhere
differs from it by terms of second order: relative to standard deviations, by a multiple of the noise. So at a tenth
of the noise the gap is a tenth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from estimates import apart

import consistency as cs
from consistency.bench.filters import usable_names
from consistency.bench.filters.compiled import Compiled
from consistency.bench.filters.filter_inputs import problem_for, sensor_noise
from consistency.bench.filters.kernel.part_functions import (
    State,
    Unicycle,
    insert_error,
    landmark_width,
    move,
    observed_width,
    place,
    propagate,
    retract,
    stands_apart,
)
from consistency.bench.filters.kernel.update_steps import linearise_seen, make_scratch
from consistency.bench.filters.methods.ideal import AtTruth
from consistency.bench.filters.run_filter import step_through
from consistency.bench.filters.textbook import basics
from consistency.bench.filters.textbook.basics import SlamState, view

pytestmark = pytest.mark.usefixtures("dense")  # test_local_updating.py compares it with local updating

NAMES = [name for name in usable_names() if isinstance(cs.get_filter(name), Compiled)]
WORLDS = {
    "linear": "linear-gaussian", "xyz": "herath2007-xyz", "uvd": "herath2007-wide-baseline", "relative-xy": "esde-xy",
    "range-bearing": "range-bearing",
}  # fmt: skip
TRIANGULATED = ("predicted-ekf-xyz", "debiased-ekf-xyz")  # take points that a stereo sensor's pixels are turned into
KNOWN_BIAS = "debiased-ekf-xyz"  # what it subtracts of the first view of a landmark is taken as known
STEP = 1e-6  # of finite differences
CONVERTING = ("robocentric-ekf-uvd", "parked-ekf-uvd")  # have no h whose Jacobian is taken: see test_robocentric.py


def world_of(name):
    """Where the filter works on what the sensor gives."""
    return WORLDS[cs.get_filter(name).sensors[0]]


def mounted(name, tilted):
    """A mount with as many numbers different from zero as the sensor of the filter may have."""
    if name.endswith(("-xy", "-rb")):
        return {"position": [*tilted["position"][:2], 0.0], "rotation": [0.0, 0.0, tilted["rotation"][2]]}
    return tilted


# --- Jacobians -----------------------------------------------------------------------------------


class Bench:
    """The kernels of a filter at a state with two landmarks, and one more to come."""

    def __init__(self, name, scenario):
        trial = cs.simulate(scenario, run=1)
        filter_ = cs.get_filter(name)
        problem = problem_for(filter_, trial, scenario.belief)
        self.name, self.slam = name, filter_.parts(problem, np.array(trial.controls))
        self.w, self.n = landmark_width(self.slam.landmark), 3 + 2 * landmark_width(self.slam.landmark)
        self.s = observed_width(self.slam.sensor)
        z, _ = sensor_noise(trial.z, scenario.belief.sensor, converted=name in TRIANGULATED)
        self.labels, self.z, self.u = trial.landmark[:3], z[:3], np.array(trial.controls[0])
        self.work = make_scratch(self.slam, self.n + self.w, 3, 1, trial.n_landmarks)
        self.work.label[:2], self.work.at[:2] = self.labels[:2], [3, 3 + self.w]
        self.x = np.concatenate([trial.start + np.array([0.3, -0.2, 0.1]), np.zeros(3 * self.w)])
        for i in range(2):
            self.place(self.x, 3 + i * self.w, i, self.z[i] * (1.01, 0.98, 1.02)[: self.s])

    def state(self, x, n, P=None):
        return State(x, np.zeros((len(x), len(x))) if P is None else P, n, 0, np.zeros(200, int))

    def place(self, x, n, i, z):
        slam, label = self.slam, int(self.labels[i])
        self.stand(x, x)
        place(slam.point, slam, self.state(x, n), 0, label, z, self.work)
        if isinstance(slam.point, AtTruth):
            slam.point.landmarks[label] = x[n : n + self.w]
            place(slam.point, slam, self.state(x, n), 0, label, z, self.work)

    def stand(self, before, after):
        """A point that is not the estimate is put there, so that finite differences are the Jacobians at it."""
        if stands_apart(self.slam.point):
            path = self.slam.point.path if isinstance(self.slam.point, AtTruth) else self.work.of_point.path
            path[0], path[1] = before[: path.shape[1]], after[: path.shape[1]]

    def moved(self, x, n, error):
        """x with an error of its first n variables."""
        x = x.copy()
        retract(self.slam.error, self.slam, self.state(x, n), error[None, :n].copy(), np.ones(1), self.work)
        return x

    def along_errors(self, function, n):
        """Derivative (k, n) of a function of the state by the error of its first n variables."""
        steps = STEP * np.eye(n)
        ahead, behind = ([function(self.moved(self.x, n, sign * e)) for e in steps] for sign in (1.0, -1.0))
        return (np.array(ahead) - np.array(behind)).T / (2.0 * STEP)

    def additive_from_own(self, x, n):
        """T (n, n): what an error does to the variables at x."""
        here, self.x = self.x, x
        T = self.along_errors(lambda moved: moved[:n], n)
        self.x = here
        return T

    def expected(self, x):
        linearise_seen(self.slam, self.state(x, self.n), 0, 2, self.work)
        return self.work.zhat[: 2 * self.s].copy()

    def predicted(self, x, u, P=None):
        x, after = x.copy(), x.copy()
        move(x[:3], u, after[:3])
        self.stand(x, after)
        propagate(self.slam.error, self.slam, self.state(x, self.n, P), 0, u, np.zeros((3, 3)), self.work)
        return x


@pytest.fixture(scope="module", params=[name for name in NAMES if name not in CONVERTING])
def bench(request, small, tilted):
    name = request.param
    mount = mounted(name, tilted)
    return Bench(name, small(world_of(name), truth__sensor__mount=mount, belief__sensor__mount=mount))


def close(a, b, tolerance=1e-6):
    return bool(np.abs(a - b).max() <= tolerance * max(1.0, np.abs(b).max()))


def test_observation_jacobians_are_those_of_the_retraction(bench):
    exact = bench.along_errors(bench.expected, bench.n)
    bench.expected(bench.x)
    s = bench.s
    H = np.zeros((2 * s, bench.n))
    for i in range(2):
        rows, at = slice(s * i, s * i + s), slice(3 + i * bench.w, 3 + (i + 1) * bench.w)
        H[rows, :3], H[rows, at] = bench.work.Hp[i], bench.work.Hl[i]
    assert close(H, exact)
    assert not close(1.001 * H, exact)  # negative control


def test_motion_moves_the_covariance_of_the_error(bench, rng):
    n, sigmas = bench.n, bench.slam.motion
    assert isinstance(sigmas, Unicycle)
    after = bench.predicted(bench.x, bench.u)
    back = np.linalg.inv(bench.additive_from_own(after, n))
    F = back @ bench.along_errors(lambda x: bench.predicted(x, bench.u)[:n], n)
    G = np.zeros((n, 2))
    for j, sigma in enumerate(sigmas):
        du = STEP * np.eye(3)[1 + j]
        ahead, behind = (bench.predicted(bench.x, bench.u + sign * du)[:n] for sign in (1.0, -1.0))
        G[:, j] = back @ (ahead - behind) / (2.0 * STEP) * sigma
    A = rng.normal(size=(n, n))
    P = np.zeros((len(bench.x), len(bench.x)))
    P[:n, :n] = A @ A.T
    bench.predicted(bench.x, bench.u, P)
    expected = F @ A @ A.T @ F.T + G @ G.T
    upper = np.triu_indices(n)
    assert close(P[:n, :n][upper], expected[upper])
    assert close(P[:3, :3], expected[:3, :3])
    assert not close((A @ A.T + G @ G.T)[upper], expected[upper]) or close(F, np.eye(n))


def test_a_new_landmark_has_the_jacobians_of_its_error(bench):
    n, w, z = bench.n, bench.w, bench.z[2].copy()

    def augmented(x, z):
        x = x.copy()
        bench.place(x, n, 2, z)
        return x

    after = augmented(bench.x, z)
    insert_error(bench.slam.error, bench.x[:3], after[n:], bench.work.Jp)
    Jp, Jz = bench.work.Jp.copy(), bench.work.Jz.copy()
    back = np.linalg.inv(bench.additive_from_own(after, n + w))
    by_error = back @ bench.along_errors(lambda x: augmented(x, z), n)
    by_z = back @ np.column_stack(
        [augmented(bench.x, z + d) - augmented(bench.x, z - d) for d in STEP * np.eye(bench.s)]
    )
    assert close(Jp, by_error[n:, :3])
    assert np.abs(by_error[n:, 3:]).max() < 1e-6  # other landmarks have no part in it
    assert close(Jz, by_z[n:] / (2.0 * STEP)) == (bench.name != KNOWN_BIAS)
    assert not close(1.001 * Jz, by_z[n:] / (2.0 * STEP))


# --- a Kalman filter at the truth ------------------------------------------------------------------


@dataclass(frozen=True)
class TrueState:
    slam: SlamState
    step: int


class TrueKalman:
    """The Kalman filter of the world linearised about the true path and the true landmarks."""

    name = "at-truth"

    def __init__(self, trial, uvd):
        assert trial.truth is not None
        assert trial.landmarks is not None
        self.path, self.landmarks, self.uvd = trial.truth, trial.landmarks, uvd

    def init(self, problem):
        return TrueState(basics.start(problem), 0)

    def predict(self, state, control):
        before, x, P = self.path[state.step], state.slam.x.copy(), state.slam.P.copy()
        F, G = basics.motion_jacobians(before, control)
        x[:3] = basics.pose_after(before, control) + F @ (x[:3] - before)
        P[:3] = F @ P[:3]
        P[:, :3] = P[:, :3] @ F.T
        P[:3, :3] += basics.process_noise(G, state.slam.problem.belief)
        return TrueState(replace(state.slam, x=x, P=P), state.step + 1)

    def update(self, state, observation):
        pose, sensor = self.path[state.step], view(state.slam.problem.belief.sensor, self.uvd)
        landmarks = self.landmarks[:, : sensor.width]

        def correct(slam, seen, z, R):
            known = np.concatenate([pose, *(landmarks[label] for label in slam.landmarks)])
            zhat, H = basics.expect(replace(slam, x=known), seen, self.uvd)
            innovation = basics.innovation_of(slam, z, zhat, self.uvd) - H @ (slam.x - known)
            return basics.corrected(slam, H, innovation, R)

        def locate(slam, label, z):
            Hp, Hl = sensor.jacobians(pose, landmarks[label])
            Jz = np.linalg.inv(Hl)
            error = sensor.less(z, sensor.measure(pose, landmarks[label])) - Hp @ (slam.x[:3] - pose)
            return landmarks[label] + Jz @ error, -Jz @ Hp, Jz

        slam, info = basics.update_jointly(state.slam, observation, self.uvd, correct, locate)
        return TrueState(slam, state.step), info

    def pose(self, state):
        return basics.pose_of(state.slam)


def scaled(scenario, scale):
    """The world with all noise, true and believed, multiplied."""
    sigma = tuple(scale * s for s in scenario.belief.sensor.sigma)
    motion = scenario.belief.motion
    changes = {"motion__sigma_v": scale * motion.sigma_v, "sensor__sigma": sigma}
    changes["motion__sigma_omega"] = scale * motion.sigma_omega
    both = {f"{table}__{key}": value for table in ("truth", "belief") for key, value in changes.items()}
    return scenario.variant("scaled", **both)


def gap(name, scenario):
    """Largest distance of a filter's pose from that of the Kalman filter at the truth, in standard deviations."""
    trial, filter_ = cs.simulate(scenario, run=1), cs.get_filter(name)
    exact = step_through(TrueKalman(trial, filter_.uvd), trial, scenario.belief)
    ours = filter_.run(trial, scenario.belief)
    assert ours.failure is None
    assert exact.failure is None
    sigma = np.sqrt(np.einsum("kii->ki", exact.covariance))[5:]
    return float((np.abs(ours.pose - exact.pose)[5:] / sigma).max())


@pytest.mark.parametrize("name", [name for name in NAMES if name != "kf"])
def test_the_gap_to_the_kalman_filter_at_the_truth_shrinks_with_the_noise(small, name):
    full, tenth, hundredth = (gap(name, scaled(small(world_of(name)), scale)) for scale in (1.0, 0.1, 0.01))
    assert tenth < 0.5 * full
    assert 0.8 < np.log10(tenth / hundredth) < 1.2
    assert hundredth < 0.01


# --- twins -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_kernel_equals_its_twin_over_a_trial(small, name, tilted):
    mount = mounted(name, tilted)
    scenario = small(world_of(name), truth__steps=200, truth__sensor__mount=mount, belief__sensor__mount=mount)
    trial, filter_ = cs.simulate(scenario, run=2), cs.get_filter(name)
    ours, twin = filter_.run(trial, scenario.belief), step_through(filter_.textbook, trial, scenario.belief)
    assert apart(ours, twin) < 1e-10
    straight = small(world_of(name), truth__steps=200, truth__sensor__mount=mount)  # negative control
    assert apart(filter_.run(trial, straight.belief), twin) > 1e-6


@pytest.mark.parametrize("name", NAMES)
def test_the_map_is_that_of_the_twin(small, name):
    scenario = small(world_of(name))
    trial, filter_ = cs.simulate(scenario, run=2), cs.get_filter(name)
    state = filter_.init(problem_for(filter_, trial, scenario.belief))
    for k in range(1, trial.steps + 1):
        state, _ = filter_.update(filter_.predict(state, trial.control(k)), trial.observation(k))
    ours, twin = filter_.run(trial, scenario.belief).map, filter_.map(state)
    assert ours.landmarks.tolist() == sorted(twin)
    for label, mean, P in zip(ours.landmarks, ours.mean, ours.covariance, strict=True):
        assert close(mean, twin[label].mean, 1e-10)
        assert np.abs(P - twin[label].covariance).max() <= 1e-10 * np.abs(P).max()
    joint, rows = filter_.textbook.joint(state), np.append(0, 1 + np.argsort(list(twin)))
    rows = (3 * rows[:, None] + np.arange(3)).ravel()
    assert close(joint.mean[rows], np.append(filter_.pose(state).mean, ours.mean), 1e-10)
    assert np.abs(ours.joint - joint.covariance[np.ix_(rows, rows)]).max() <= 1e-10 * np.abs(ours.joint).max()
