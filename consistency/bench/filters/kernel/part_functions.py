"""What a filter is made of, the functions that its parts provide, and the motion of the robot.

The motion is that of Herath, Kodagoda & Dissanayake (2007) eq. 18.

The loop and the shared steps call nothing but these. The type of the first argument chooses the body; a function with
``default=True`` has one for parts that have none of their own. Pose, landmark and covariance arrays are written in
place where a docstring says ``<-``.

A control ``u`` (3,) is dt, s; v, m/s; omega, rad/s.
"""

# mypy: disable-error-code="empty-body"

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from consistency.bench.filters.compiler.dispatch import generic, part
from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.kernel.linalg import (
    add_transposed_times,
    copy_matrix,
    fill_matrix,
    filled,
    integers,
    matrix,
    vector,
)
from consistency.bench.scenario.models import Mounting, unicycle, unicycle_jacobian, unicycle_noise
from consistency.referee.types import Array, Indices

Pair = tuple[float, float]
Triple = tuple[float, float, float]
Six = tuple[float, float, float, float, float, float]
Nine = tuple[float, float, float, float, float, float, float, float, float]


@part()
class Open(NamedTuple):
    """No guard: a filter is given all observations."""


class Slam(NamedTuple):
    """The parts of a filter, each a NamedTuple whose type chooses its code. A sensor has its ``mount``."""

    motion: Any
    sensor: Any
    landmark: Any
    error: Any
    point: Any
    update: Any
    covariance: Any
    guard: Any = Open()


class Data(NamedTuple):
    """A trial as kernels take it: T steps, M observations."""

    controls: Array  # (T, 3): dt, v, omega
    first: Indices  # (T + 1,)
    landmark: Indices  # (M,)
    z: Array  # (M, s)
    R: Array  # (M, s, s), noise of each observation
    shift: Array  # (M,), bias in px that was subtracted from each disparity, by which its search range has moved
    start: Array  # (3,), known exactly
    n_landmarks: int


class State(NamedTuple):
    """The variables that a step works on: all of them, or the active part under local updating.

    The robot comes first, then landmarks in the order in which they came. One half of P is valid, and the block of
    the robot (``covariance``).
    """

    x: Array  # (>= n,)
    P: Array  # (>= n, >= n)
    n: int
    base: int  # variables of the base, 0 unless updating is local
    offset: Indices  # (n_landmarks,) of each landmark in x, or -1; -1 less the place that a forgotten one has left


class Factors(NamedTuple):
    """The active part, of up to ``c`` variables of ``n``, and what the passive rest is owed: local updating."""

    x: Array  # (c,)
    P: Array  # (c, c), as ``covariance`` keeps it
    Phi: Array  # (c, c)
    Psi: Array  # (c, c), upper half
    theta: Array  # (c,)
    label: Indices  # labels of the active landmarks in their order
    base: Indices  # offsets in the whole state of the landmarks in the base
    rows: Array  # (c, n) P0_base,all
    owed: Array  # (c, n) Psi P0_base,all, then Phi P0_base,all
    cross: Array  # (c, c) P0_l,base of the landmarks l that join
    gain: Array  # (c, c) P0_l,base Psi
    tally: Array  # (6,) what the rules for when to settle count


@inner
def make_factors(c: int, width: int, landmarks: int) -> Factors:
    """Arrays for ``c`` active variables with up to ``landmarks`` landmarks, of ``width`` in all."""
    return Factors(
        vector(c),
        matrix(c, c),
        matrix(c, c),
        matrix(c, c),
        vector(c),
        integers(landmarks, 0),
        integers(landmarks, 0),
        matrix(c, width),
        matrix(c, width),
        matrix(c, c),
        matrix(c, c),
        filled(6, 0.0),
    )


# --- sensor ----------------------------------------------------------------------------------------


@generic()
def observed_width(sensor: NamedTuple) -> int:
    """Number s of values in an observation; a constant."""


@generic()
def measure(sensor: NamedTuple, x: float, y: float, z: float) -> Pair | Triple:
    """Observation, s values in the units of the sensor, of a point in the frame of the sensor, in m."""


@generic()
def measure_jacobian(sensor: NamedTuple, x: float, y: float, z: float) -> Six | Nine:
    """Jacobian (s, 3) of :func:`measure` by the point, row after row."""


@generic()
def locate(sensor: NamedTuple, z: Array) -> Triple:
    """Point in the frame of the sensor, in m, that has the observation z (s,): the inverse of :func:`measure`."""


