"""Robot-centred EKF-SLAM in inverse range, with landmarks out of sight parked: consistent at a small baseline.

Landmarks are azimuth, elevation (rad) and inverse range (1/m) in the frame of the sensor, where the error of stereo is
nearly Gaussian; an observation (u, v, d) is converted to the same three numbers, so that insertion and update are
linear and say nothing about the pose (Castellanos et al. 2007; Civera, Davison & Montiel 2008). Prediction moves all
landmarks through the new frame. What a landmark that is carried so for hundreds of steps says of the way back is right
to first order only; one that has not been seen for a while is therefore *parked*: it keeps its numbers in the frame of
a clone of the pose, and is carried over at once, by an iterated update, when it is seen again.

The error of pose and clones is right-invariant, T_true = Exp(xi) T; M(p) takes (dp, dheading) to xi. A return whose
turn since the clone is little known, or that comes where the heading itself is (*adrift*), is *in doubt*. It corrects
poses by decimetres, and what is known of the motion
from one clone to the next is known in the frame of the first, wherever that is moved. So the poses are moved along a
chain, E_j = E_j-1 Exp(xi_j - xi_j-1), T_j <- E_j T_j, and the covariance is *turned* with them: the error about the
moved poses is that of pose j - 1 plus Ad(E_j-1) J_l(xi_j - xi_j-1) times the difference of what is left of xi_j and
xi_j-1. The robot hangs on the last clone. A landmark in doubt *waits* at its clone while the turn is little known also
after the update: the robot may then be anywhere on a circle about it, a straight line in xi, whereas a landmark in the
frame of the robot would keep p + R m / rho to first order only, with an error of half its distance times the square of
the turn's. From the second such step on the robot hangs on that clone, since a turn about a point is Exp of one xi, and
of a sum of many to first order only; and the landmark waits until the turn is known better than at its first sight.
Only one whose distance is well known waits: that of another changes from update to update, and with it the point about
which the robot may turn, so that linear updates would learn of a turn that nothing has shown.

Where a return is hardly predicted, Gauss-Newton overshoots: its noise begins at what is not known of it and falls by
ten in a pass (*tempering*). A return that does not settle is left out of the update, and tried again when it is seen
next.

What an iterated update finds of the robot's error where nothing is in doubt is mostly the noise nu of the last motion,
T_true = Exp(xi) Exp(nu) T. The error about Exp(nu) T is xi, and not J_l(nu) xi (*recency*). The noise of turn and
drive also moves the mean of a landmark by half of its variance times the landmark's second derivative (*curvature*).
The covariance of the second-order terms, of this noise and of the landmark's own error, is added to that of the
landmark (*spread*). Where the robot drives through a landmark, no such expansion holds: one out of sight whose
direction or rho is known no better is forgotten (*forgetting*). A clone that was
made before its noise nu is known would be turned by nu / 2 when that is found, so that parking waits where the robot
sees nothing and saw something lately (*patience*). The covariance of the pose is that of Exp(xi) T about T
(*moments*).

Two more corrections concern the conversion. A disparity is only reported inside the search range of the matcher, so
its mean and variance are those of a truncated normal about what is predicted; and the mean of the conversion is not
the conversion of the mean, to second order in the noise of u and v. The noise of the conversion is taken where the
observation is predicted: taken where it was measured, it would give more weight to errors of one sign.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from consistency.bench.filters.filter_inputs import bias_at, variance_at
from consistency.bench.filters.textbook import basics
from consistency.bench.filters.textbook.basics import heading_matrix
from consistency.bench.filters.textbook.inverse_range import (
    Corrections,
    chained,
    conversion_bias,
    converted,
    in_new_frame,
    observed,
    pose_moments,
    poses_moved,
    searched,
    second_derivatives,
    spread_by_pairs,
)
from consistency.bench.filters.textbook.robocentric_state import (
    CentredState,
    Chart,
    activated,
    block_at,
    charted,
    clones_of,
    expectation,
    indices_of,
    moved_by,
    point_in_world,
    settled_clones,
    shifts_of,
    turn_variance,
    with_parked,
    without_block,
    without_idle_clones,
)
from consistency.bench.protocols import Problem
from consistency.bench.types import Control, Gaussian, Info, Observation
from consistency.referee.errors import InputError
from consistency.referee.geometry import wrap
from consistency.referee.types import Array

EVERY, UNSEEN = 10, 4  # steps between two rounds of parking, and without a sight before a landmark is parked
EVERY_LATE, UNSEEN_LATE = 50, 20  # without promptness
DOUBT = (
    0.02  # rad, standard deviation of the turn since its clone from which a landmark's return is not a linear update
)
ADRIFT = 0.2  # rad, standard deviation of the heading from which any return is in doubt
UNTURNED = 0.05  # rad, that of the turn after its first update, above which a landmark in doubt stays parked
KNOWN = 0.03  # relative standard deviation of its distance from the clone up to which it may
BLURRED = 0.4  # rad, and of rho: standard deviation above which a landmark out of sight is forgotten
NEAR = 0.8  # 1/m, rho from which that of rho is asked for
PASSES, SETTLED = 20, 1e-3  # of an update at most, and the change in standard deviations that ends it
PASSES_CHAINED = 16  # and in a chain: one that has not settled by then is given up, and each pose moved by itself
COOLING = 1.0  # decades a pass by which the raised noise of a return becomes less
PASSES_EARLY, TEMPERED, COOLING_EARLY = 12, 2.0, 0.5  # without tempering: decades, of a return in doubt alone


class Solution(NamedTuple):
    """An update with k numbers, as the last pass found it."""

    delta: Array  # (n,), xi of the pose, of clones in the sense of the chart, and errors of landmarks
    C: Array  # (n, n), error about where the pass began / d delta
    H: Array  # (k, n), by delta
    S: Array  # (k, k)
    W: Array  # (n, k)
    innovation: Array  # (k,)
    is_settled: bool


def rounds(which: Corrections) -> tuple[int, int]:
    """Steps between two rounds of parking, 0 for none, and without a sight before a landmark is parked."""
    if not which.parking:
        return 0, 0
    return (EVERY, UNSEEN) if which.promptness else (EVERY_LATE, UNSEEN_LATE)


def raised(HPH: Array, R: Array, which: Array) -> float:
    """Decades by which the noise (m, 3, 3) of some of the observations is below the variance (3 m, 3 m) predicted."""
    ratio = np.diag(HPH).reshape(-1, 3) / np.diagonal(R, axis1=1, axis2=2)
    return float(np.log10(max(1.0, ratio[which].max())))


class RobotCentredKalman:
    """EKF-SLAM in a robot-centred map of inverse ranges, every Jacobian by its definition."""

    sensors, uvd = ("uvd",), True

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
        F, G, Q = np.eye(n), np.zeros((n, 2)), np.zeros((n, n))
        F[:3, :3], G[:3] = basics.motion_jacobians(x[:3], control)
        sigmas = (control.dt * belief.motion.sigma_v, control.dt * belief.motion.sigma_omega)
        bends = np.zeros((n, 2))
        x[:3] = basics.pose_after(x[:3], control)
        active = [label for label in state.places if label not in state.parked]
        if active:
            rows = np.array([state.places[label] for label in active])[:, None] + np.arange(3)
            blocks = rows[:, :, None], rows[:, None, :]
            forward, turn = control.dt * control.v, control.dt * control.omega
            R = heading_matrix(-turn)
            t = -R[:, 0] * forward
            y, J, D, b = in_new_frame(x[rows], R, t, belief.sensor)
            second = second_derivatives(x[rows], R, t, belief.sensor)
            bends[rows] = 0.5 * np.square(sigmas) * np.stack([second[:, 3, 3], second[:, 4, 4]], axis=2)
            if self.which.spread and self.which.own_spread:
                Q[blocks] = spread_by_pairs(second, state.P[blocks], sigmas)
            elif self.which.spread:
                along, of_rho = D @ R[:, 0], state.P[rows[:, 2], rows[:, 2]]
                Q[blocks] = sigmas[0] ** 2 * of_rho[:, None, None] * along[:, :, None] * along[:, None, :]
            F[blocks], rho = J, x[rows][:, 2:]
            x[rows] = y + bends[rows].sum(axis=2) if self.which.curvature else y
            by_forward, by_turn = -rho * R[:, 0], np.stack([b[:, 1], -b[:, 0], np.zeros(len(b))], axis=1)
            G[rows] = control.dt * (D @ np.stack([by_forward, by_turn], axis=2))
        noise = G * [belief.motion.sigma_v, belief.motion.sigma_omega]
        if self.which.spread:  # the square of a normal of variance s^2 has mean s^2 and variance 2 s^4
            noise = np.hstack([noise, np.sqrt(2.0) * bends])
        after = replace(state, x=x, P=F @ state.P @ F.T + noise @ noise.T + Q, step=state.step + 1, noise=noise[:3])
        if self.which.forgetting:
            for label in active:
                if after.step - after.seen[label] > 1 and self._is_driven_through(
                    after, label, noise[state.places[label], 1]
                ):
                    after = self.forget(after, label)
        return after

    def update(self, state: CentredState, observation: Observation) -> tuple[CentredState, Info]:
        return self._updated(state, observation, leaving_out=self.which.waiting and self.which.iteration)

    def expected(self, state: CentredState, observation: Observation) -> tuple[CentredState, Info]:
        """As :meth:`update`, with rows of returns, too, that would not settle: for a guard."""
        return self._updated(state, observation, leaving_out=False)

    def _updated(self, state: CentredState, observation: Observation, leaving_out: bool) -> tuple[CentredState, Info]:
        labels = [int(label) for label in observation.landmarks]
        known = np.array([label in state.places for label in labels], dtype=bool)
        taken = [label for label in labels if label not in state.places]
        info = Info(np.zeros(0), np.zeros((0, 0)), np.zeros((len(state.x), 0)))
        bias = bias_at(observation.z, state.problem.belief.sensor)
        unbiased = observation.z - bias
        if known.any():
            seen = [label for label in labels if label in state.places]
            state, info, used = self._correct(state, seen, unbiased[known], bias[known, 2], leaving_out)
            taken += used
        for label, z in zip(np.array(labels)[~known], unbiased[~known], strict=True):
            state = self._inserted(state, int(label), z)
        state = replace(state, seen=state.seen | dict.fromkeys(taken, state.step))
        every, unseen = rounds(self.which)
        blind = state.step - max(state.seen.values(), default=0)
        is_due = every > 0 and (state.is_due or state.step % every == 0)
        waits = self.which.patience and 0 < blind < unseen
        if is_due and not waits:
            state = with_parked(state, unseen)
        return replace(state, is_due=is_due and waits), info

    def _correct(
        self, state: CentredState, seen: list[int], z: Array, shift: Array, leaving_out: bool
    ) -> tuple[CentredState, Info, list[int]]:
        """The state after the update, its innovation, and the landmarks in it: with ``leaving_out`` not all seen."""
        is_parked = np.array([label in state.parked for label in seen])
        in_doubt = np.array([self._is_in_doubt(state, label) for label in seen])
        new = np.array([state.step - state.seen[label] > 1 for label in seen])
        separate = partial(poses_moved, recency=self.which.recency)
        attempts: list[tuple[Chart, int]] = [(separate, PASSES if self.which.iteration and is_parked.any() else 1)]
        if self.which.turning and in_doubt.any():
            state = settled_clones(state)
            held = [state.parked[label] for label in np.array(seen)[in_doubt & ~new]]
            chain = partial(chained, on=sorted(state.clones).index(min(held, default=max(state.clones))))
            attempts.insert(0, (chain, PASSES_CHAINED if self.which.tempering else PASSES_EARLY))
        T = shifts_of(state)
        P = T @ state.P @ T.T  # of the pose, too, by xi from here on
        for chart, passes in attempts:
            found = self._solved(state, P, seen, z, shift, is_parked, in_doubt, new, chart, passes)
            if found.is_settled:
                break
        else:
            if leaving_out and is_parked.all():
                return state, Info(np.zeros(0), np.zeros((0, 0)), np.zeros((len(state.x), 0))), []
            if leaving_out and is_parked.any():
                rest = [label for label in seen if label not in state.parked]
                return self._correct(state, rest, z[~is_parked], shift[~is_parked], leaving_out=False)
        after, turned = moved_by(state, found.delta), np.eye(len(state.x))
        if chart is not separate:
            (after, _), turned = charted(state, found.delta, chart), found.C
        turned = np.linalg.inv(shifts_of(after)) @ turned
        after = replace(after, P=turned @ (P - found.W @ found.S @ found.W.T) @ turned.T)
        limits = np.where(in_doubt & self.which.waiting, np.where(new, UNTURNED, DOUBT), np.inf)
        back = [
            label
            for label, limit in zip(seen, limits, strict=True)
            if label in state.parked and not self._waits(after, label, limit)
        ]
        return activated(after, back), Info(found.innovation, found.S, found.W), seen

    def _solved(
        self, state: CentredState, P: Array, seen: list[int], z: Array, shift: Array, is_parked: Array,
        in_doubt: Array, new: Array, chart: Chart, passes: int,
    ) -> Solution:  # fmt: skip
        """The update by at most so many passes of Gauss-Newton, in a chart of the poses."""
        delta, expected, deviation = np.zeros(len(P)), np.zeros((len(seen), 3)), np.sqrt(np.diag(P))
        is_chained = self.which.turning and bool(in_doubt.any())  # tried, or given up: all clones are in the update
        involved = indices_of(state, state.clones if is_chained else clones_of(state, seen), seen)
        unsure = is_parked if self.which.tempering else in_doubt
        is_tempered, is_settled, decades = passes > 1 and bool((unsure & new).any()), False, 0.0
        cooling = COOLING if self.which.tempering else COOLING_EARLY
        for i in range(passes):
            here, C = charted(state, delta, chart)
            h, H = expectation(here, seen)
            H = H @ C
            expected = np.where(is_parked[:, None] | (i == 0), h, expected)
            y, R = observed(z, shift, expected, state.problem.belief.sensor, self.which)
            if is_tempered and i == 0:
                decades = raised(H @ P @ H.T, R, unsure) if self.which.tempering else TEMPERED
            factor = max(1.0, 10.0 ** (decades - cooling * i))
            R[unsure] *= factor
            gap = y - h
            gap[:, 0] = wrap(gap[:, 0])
            innovation = gap.ravel() + H @ delta
            S, W = basics.gain(P, H, block_diag(*R))
            before, delta = delta, W @ innovation
            is_settled = i > 0 and factor == 1.0
            is_settled = is_settled and bool(np.all((np.abs(delta - before) <= SETTLED * deviation)[involved]))
            if is_settled:
                break
        return Solution(delta, C, H, S, W, innovation, is_settled)

    def _is_in_doubt(self, state: CentredState, label: int) -> bool:
        """Whether the turn since the clone of a parked landmark or the heading was little known before the motion."""
        if not self.which.iteration or label not in state.parked:
            return False
        fresh = state.noise[2] @ state.noise[2]
        is_adrift = self.which.adrift and state.P[2, 2] - fresh > ADRIFT**2
        return bool(is_adrift or turn_variance(state, label) - fresh > DOUBT**2)

    def _waits(self, state: CentredState, label: int, limit: float) -> bool:
        """Whether the turn since the clone of a landmark is little known after its update, but its distance well."""
        rho = state.places[label] + 2
        is_known = state.P[rho, rho] < (KNOWN * state.x[rho]) ** 2
        return bool(is_known and turn_variance(state, label) > limit**2)

    def _is_driven_through(self, state: CentredState, label: int, fresh: float) -> bool:
        """Whether a linear model no longer holds where a landmark is, as after driving through it.

        ``fresh`` is the standard deviation that the turn of this step added to its azimuth.
        """
        at = block_at(state.places[label])
        (of_azimuth, of_elevation, of_rho), rho = np.diag(state.P)[at], state.x[at][2]
        is_anywhere = max(of_azimuth - fresh**2, of_elevation) > BLURRED**2
        return bool(rho <= 0.0 or is_anywhere or (rho > NEAR and of_rho > (BLURRED * rho) ** 2))

    def _inserted(self, state: CentredState, label: int, z: Array) -> CentredState:
        sensor, n = state.problem.belief.sensor, len(state.x)
        (y,), (J,) = converted(z[None], sensor)
        if self.which.debiasing:
            y = y - conversion_bias(z[None], sensor)[0]
        P = np.zeros((n + 3, n + 3))
        P[:n, :n], P[n:, n:] = state.P, J @ variance_at(z[None], sensor).reshape(3, 3) @ J.T
        return replace(state, x=np.append(state.x, y), P=P, places=state.places | {label: n})

    def forget(self, state: CentredState, landmark: int) -> CentredState:
        parked = {label: number for label, number in state.parked.items() if label != landmark}
        return without_idle_clones(without_block(replace(state, parked=parked), state.places[landmark]))

    def pose(self, state: CentredState) -> Gaussian:
        P = state.P[:3, :3]
        return Gaussian(state.x[:3], pose_moments(P) if self.which.moments else P)

    def map(self, state: CentredState) -> dict[int, Gaussian]:
        points = {label: point_in_world(state, label) for label in state.places}
        return {label: Gaussian(point, D @ state.P @ D.T) for label, (point, D) in points.items()}

    def joint(self, state: CentredState) -> Gaussian:
        points = [point_in_world(state, label) for label in state.places]
        mean = np.concatenate([state.x[:3], *(point for point, _ in points)])
        D = np.vstack([np.eye(3, len(state.x)), *(D for _, D in points)])
        return Gaussian(mean, D @ state.P @ D.T)
