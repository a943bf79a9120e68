"""Robot-centred EKF-SLAM in inverse range, with landmarks out of sight parked: consistent at a small baseline.

Landmarks are azimuth, elevation (rad) and inverse range (1/m) in the frame of the sensor, where the error of stereo is
nearly Gaussian; an observation (u, v, d) is converted to the same three numbers, so that insertion and update are
linear and say nothing about the pose (Castellanos et al. 2007; Civera, Davison & Montiel 2008). Prediction moves all
landmarks through the new frame. What a landmark that is carried so for hundreds of steps says of the way back is right
to first order only; one that has not been seen for a while is therefore *parked*: it keeps its numbers in the frame of
a clone of the pose, and is carried over at once, by an iterated update, when it is seen again.

The error of pose and clones is right-invariant, T_true = Exp(xi) T; M(p) takes (dp, dheading) to xi. A return whose
turn since the clone is little known is *in doubt*. It corrects poses by decimetres, and what is known of the motion
from one clone to the next is known in the frame of the first, wherever that is moved. So the poses are moved along a
chain, E_j = E_j-1 Exp(xi_j - xi_j-1), T_j <- E_j T_j, and the covariance is *turned* with them: the error about the
moved poses is that of pose j - 1 plus Ad(E_j-1) J_l(xi_j - xi_j-1) times the difference of what is left of xi_j and
xi_j-1. The robot hangs on the last clone. Where it sees nothing but one landmark in doubt, that landmark *waits* at
its clone: the robot may then be anywhere on a circle about it, a straight line in xi, whereas a landmark in the frame
of the robot would keep p + R m / rho to first order only. From the second such step on the robot hangs on that clone,
since a turn about a point is Exp of one xi, and of a sum of many to first order only.

Two more corrections concern the conversion. A disparity is only reported inside the search range of the matcher, so
its mean and variance are those of a truncated normal about what is predicted; and the mean of the conversion is not
the conversion of the mean, to second order in the noise of u and v. The noise of the conversion is taken where the
observation is predicted: taken where it was measured, it would give more weight to errors of one sign.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from consistency.bench.filters import plain
from consistency.bench.filters.centred import (
    Corrections,
    apart,
    bias,
    carried,
    chained,
    converted,
    left_jacobian,
    moved,
    observed,
    rays,
    searched,
    shift_matrix,
)
from consistency.bench.filters.compiled import Compiled
from consistency.bench.filters.covariance_update.parking import Parking
from consistency.bench.filters.error.invariant_pose import InvariantPose
from consistency.bench.filters.kernel.slam import Slam
from consistency.bench.filters.landmark.inverse_range import InverseRange
from consistency.bench.filters.parts import motion_of, sensor_of
from consistency.bench.filters.plain_sensors import bias_at, variance_at
from consistency.bench.filters.sensor.conversion import Pixels
from consistency.bench.filters.sensor.growth import growth_of
from consistency.bench.filters.update import reactivation  # noqa: F401, registers the update
from consistency.bench.filters.update.converting import Converted, Converting
from consistency.bench.protocols import Problem
from consistency.bench.types import Control, Gaussian, Info, Observation
from consistency.referee.errors import InputError
from consistency.referee.geometry import wrap
from consistency.referee.types import Array

EVERY, UNSEEN = 50, 20  # steps between two rounds of parking, and without a sight before a landmark is parked
DOUBT = 0.02  # rad, standard deviation of the turn since its clone from which a landmark's return is no linear update
KNOWN = 0.03  # relative standard deviation of its distance up to which a landmark may wait
PASSES, SETTLED = 20, 1e-3  # of an update at most, and the change in standard deviations that ends it
PASSES_CHAINED = 12  # and in a chain: one that has not settled by then is given up, and each pose moved by itself
TEMPERED = 2.0  # decades by which the noise of a return in doubt is raised in the first pass; then half a decade less

Chart = Callable[[Array, Array], tuple[Array, Array]]  # poses and errors (k, 3) to moved poses and (3 k, 3 k)


@dataclass(frozen=True)
class CentredState:
    """Pose and blocks of three: clones of the pose, and landmarks, active or parked at a clone."""

    x: Array  # (n,), the pose; xi of a clone; a, e, rho of a landmark
    P: Array  # (n, n), of dp, dheading; and of the errors of these
    problem: Problem
    step: int = 0
    noise: Array = field(default_factory=lambda: np.zeros((3, 2)))  # (n, 2), what the last motion added to the errors
    places: dict[int, int] = field(default_factory=dict)  # offset of each landmark by label
    seen: dict[int, int] = field(default_factory=dict)  # step at which each was seen last
    parked: dict[int, int] = field(default_factory=dict)  # number of the clone at which a landmark is parked, by label
    clones: dict[int, int] = field(default_factory=dict)  # offset of each clone by number
    origins: dict[int, Array] = field(default_factory=dict)  # pose T (3,) of each, which is Exp(xi) T


class Solution(NamedTuple):
    """An update with k numbers, as the last pass found it."""

    delta: Array  # (n,), xi of the pose, of clones in the sense of the chart, and errors of landmarks
    C: Array  # (n, n), error about where the pass began / d delta
    H: Array  # (k, n), by delta
    S: Array  # (k, k)
    W: Array  # (n, k)
    innovation: Array  # (k,)
    is_settled: bool


class RobotCentredKalman:
    """EKF-SLAM in a robot-centred map of inverse ranges, every Jacobian by its definition."""

    robot = plain.Unicycle()
    sensors = ("uvd",)

    def __init__(self, name: str, which: Corrections) -> None:
        self.name, self.which = name, which
        self.needs = ("disparity",) if which.truncation else ()

    def init(self, problem: Problem) -> CentredState:
        sensor = problem.belief.sensor
        if sensor.model != "uvd":
            raise InputError(f"filter '{self.name}' needs a uvd sensor, and belief.sensor.model is '{sensor.model}'")
        if self.which.truncation:
            searched(sensor, self.name)
        return CentredState(problem.start.copy(), np.zeros((3, 3)), problem)

    def predict(self, state: CentredState, control: Control) -> CentredState:
        belief, x, n = state.problem.belief, state.x.copy(), len(state.x)
        F, G = np.eye(n), np.zeros((n, 2))
        F[:3, :3], G[:3] = self.robot.jacobians(x[:3], control)
        x[:3] = self.robot.move(x[:3], control)
        active = [at for label, at in state.places.items() if label not in state.parked]
        if active:
            rows = np.array(active)[:, None] + np.arange(3)
            forward, turn = control.dt * control.v, control.dt * control.omega
            R = plain.heading_matrix(-turn)
            y, J, D, b = carried(x[rows], R, -R[:, 0] * forward, belief.sensor)
            rho = x[rows][:, 2:]
            x[rows] = y
            F[rows[:, :, None], rows[:, None, :]] = J
            by_forward, by_turn = -rho * R[:, 0], np.stack([b[:, 1], -b[:, 0], np.zeros(len(b))], axis=1)
            G[rows] = control.dt * (D @ np.stack([by_forward, by_turn], axis=2))
        noise = G * [belief.motion.sigma_v, belief.motion.sigma_omega]
        return replace(state, x=x, P=F @ state.P @ F.T + noise @ noise.T, step=state.step + 1, noise=noise)

    def update(self, state: CentredState, observation: Observation) -> tuple[CentredState, Info]:
        labels = [int(label) for label in observation.landmarks]
        known = np.array([label in state.places for label in labels], dtype=bool)
        info = Info(np.zeros(0), np.zeros((0, 0)), np.zeros((len(state.x), 0)))
        bias = bias_at(observation.z, state.problem.belief.sensor)
        unbiased = observation.z - bias
        if known.any():
            seen = [label for label in labels if label in state.places]
            state, info = self._correct(state, seen, unbiased[known], bias[known, 2])
        for label, z in zip(np.array(labels)[~known], unbiased[~known], strict=True):
            state = self._inserted(state, int(label), z)
        state = replace(state, seen=state.seen | dict.fromkeys(labels, state.step))
        if self.which.parking and state.step % EVERY == 0:
            state = _parked(state)
        return state, info

    def _correct(self, state: CentredState, seen: list[int], z: Array, shift: Array) -> tuple[CentredState, Info]:
        is_parked = np.array([label in state.parked for label in seen])
        in_doubt = np.array([self._is_in_doubt(state, label) for label in seen])
        new = np.array([state.step - state.seen[label] > 1 for label in seen])
        attempts: list[tuple[Chart, int]] = [(apart, PASSES if self.which.iteration and is_parked.any() else 1)]
        if self.which.turning and in_doubt.any():
            state = _settled(state)
            held = [state.parked[label] for label in np.array(seen)[in_doubt & ~new]]
            chain = partial(chained, on=sorted(state.clones).index(min(held, default=max(state.clones))))
            attempts.insert(0, (chain, PASSES_CHAINED))
        T = _shifts(state)
        P = T @ state.P @ T.T  # of the pose, too, by xi from here on
        for chart, passes in attempts:
            found = self._solved(state, P, seen, z, shift, is_parked, in_doubt, new, chart, passes)
            if found.is_settled:
                break
        after, turned = _moved_by(state, found.delta), np.eye(len(state.x))
        if chart is not apart:
            (after, _), turned = _charted(state, found.delta, chart), found.C
        turned = np.linalg.inv(_shifts(after)) @ turned
        after = replace(after, P=turned @ (P - found.W @ found.S @ found.W.T) @ turned.T)
        back = [label for label in seen if label in state.parked]
        if self.which.waiting and len(seen) == 1 and in_doubt.any() and self._waits(state, seen[0]):
            back = []
        return _activated(after, back), Info(found.innovation, found.S, found.W)

    def _solved(
        self, state: CentredState, P: Array, seen: list[int], z: Array, shift: Array, is_parked: Array,
        in_doubt: Array, new: Array, chart: Chart, passes: int,
    ) -> Solution:  # fmt: skip
        """The update by at most so many passes of Gauss-Newton, in a chart of the poses."""
        delta, expected, deviation = np.zeros(len(P)), np.zeros((len(seen), 3)), np.sqrt(np.diag(P))
        is_chained = self.which.turning and bool(in_doubt.any())  # tried, or given up: all clones are in the update
        involved = _involved(state, state.clones if is_chained else _clones_of(state, seen), seen)
        is_tempered, is_settled = bool((in_doubt & new).any()), False
        for i in range(passes):
            here, C = _charted(state, delta, chart)
            h, H = _expected(here, seen)
            H = H @ C
            expected = np.where(is_parked[:, None] | (i == 0), h, expected)
            y, R = observed(z, shift, expected, state.problem.belief.sensor, self.which)
            if is_tempered:
                R[in_doubt] *= max(1.0, 10.0 ** (TEMPERED - 0.5 * i))
            gap = y - h
            gap[:, 0] = wrap(gap[:, 0])
            innovation = gap.ravel() + H @ delta
            S, W = plain.gain(P, H, plain.block_diagonal(R))
            before, delta = delta, W @ innovation
            is_settled = i >= (2 * TEMPERED if is_tempered else 1)
            is_settled = is_settled and bool(np.all((np.abs(delta - before) <= SETTLED * deviation)[involved]))
            if is_settled:
                break
        return Solution(delta, C, H, S, W, innovation, is_settled)

    def _is_in_doubt(self, state: CentredState, label: int) -> bool:
        """Whether the turn since the clone of a parked landmark was little known before the motion of this step."""
        if not self.which.iteration or label not in state.parked:
            return False
        clone = state.clones[state.parked[label]] + 2
        turn = state.P[2, 2] + state.P[clone, clone] - 2.0 * state.P[2, clone]
        return bool(turn - state.noise[2] @ state.noise[2] > DOUBT**2)

    def _waits(self, state: CentredState, label: int) -> bool:
        """Whether the distance of a parked landmark from its clone is well known."""
        rho = state.places[label] + 2
        return bool(state.P[rho, rho] < (KNOWN * state.x[rho]) ** 2)

    def _inserted(self, state: CentredState, label: int, z: Array) -> CentredState:
        sensor, n = state.problem.belief.sensor, len(state.x)
        (y,), (J,) = converted(z[None], sensor)
        if self.which.debiasing:
            y = y - bias(z[None], sensor)[0]
        P = np.zeros((n + 3, n + 3))
        P[:n, :n], P[n:, n:] = state.P, J @ variance_at(z[None], sensor).reshape(3, 3) @ J.T
        return replace(state, x=np.append(state.x, y), P=P, places=state.places | {label: n})

    def forget(self, state: CentredState, landmark: int) -> CentredState:
        parked = {label: number for label, number in state.parked.items() if label != landmark}
        return _without_idle_clones(_without(replace(state, parked=parked), state.places[landmark]))

    def pose(self, state: CentredState) -> Gaussian:
        return Gaussian(state.x[:3], state.P[:3, :3])

    def map(self, state: CentredState) -> dict[int, Gaussian]:
        points = {label: _world_point(state, label) for label in state.places}
        return {label: Gaussian(point, D @ state.P @ D.T) for label, (point, D) in points.items()}

    def joint(self, state: CentredState) -> Gaussian:
        points = [_world_point(state, label) for label in state.places]
        mean = np.concatenate([state.x[:3], *(point for point, _ in points)])
        D = np.vstack([np.eye(3, len(state.x)), *(D for _, D in points)])
        return Gaussian(mean, D @ state.P @ D.T)


def _block(at: int) -> slice:
    return slice(at, at + 3)


def _moved_by(state: CentredState, delta: Array) -> CentredState:
    """The state moved by an error (n,): the pose by Exp, all else by a sum."""
    x = state.x + delta
    x[:3] = moved(state.x[:3], delta[:3])
    return replace(state, x=x)


def _charted(state: CentredState, delta: Array, chart: Chart) -> tuple[CentredState, Array]:
    """The state moved by an error (n,), every clone to where it is then; d error about that / d error, (n, n)."""
    numbers = sorted(state.clones)  # in the order of time
    at = np.array([*(state.clones[number] for number in numbers), 0])[:, None] + np.arange(3)
    poses = np.array([*(state.origins[number] for number in numbers), state.x[:3]])
    x, C = state.x + delta, np.eye(len(delta))
    x[:3] = delta[:3]
    poses, C[np.ix_(at.ravel(), at.ravel())] = chart(poses, x[at])
    x[at] = 0.0
    x[:3] = poses[-1]
    return replace(state, x=x, origins=dict(zip(numbers, poses[:-1], strict=True))), C


def _settled(state: CentredState) -> CentredState:
    """Every clone at the pose it has, with the covariance of the error about that."""
    after, C = _charted(state, np.zeros(len(state.x)), apart)
    return replace(after, P=C @ state.P @ C.T)


def _clones_of(state: CentredState, seen: list[int]) -> set[int]:
    return {state.parked[label] for label in seen if label in state.parked}


def _involved(state: CentredState, clones: Collection[int], seen: list[int]) -> Array:
    """Indices of the pose, of the landmarks ``seen``, and of ``clones``."""
    starts = [0, *(state.places[label] for label in seen), *(state.clones[number] for number in clones)]
    return np.add.outer(starts, np.arange(3)).ravel()


def _shifts(state: CentredState) -> Array:
    """(n, n), from the additive error of the pose to xi; the identity elsewhere."""
    T = np.eye(len(state.x))
    T[:3, :3] = shift_matrix(state.x[:3])
    return T


def _clone(state: CentredState, number: int) -> tuple[slice, Array, Array]:
    """Where a clone is in the state, its pose (3,), and d xi about that pose / d xi about its origin (3, 3)."""
    at = _block(state.clones[number])
    return at, moved(state.origins[number], state.x[at]), left_jacobian(state.x[at])


def _expected(state: CentredState, seen: list[int]) -> tuple[Array, Array]:
    """What is expected of landmarks, (m, 3), and its Jacobian (3 m, n), by xi of the pose about this state."""
    h, H = np.zeros((len(seen), 3)), np.zeros((3 * len(seen), len(state.x)))
    for i, label in enumerate(seen):
        rows, at = _block(3 * i), _block(state.places[label])
        if label not in state.parked:
            h[i], H[rows, at] = state.x[at], np.eye(3)
            continue
        clone, pose, J = _clone(state, state.parked[label])
        h[i], H[rows, at], by_shift = _seen_from(state, pose, state.x[at])
        H[rows, clone], H[rows, :3] = by_shift @ J, -by_shift
    return h, H


def _seen_from(state: CentredState, clone: Array, y: Array) -> tuple[Array, Array, Array]:
    """A landmark parked at ``clone`` as it is seen now, and its derivatives by y and by xi_clone - xi, (3, 3) each."""
    pose = state.x[:3]
    Rt = plain.heading_matrix(pose[2]).T
    R, t = Rt @ plain.heading_matrix(clone[2]), Rt @ np.array([*(clone[:2] - pose[:2]), 0.0])
    (there,), (J,), (D,), (b,) = carried(y[None], R, t, state.problem.belief.sensor)
    W = Rt.T @ b + y[2] * np.array([*pose[:2], 0.0])  # rho times the point in the world
    by_shift = np.column_stack([y[2] * Rt[:, 0], y[2] * Rt[:, 1], Rt @ [-W[1], W[0], 0.0]])
    return there, J, D @ by_shift


def _activated(state: CentredState, labels: list[int]) -> CentredState:
    """Landmarks that were parked, in the frame of the sensor again; clones that no landmark needs are dropped."""
    if not labels:
        return state
    x, T = state.x.copy(), np.eye(len(state.x))
    M = shift_matrix(x[:3])
    for label in labels:
        at, (clone, pose, J) = _block(state.places[label]), _clone(state, state.parked[label])
        x[at], T[at, at], by_shift = _seen_from(state, pose, state.x[at])
        T[at, clone], T[at, :3] = by_shift @ J, -by_shift @ M
    parked = {label: number for label, number in state.parked.items() if label not in labels}
    return _without_idle_clones(replace(state, x=x, P=T @ state.P @ T.T, parked=parked))


def _without(state: CentredState, gone: int) -> CentredState:
    """The state without the block at ``gone``."""
    keep = np.delete(np.arange(len(state.x)), _block(gone))

    def moved_up(places: dict[int, int]) -> dict[int, int]:
        return {key: at - 3 if at > gone else at for key, at in places.items() if at != gone}

    places, clones = moved_up(state.places), moved_up(state.clones)
    return replace(state, x=state.x[keep], P=state.P[np.ix_(keep, keep)], places=places, clones=clones)


def _without_idle_clones(state: CentredState) -> CentredState:
    for number in set(state.clones) - set(state.parked.values()):
        state = _without(state, state.clones[number])
    return state


def _parked(state: CentredState) -> CentredState:
    """Active landmarks unseen for a while, at one new clone of the pose."""
    labels = [label for label in state.places if label not in state.parked and state.step - state.seen[label] >= UNSEEN]
    if not labels:
        return state
    n, number = len(state.x), max(state.clones, default=0) + 1
    T = np.vstack([np.eye(n), np.zeros((3, n))])
    T[n:, :3] = shift_matrix(state.x[:3])
    return replace(
        state, x=np.append(state.x, np.zeros(3)), P=T @ state.P @ T.T,
        parked=state.parked | dict.fromkeys(labels, number), clones=state.clones | {number: n},
        origins=state.origins | {number: state.x[:3]},
    )  # fmt: skip


def _world_point(state: CentredState, label: int) -> tuple[Array, Array]:
    """A landmark as a point (3,) in the world, m, and its Jacobian (3, n)."""
    at, frame, pose, to_shift = _block(state.places[label]), slice(0, 3), state.x[:3], shift_matrix(state.x[:3])
    if label in state.parked:
        frame, pose, to_shift = _clone(state, state.parked[label])
    mount = state.problem.belief.sensor.mount.packed()
    offset, axes = np.array(mount[:3]), np.reshape(mount[3:], (3, 3))
    (m,), (dm,) = rays(state.x[at][None])
    rho, R = state.x[at][2], plain.heading_matrix(pose[2])
    point = R @ (axes @ m / rho + offset) + np.array([*pose[:2], 0.0])
    D = np.zeros((3, len(state.x)))
    D[:, at] = R @ axes @ np.column_stack([dm / rho, -m / rho**2])
    D[:, frame] = np.column_stack([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-point[1], point[0], 0.0]]) @ to_shift
    return point, D


def compiled(twin: RobotCentredKalman) -> Compiled:
    """The filter with its kernel."""
    which = twin.which

    def parts(problem: Problem, controls: Array) -> Slam:
        sensor = problem.belief.sensor
        low, high = searched(sensor, twin.name) if which.truncation else (0.0, 0.0)
        su, sv, sd = sensor.sigma
        pixels = Pixels(
            su, sv, sd, growth_of(sensor), low, high, which.truncation, which.debiasing, which.prediction
        )  # fmt: skip
        every, unseen = (EVERY, UNSEEN) if which.parking else (0, 0)
        doubt, clones = DOUBT**2 if which.iteration else np.inf, len(controls) // every if which.parking else 0
        chain = PASSES_CHAINED if which.turning else 0
        return Slam(
            motion_of(problem.belief), sensor_of(problem.belief, uvd=True), InverseRange(sensor.mount.packed()),
            InvariantPose(), Converted(),
            Converting(pixels, KNOWN if which.waiting else 0.0, PASSES if which.iteration else 1, chain, clones),
            Parking(every, unseen, doubt, which.turning),
        )  # fmt: skip

    return Compiled(twin, parts, sensors=("uvd",), uvd=True)


PARKED = compiled(RobotCentredKalman("parked-ekf-uvd", Corrections()))
ROBOCENTRIC = compiled(
    RobotCentredKalman("robocentric-ekf-uvd", Corrections(parking=False, turning=False, iteration=False))
)