@generic()
def locate_jacobian(sensor: NamedTuple, z: Array) -> Six | Nine:
    """Jacobian (3, s) of :func:`locate` by the observation z (s,), row after row."""


@generic(default=True)
def wrap_residual(sensor: NamedTuple, z: Array, about: Array) -> None:
    """z (s,) <- the same observation, each angle in it by full turns as near as can be to that of ``about`` (s,).

    By default nothing wraps.
    """


# --- landmark --------------------------------------------------------------------------------------


@generic()
def landmark_width(landmark: NamedTuple) -> int:
    """Number w of variables of a landmark; a constant."""


@generic()
def to_body(landmark: NamedTuple, frame: Frame, values: Array) -> Triple:
    """Position of the landmark ``values`` (w,) in the frame of the robot, in m."""


@generic()
def to_body_jacobian(
    landmark: NamedTuple, frame: Frame, values: Array, body: Triple, row: Triple, Hp: Array, Hl: Array
) -> None:
    """Rows ``Hp`` (3,) and ``Hl`` (w,) <- derivatives by the variables of robot and landmark, through :func:`to_body`.

    ``row`` holds the derivative by the point in the frame of the robot, ``body`` that point, of :func:`to_body`.
    """


@generic()
def insert(
    landmark: NamedTuple, frame: Frame, body: Triple, Jb: Array, mount: Mounting, values: Array, Jp: Array, Jz: Array
) -> None:
    """``values`` (w,) <- a new landmark seen at ``body``, m in the frame of the robot.

    ``Jp`` (w, 3) and ``Jz`` (w, s) <- its Jacobians by robot and observation. ``Jb`` (3, s) is the derivative of
    ``body`` by the observation; ``mount`` says where the sensor is on the robot.
    """


@generic()
def world_point(landmark: NamedTuple, frame: Frame, values: Array, point: Array, Dp: Array, Dl: Array) -> None:
    """``point`` (3,) <- position in the world, m, of ``values`` (w,); ``Dp`` (3, 3), ``Dl`` (3, w) <- its Jacobians."""


@generic(default=True)
def combine(landmark: NamedTuple, Hp: Array, Hl: Array, rows: Array, i: int, out: Array) -> None:
    """``out`` (s, width) <- H P of the i-th seen landmark: Hp (s, 3), Hl (s, w) and ``rows`` (3 + w m, width) of P."""
    w = Hl.shape[1]
    fill_matrix(out, 0.0)
    for a in range(len(Hp)):
        for c in range(3 + w):
            h = Hp[a, c] if c < 3 else Hl[a, c - 3]
            row = rows[c] if c < 3 else rows[w * i + c]
            for j in range(out.shape[1]):
                out[a, j] += h * row[j]


# --- error -----------------------------------------------------------------------------------------


@generic(default=True)
def propagate(error: NamedTuple, slam: Slam, state: State, k: int, u: Array, Phi: Array, scratch: Any) -> None:
    """x (n,), P (n, n), Phi (n, base) <- one step of motion under the control ``u`` (3,), to step k + 1.

    The Jacobians are taken where the linearisation point asks for them. By default they are
    those of eq. 9 and 10: x <- f(x) and P <- F P F' + G Q G' in the robot's rows.
    """
    pose = state.x[:3]
    at = motion_point(slam.point, pose, k)
    propagate_covariance_at(slam.point, slam, state, k, u, Phi, scratch)
    add_motion_noise(slam.motion, at, u, state.P)
    if expands(slam.point):
        move_about(at, u, pose)
    else:
        move(pose, u, pose)


@generic(default=True)
def to_error(error: NamedTuple, pose: Array, values: Array, Hp: Array, Hl: Array) -> None:
    """Rows ``Hp`` (k, 3) and ``Hl`` (k, w) <- Jacobians by this error, in place of those by the variables.

    The error is that of the robot at ``pose`` (3,) and of the landmark ``values`` (w,). By default they are the same.
    """


@generic(default=True)
def insert_error(error: NamedTuple, pose: Array, values: Array, Jp: Array) -> None:
    """``Jp`` (w, 3) <- Jacobian between errors, in place of the one between variables, of a new landmark by the robot.

    The robot is at ``pose`` (3,), the landmark is ``values`` (w,). By default they are the same.
    """


@generic(default=True)
def retract(error: NamedTuple, slam: Slam, state: State, A: Array, y: Array, scratch: Any) -> None:
    """x (n,) <- x moved by the error A' y, with A (k, n) and y (k,).

    By default by a sum.
    """
    add_transposed_times(A, y, state.x[: state.n])


