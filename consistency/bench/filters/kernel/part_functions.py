"""What a filter is made of, and the functions that its parts must provide.

The loop and the shared steps call nothing but these. ``generic(n)`` is decided by the types of the first n
arguments; pose, landmark and covariance arrays are written in place where a docstring says ``<-``.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

from consistency.bench.filters.compiler.dispatch import generic, part
from consistency.bench.models.point import Mounting
from consistency.referee.types import Array, Indices

Pair = tuple[float, float]
Triple = tuple[float, float, float]
Six = tuple[float, float, float, float, float, float]
Nine = tuple[float, float, float, float, float, float, float, float, float]


class Sensor(Protocol):
    """A part that measures points in its own frame."""

    @property
    def mount(self) -> Mounting: ...


@part()
class Open(NamedTuple):
    """No guard: a filter is given all observations."""


class Slam(NamedTuple):
    """The parts of a filter; the type of each chooses its code."""

    motion: NamedTuple
    sensor: Sensor
    landmark: NamedTuple
    error: NamedTuple
    point: NamedTuple
    update: NamedTuple
    covariance: NamedTuple
    guard: NamedTuple = Open()


class Data(NamedTuple):
    """A trial as kernels take it: T steps, M observations."""

    controls: Array  # (T, 3): dt, v, omega
    first: Indices  # (T + 1,)
    landmark: Indices  # (M,)
    z: Array  # (M, s)
    R: Array  # (M, s, s), noise of each observation
    shift: Array  # (M,), bias in px that was subtracted from each disparity, by which its search range has moved
    start: Array  # (r,), known exactly
    n_landmarks: int
    halt: Indices  # (1,), not 0 once the trial is given up


class State(NamedTuple):
    """The variables that a step works on: all of them, or the active part under local updating.

    The robot comes first, then landmarks in the order in which they came. One half of P is valid, and the block of
    the robot (``covariance``).
    """

    x: Array  # (>= n,)
    P: Array  # (>= n, >= n)
    n: int
    base: int  # variables of the base, 0 unless updating is local
    offset: Indices  # (n_landmarks,) of each landmark in x, or -1


class Frame(NamedTuple):
    """A planar robot: its position in m, cosine and sine of its heading."""

    x: float
    y: float
    c: float
    s: float


# --- motion ----------------------------------------------------------------------------------------


@generic()
def robot_width(motion: NamedTuple) -> int:
    """Number r of variables of the robot; a constant."""
    raise NotImplementedError


@generic()
def move(motion: NamedTuple, pose: Array, u: Array, out: Array) -> None:
    """``out`` (r,) <- f of ``pose`` (r,) without noise, under the control ``u`` (3,): dt, s; v, m/s; omega, rad/s."""
    raise NotImplementedError


@generic()
def move_about(motion: NamedTuple, at: Array, u: Array, pose: Array) -> None:
    """``pose`` (r,) <- f(at) + F (pose - at): f to first order about ``at`` (r,), under the control ``u`` (3,)."""
    raise NotImplementedError


@generic()
def propagate_covariance(motion: NamedTuple, at: Array, u: Array, P: Array, n: int, Phi: Array, base: int) -> None:
    """P (n, n) <- F P F' and Phi (n, base) <- F Phi, with F (r, r) the Jacobian of f at ``at`` (r,) under ``u`` (3,).

    Of both, the r rows of the robot are changed; in P the block of the robot becomes valid as a whole.
    """
    raise NotImplementedError


@generic()
def propagate_covariance_by(motion: NamedTuple, dx: float, dy: float, P: Array, n: int, Phi: Array, base: int) -> None:
    """:func:`propagate_covariance` with F of a displacement of the robot by (dx, dy) in the world, m."""
    raise NotImplementedError


@generic()
def add_motion_noise(motion: NamedTuple, at: Array, u: Array, P: Array) -> None:
    """P[:r, :r] += G Q G', with G the Jacobian of f by the noise at ``at`` (r,) under the control ``u`` (3,)."""
    raise NotImplementedError


@generic()
def noise_columns(motion: NamedTuple, at: Array, u: Array, G: Array) -> int:
    """First q columns of ``G`` (r, >= q) <- G Q^(1/2) at ``at`` (r,) under the control ``u`` (3,); returns q."""
    raise NotImplementedError