@generic(default=True)
def pose_covariance(error: NamedTuple, x: Array, P: Array, out: Array) -> None:
    """``out`` (3, 3) <- covariance of the additive error of the robot at x (n,), from that of this error, P (3, 3).

    By default they are the same.
    """
    copy_matrix(P, out)


# --- linearisation point -----------------------------------------------------------------------------


@generic(default=True)
def expands(point: NamedTuple) -> bool:
    """Whether f and h are replaced by their first-order expansion about the point; a constant."""
    return False


@generic(default=True)
def stands_apart(point: NamedTuple) -> bool:
    """Whether only the Jacobians are taken at the point, f and h at the estimate; a constant."""
    return not expands(point)


@generic(default=True)
def make_point_arrays(point: NamedTuple, w: int, steps: int, labels: int) -> Any:
    """What the point remembers of a trial of so many steps and ids of landmarks, ``scratch.of_point``; made once."""
    return ()


@generic(default=True)
def motion_point(point: NamedTuple, pose: Array, k: int) -> Array:
    """Pose (3,) at which the noise of step k + 1 acts, and about which f is expanded where the point expands."""
    return pose


@generic(default=True)
def propagate_covariance_at(
    point: NamedTuple, slam: Slam, state: State, k: int, u: Array, Phi: Array, scratch: Any
) -> None:
    """:func:`propagate_covariance` of P (n, n) and Phi (n, base), with F of step k + 1 as the point asks.

    Called before x (n,) moves under the control ``u`` (3,). By default it is F at x.
    """
    propagate_covariance(state.x, u, state.P, state.n, Phi, state.base)


@generic(default=True)
def observation_point(point: NamedTuple, pose: Array, k: int) -> Array:
    """Pose (3,) at which h of step k + 1 is linearised; ``pose`` (3,) is the estimate."""
    return pose


@generic(default=True)
def landmark_point(point: NamedTuple, values: Array, label: int, scratch: Any) -> Array:
    """Landmark (w,) at which h is linearised; ``values`` (w,) is the estimate of landmark ``label``."""
    return values


@generic()
def place(point: NamedTuple, slam: Slam, state: State, k: int, label: int, z: Array, scratch: Any) -> None:
    """x[n:n + w] <- a new landmark from its observation z (s,); ``scratch.Jp`` (w, 3), ``Jz`` (w, s) <- Jacobians."""


# --- update ----------------------------------------------------------------------------------------


@generic(default=True)
def make_update_arrays(update: NamedTuple, w: int, s: int, m: int, n: int) -> Any:
    """Arrays of this update for up to ``m`` landmarks in a step and a state of up to ``n`` variables."""
    return ()


@generic(default=True)
def predict(update: NamedTuple, slam: Slam, state: State, k: int, u: Array, of_covariance: Any, scratch: Any) -> None:
    """x (n,), P (n, n), and what ``of_covariance`` says of them <- one step of motion under the control ``u`` (3,).

    By default as ``error`` has it.
    """
    propagate(slam.error, slam, state, k, u, of_covariance.Phi, scratch)


@generic()
def predict_innovation(
    update: NamedTuple, slam: Slam, state: State, data: Data, k: int, m: int, of_covariance: Any, scratch: Any
) -> tuple[int, float]:
    """Upper half of ``scratch.S`` (s m, s m) <- innovation covariance; column n + base of ``A`` <- innovation (s m,).

    They are those of an update in step k + 1 with the ``m`` landmarks that ``scratch`` lists, as ``Info`` has them; the
    state stays as it is. Returns a code of REASONS, 0 where all is well, and a sum that is finite if all is.
    """


@generic()
def correct(
    update: NamedTuple,
    slam: Slam,
    state: State,
    data: Data,
    k: int,
    m: int,
    has_innovation: bool,
    of_covariance: Any,
    scratch: Any,
) -> tuple[int, float, float]:
    """x (n,), P (n, n) <- the joint update in step k + 1 with the ``m`` landmarks that ``scratch`` lists.

    ``has_innovation`` says whether :func:`predict_innovation` has been called for these, and nothing since. Returns
    a code of REASONS, 0 where all is well, the NIS, and log det S of that innovation.
    """


@generic()
def innovate_again(update: NamedTuple, slam: Slam, state: State, data: Data, k: int, m: int, scratch: Any) -> bool:
    """A, S without noise, and the innovation about x, for an update that iterates; False where the prior is indefinite.

    From the innovation is taken what the linearisation makes of the way from x to ``scratch.prior`` (3 + w m,).
    """


# --- guard -----------------------------------------------------------------------------------------


@generic(default=True)
def make_guard_arrays(guard: NamedTuple, s: int, m: int, rows: int, n_landmarks: int) -> Any:
    """What a guard keeps of a trial with so many ``rows`` of observations, up to ``m`` in a step; made once."""
    return ()


@generic(default=True)
def screen(
    guard: NamedTuple,
    slam: Slam,
    state: State,
    data: Data,
    k: int,
    m: int,
    of_covariance: Any,
    scratch: Any,
    of_guard: Any,
) -> tuple[int, int, bool]:
    """``scratch`` lists, of the ``m`` known landmarks of step k + 1, what the guard keeps; ``of_guard`` has the others.

    Returns a code of REASONS, 0 where all is well, how many are left, and whether they are foreseen. By default all are
    left.
    """
    return 0, m, False


@generic(default=True)
def may_enter(guard: NamedTuple, row: int, is_known: bool, of_guard: Any) -> bool:
    """Whether a landmark begins with the observation in this row of the data; again, if it is in the state."""
    return not is_known


@generic(default=True)
def rejected_rows(guard: NamedTuple, of_guard: Any) -> Array:
    """Which rows of the data the filter was not given, (M,), or nothing, (0,), of a filter without a guard."""
    return np.empty(0, np.bool_)


# --- update of the covariance --------------------------------------------------------------------------


@generic(default=True)
def spare_width(covariance: NamedTuple, steps: int, n_landmarks: int) -> int:
    """Variables that the state may need beside robot and landmarks in a trial of so many ``steps``."""
    return 0


@generic(default=True)
def make_covariance_arrays(covariance: NamedTuple, w: int, n: int, steps: int, n_landmarks: int) -> Any:
    """What this covariance update keeps beside a state of up to ``n`` variables."""
    return make_factors(3, 3, 1)


@generic(default=True)
def prepare(
    covariance: NamedTuple, slam: Slam, whole: State, state: State, labels: Indices, of_covariance: Any
) -> tuple[State, State]:
    """The whole state, and the variables to work on in a step that sees the landmarks ``labels`` (m,): all, or a part.

    The whole may grow by what is neither robot nor landmark. By default all in every step.
    """
    return whole, state


@generic(default=True)
def append(covariance: NamedTuple, slam: Slam, state: State, label: int, of_covariance: Any, scratch: Any) -> None:
    """``of_covariance`` <- a landmark that begins at its offset in ``state``, with Jacobian ``scratch.Jp`` (w, 3)."""


@generic(default=True)
def settle(covariance: NamedTuple, slam: Slam, whole: State, state: State, of_covariance: Any) -> None:
    """``whole`` <- all variables as they are after the steps so far, those outside the active part included."""


@generic(default=True)
def held_at(covariance: NamedTuple, label: int, of_covariance: Any) -> int:
    """Offset of the pose in whose frame a landmark is; 0 is the robot's."""
    return 0


@generic(default=True)
def withhold(
    covariance: NamedTuple, state: State, data: Data, k: int, rejected: Array, again: Array, of_covariance: Any
) -> None:
    """``of_covariance`` <- as if the rows of step k + 1 that are ``rejected`` (M,) had not been seen.

    The landmarks of the rows ``again`` (M,), which are among these, are forgotten: they are about to restart.
    """


@part()
class Unicycle(NamedTuple):
    """Standard deviations of v (m/s) and omega (rad/s), as the filter believes them."""

    sigma_v: float
    sigma_omega: float


class Frame(NamedTuple):
    """A planar robot: its position in m, cosine and sine of its heading."""

    x: float
    y: float
    c: float
    s: float


@inner
def robot_frame(pose: Array) -> Frame:
    """Position and axes of the robot at ``pose`` (3,), which is all that landmarks need to know of it."""
    return Frame(pose[0], pose[1], np.cos(pose[2]), np.sin(pose[2]))


@inner
def move(pose: Array, u: Array, out: Array) -> None:
    """``out`` (3,) <- f of ``pose`` (3,) without noise: Euler, at the heading before the step."""
    dt, v, omega = u[0], u[1], u[2]
    out[0], out[1], out[2] = unicycle(pose[0], pose[1], pose[2], dt, v, omega)