@generic()
def robot_frame(motion: NamedTuple, pose: Array) -> Frame:
    """Position in m and axes of the robot at ``pose`` (r,), which is all that landmarks need to know of it."""
    raise NotImplementedError


@generic()
def propagate_covariance_root(motion: NamedTuple, P: Array, first: int, last: int, C: Array, F: Array) -> None:
    """Columns first..last-1 of the robot's rows: P (r, n) <- F C^-1 P for a lower root C (r, r) and F (r, r).

    A direction whose pivot in C is zero carries nothing.
    """
    raise NotImplementedError


# --- sensor ----------------------------------------------------------------------------------------


@generic()
def observed_width(sensor: Sensor) -> int:
    """Number s of values in an observation; a constant."""
    raise NotImplementedError


@generic()
def measure(sensor: Sensor, x: float, y: float, z: float) -> Pair | Triple:
    """Observation, s values in the units of the sensor, of a point in the frame of the sensor, in m."""
    raise NotImplementedError


@generic()
def measure_jacobian(sensor: Sensor, x: float, y: float, z: float) -> Six | Nine:
    """Jacobian (s, 3) of :func:`measure` by the point, row after row."""
    raise NotImplementedError


@generic()
def locate(sensor: Sensor, z: Array) -> Triple:
    """Point in the frame of the sensor, in m, that has the observation z (s,): the inverse of :func:`measure`."""
    raise NotImplementedError


@generic()
def locate_jacobian(sensor: Sensor, z: Array) -> Six | Nine:
    """Jacobian (3, s) of :func:`locate` by the observation z (s,), row after row."""
    raise NotImplementedError


@generic()
def wrap_residual(sensor: Sensor, z: Array, about: Array) -> None:
    """z (s,) <- the same observation, each angle in it by full turns as near as can be to that of ``about`` (s,)."""
    raise NotImplementedError


# --- landmark --------------------------------------------------------------------------------------


@generic()
def landmark_width(landmark: NamedTuple) -> int:
    """Number w of variables of a landmark; a constant."""
    raise NotImplementedError


@generic()
def to_body(landmark: NamedTuple, frame: Frame, values: Array) -> Triple:
    """Position of the landmark ``values`` (w,) in the frame of the robot, in m."""
    raise NotImplementedError


@generic()
def to_body_jacobian(
    landmark: NamedTuple, frame: Frame, values: Array, body: Triple, row: Triple, Hp: Array, Hl: Array
) -> None:
    """Rows ``Hp`` (r,) and ``Hl`` (w,) <- derivatives by the variables of robot and landmark, through :func:`to_body`.

    ``row`` holds the derivative by the point in the frame of the robot, ``body`` that point, of :func:`to_body`.
    """
    raise NotImplementedError


@generic()
def insert(
    landmark: NamedTuple, frame: Frame, body: Triple, Jb: Array, mount: Mounting, values: Array, Jp: Array, Jz: Array
) -> None:
    """``values`` (w,) <- a new landmark seen at ``body``, m in the frame of the robot.

    ``Jp`` (w, r) and ``Jz`` (w, s) <- its Jacobians by robot and observation. ``Jb`` (3, s) is the derivative of
    ``body`` by the observation; ``mount`` says where the sensor is on the robot.
    """
    raise NotImplementedError


@generic()
def world_point(landmark: NamedTuple, frame: Frame, values: Array, point: Array, Dp: Array, Dl: Array) -> None:
    """``point`` (3,) <- position in the world, m, of ``values`` (w,); ``Dp`` (3, r), ``Dl`` (3, w) <- its Jacobians."""
    raise NotImplementedError


@generic()
def combine(landmark: NamedTuple, Hp: Array, Hl: Array, rows: Array, i: int, out: Array) -> None:
    """``out`` (s, width) <- H P of the i-th seen landmark: Hp (s, r), Hl (s, w) and ``rows`` (r + w m, width) of P."""
    raise NotImplementedError


# --- error -----------------------------------------------------------------------------------------


@generic()
def propagate(error: NamedTuple, slam: Slam, state: State, k: int, u: Array, Phi: Array, work: NamedTuple) -> None:
    """x (n,), P (n, n), Phi (n, base) <- one step of motion under the control ``u`` (3,), to step k + 1.

    The Jacobians are taken where the linearisation point asks for them.
    """
    raise NotImplementedError