@inner
def move_about(at: Array, u: Array, pose: Array) -> None:
    """``pose`` (3,) <- f(at) + F (pose - at): f to first order about ``at`` (3,)."""
    dt, v, omega = u[0], u[1], u[2]
    fx, fy = unicycle_jacobian(at[2], dt, v)
    x, y, heading = unicycle(at[0], at[1], at[2], dt, v, omega)
    turn = pose[2] - at[2]
    pose[0] = x + (pose[0] - at[0]) + fx * turn
    pose[1] = y + (pose[1] - at[1]) + fy * turn
    pose[2] = heading + turn


@inner
def propagate_covariance(at: Array, u: Array, P: Array, n: int, Phi: Array, base: int) -> None:
    """P (n, n) <- F P F' and Phi (n, base) <- F Phi, with F (3, 3) the Jacobian of f at ``at`` (3,).

    Of both, the rows of the robot are changed; in P the block of the robot becomes valid as a whole.
    """
    fx, fy = unicycle_jacobian(at[2], u[0], u[1])
    propagate_covariance_by(fy, -fx, P, n, Phi, base)


@inner
def propagate_covariance_by(dx: float, dy: float, P: Array, n: int, Phi: Array, base: int) -> None:
    """:func:`propagate_covariance` with F of a displacement of the robot by (dx, dy) in the world, m.

    F is the identity but for F[0, 2] = -dy and F[1, 2] = dx: how the position turns with the heading.
    """
    _move_rows(P, n, -dy, dx)
    for i in range(3):
        P[i, 0] += -dy * P[i, 2]
        P[i, 1] += dx * P[i, 2]
    _move_rows(Phi, base, -dy, dx)


@inner
def _move_rows(P: Array, n: int, fx: float, fy: float) -> None:
    """Rows 0 and 1 of P (3, n) <- F P."""
    p0, p1, p2 = P[0], P[1], P[2]
    for j in range(n):
        p0[j] += fx * p2[j]
        p1[j] += fy * p2[j]


@inner
def add_motion_noise(motion: Unicycle, at: Array, u: Array, P: Array) -> None:
    """P[:3, :3] += G diag(sigma_v^2, sigma_omega^2) G', with G (3, 2) the Jacobian of f by the noise at ``at`` (3,)."""
    xx, xy, yy, hh = unicycle_noise(at[2], u[0], motion.sigma_v, motion.sigma_omega)
    P[0, 0] += xx
    P[0, 1] += xy
    P[1, 0] += xy
    P[1, 1] += yy
    P[2, 2] += hh


@inner
def noise_columns(motion: Unicycle, at: Array, u: Array, G: Array) -> None:
    """``G[:, :2]`` <- G Q^(1/2) at ``at`` (3,): dt sigma_v along the heading and dt sigma_omega in heading."""
    along, turn = u[0] * motion.sigma_v, u[0] * motion.sigma_omega
    G[0, 0], G[1, 0], G[2, 0] = along * np.cos(at[2]), along * np.sin(at[2]), 0.0
    G[0, 1], G[1, 1], G[2, 1] = 0.0, 0.0, turn


@inner
def propagate_covariance_root(P: Array, first: int, last: int, C: Array, F: Array) -> None:
    """Columns first..last-1 of the robot's rows: P (3, n) <- F C^-1 P for a lower root C (3, 3) and F (3, 3).

    By forward substitution. A direction whose pivot in C is zero carries nothing.
    """
    i0, i1, i2 = _reciprocal(C[0, 0]), _reciprocal(C[1, 1]), _reciprocal(C[2, 2])
    c10, c20, c21 = C[1, 0], C[2, 0], C[2, 1]
    f00, f01, f02 = F[0, 0], F[0, 1], F[0, 2]
    f10, f11, f12 = F[1, 0], F[1, 1], F[1, 2]
    f20, f21, f22 = F[2, 0], F[2, 1], F[2, 2]
    p0, p1, p2 = P[0], P[1], P[2]
    for j in range(first, last):
        g0 = p0[j] * i0
        g1 = (p1[j] - c10 * g0) * i1
        g2 = (p2[j] - c20 * g0 - c21 * g1) * i2
        p0[j] = f00 * g0 + f01 * g1 + f02 * g2
        p1[j] = f10 * g0 + f11 * g1 + f12 * g2
        p2[j] = f20 * g0 + f21 * g1 + f22 * g2


@inner
def _reciprocal(pivot: float) -> float:
    return 0.0 if pivot == 0.0 else 1.0 / pivot