@generic()
def to_error(error: NamedTuple, pose: Array, values: Array, Hp: Array, Hl: Array) -> None:
    """Rows ``Hp`` (k, r) and ``Hl`` (k, w) <- Jacobians by this error, in place of those by the variables.

    The error is that of the robot at ``pose`` (r,) and of the landmark ``values`` (w,).
    """
    raise NotImplementedError


@generic()
def insert_error(error: NamedTuple, pose: Array, values: Array, Jp: Array) -> None:
    """``Jp`` (w, r) <- Jacobian between errors, in place of the one between variables, of a new landmark by the robot.

    The robot is at ``pose`` (r,), the landmark is ``values`` (w,).
    """
    raise NotImplementedError


@generic()
def retract(error: NamedTuple, slam: Slam, state: State, A: Array, y: Array, work: NamedTuple) -> None:
    """x (n,) <- x moved by the error A' y, with A (k, n) and y (k,)."""
    raise NotImplementedError


@generic()
def pose_covariance(error: NamedTuple, x: Array, P: Array, out: Array) -> None:
    """``out`` (r, r) <- covariance of the additive error of the robot at x (n,), from that of this error, P (r, r)."""
    raise NotImplementedError


# --- linearisation point -----------------------------------------------------------------------------


@generic()
def expands(point: NamedTuple) -> bool:
    """Whether f and h are replaced by their first-order expansion about the point; a constant."""
    raise NotImplementedError


@generic()
def stands_apart(point: NamedTuple) -> bool:
    """Whether only the Jacobians are taken at the point, f and h at the estimate; a constant."""
    raise NotImplementedError


@generic()
def make_notes(point: NamedTuple, r: int, w: int, steps: int, labels: int) -> NamedTuple:
    """What the point remembers of a trial of so many steps and ids of landmarks, ``work.notes``; made once."""
    raise NotImplementedError


@generic()
def motion_point(point: NamedTuple, pose: Array, k: int) -> Array:
    """Pose (r,) at which the noise of step k + 1 acts, and about which f is expanded where the point expands."""
    raise NotImplementedError


@generic()
def propagate_covariance_at(
    point: NamedTuple, slam: Slam, state: State, k: int, u: Array, Phi: Array, work: NamedTuple
) -> None:
    """:func:`propagate_covariance` of P (n, n) and Phi (n, base), with F of step k + 1 as the point asks.

    Called before x (n,) moves under the control ``u`` (3,).
    """
    raise NotImplementedError


@generic()
def observation_point(point: NamedTuple, pose: Array, k: int) -> Array:
    """Pose (r,) at which h of step k + 1 is linearised; ``pose`` (r,) is the estimate."""
    raise NotImplementedError


@generic()
def landmark_point(point: NamedTuple, values: Array, label: int, work: NamedTuple) -> Array:
    """Landmark (w,) at which h is linearised; ``values`` (w,) is the estimate of landmark ``label``."""
    raise NotImplementedError


@generic()
def place(point: NamedTuple, slam: Slam, state: State, k: int, label: int, z: Array, work: NamedTuple) -> None:
    """x[n:n + w], ``work.Jp`` (w, r), ``work.Jz`` (w, s) <- a new landmark from its observation z (s,); Jacobians."""
    raise NotImplementedError


# --- update ----------------------------------------------------------------------------------------


@generic()
def make_room(update: NamedTuple, r: int, w: int, s: int, m: int, n: int) -> NamedTuple:
    """Arrays of this update for up to ``m`` landmarks in a step and a state of up to ``n`` variables."""
    raise NotImplementedError


@generic()
def predict(
    update: NamedTuple, slam: Slam, state: State, k: int, u: Array, local: NamedTuple, work: NamedTuple
) -> None:
    """x (n,), P (n, n), and what ``local`` says of them <- one step of motion under the control ``u`` (3,)."""
    raise NotImplementedError


@generic()
def predict_innovation(
    update: NamedTuple, slam: Slam, state: State, data: Data, k: int, m: int, local: NamedTuple, work: NamedTuple
) -> tuple[int, float]:
    """Upper half of ``work.S`` (s m, s m) <- innovation covariance; column n + base of ``work.A`` <- innovation (s m,).

    They are those of an update in step k + 1 with the ``m`` landmarks that ``work`` lists, as ``Info`` has them; the
    state stays as it is. Returns a code of REASONS, 0 where all is well, and a sum that is finite if all is.
    """
    raise NotImplementedError


@generic()
def correct(
    update: NamedTuple,
    slam: Slam,
    state: State,
    data: Data,
    k: int,
    m: int,
    has_innovation: bool,
    local: NamedTuple,
    work: NamedTuple,
) -> tuple[int, float, float]:
    """x (n,), P (n, n) <- the joint update in step k + 1 with the ``m`` landmarks that ``work`` lists.

    ``has_innovation`` says whether :func:`predict_innovation` has been called for these, and nothing since. Returns
    a code of REASONS, 0 where all is well, the NIS, and log det S of that innovation.
    """
    raise NotImplementedError


# --- guard -----------------------------------------------------------------------------------------


@generic()
def make_watch(guard: NamedTuple, s: int, m: int, rows: int, n_landmarks: int) -> NamedTuple:
    """What a guard keeps of a trial with so many ``rows`` of observations, up to ``m`` in a step; made once."""
    raise NotImplementedError


@generic()
def screen(
    guard: NamedTuple,
    slam: Slam,
    state: State,
    data: Data,
    k: int,
    m: int,
    local: NamedTuple,
    work: NamedTuple,
    watch: NamedTuple,
) -> tuple[int, int, bool]:
    """``work`` lists, of the ``m`` known landmarks of step k + 1, those that the guard keeps; ``watch`` has the others.

    Returns a code of REASONS, 0 where all is well, how many are left, and whether they are foreseen.
    """
    raise NotImplementedError


@generic()
def keep_some(guard: NamedTuple, s: int, m: int, y: Array, S: Array, watch: NamedTuple) -> bool:
    """``watch.kept`` (m,) <- which of ``m`` observations to keep, by innovation (s m,) and the upper half of S.

    False where S is not positive definite.
    """
    raise NotImplementedError


@generic()
def may_enter(guard: NamedTuple, row: int, is_known: bool, watch: NamedTuple) -> bool:
    """Whether a landmark begins with the observation in this row of the data; anew, if it is in the state."""
    raise NotImplementedError


@generic()
def rejected_rows(guard: NamedTuple, watch: NamedTuple) -> Array:
    """Which rows of the data the filter was not given, (M,), or nothing, (0,), of a filter without a guard."""
    raise NotImplementedError


# --- update of the covariance --------------------------------------------------------------------------


@generic()
def spare_width(covariance: NamedTuple, steps: int, n_landmarks: int) -> int:
    """Variables that the state may need beside robot and landmarks in a trial of so many ``steps``."""
    raise NotImplementedError


@generic()
def make_local(covariance: NamedTuple, r: int, w: int, n: int, steps: int, n_landmarks: int) -> NamedTuple:
    """What this covariance update keeps beside a state of up to ``n`` variables."""
    raise NotImplementedError


@generic()
def prepare(
    covariance: NamedTuple, slam: Slam, whole: State, state: State, labels: Indices, local: NamedTuple
) -> tuple[State, State]:
    """The whole state, and the variables to work on in a step that sees the landmarks ``labels`` (m,): all, or a part.

    The whole may grow by what is neither robot nor landmark.
    """
    raise NotImplementedError


@generic()
def append(covariance: NamedTuple, slam: Slam, state: State, label: int, local: NamedTuple, work: NamedTuple) -> None:
    """``local`` <- a landmark that begins at its offset in ``state``, with Jacobian ``work.Jp`` (w, r)."""
    raise NotImplementedError


@generic()
def settle(covariance: NamedTuple, slam: Slam, whole: State, state: State, local: NamedTuple) -> None:
    """``whole`` <- all variables as they are after the steps so far, those outside the active part included."""
    raise NotImplementedError


@generic()
def held_at(covariance: NamedTuple, label: int, local: NamedTuple) -> int:
    """Offset of the pose in whose frame a landmark is; 0 is the robot's."""
    raise NotImplementedError


@generic()
def withhold(
    covariance: NamedTuple, state: State, data: Data, k: int, rejected: Array, anew: Array, local: NamedTuple
) -> None:
    """``local`` <- as if the rows of step k + 1 that are ``rejected`` (M,) had not been seen.

    The landmarks of the rows ``anew`` (M,), which are among these, are forgotten: they are about to begin anew.
    """
    raise NotImplementedError
