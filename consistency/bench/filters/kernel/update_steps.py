"""Steps of all updates: to the observation and back, and the correction with W = S^-1/2 Cov(z, x).

The correction is eq. 11 and 12 of Herath, Kodagoda & Dissanayake (2007). The covariance of the state is row-major, its
upper half valid. Steps write to the scratch arrays of a trial, which are made once: no step allocates.

A symmetric update of half of P costs half, and BLAS leaves the other half alone. Everything that reads or
writes P does it here, but for the block and the rows of the robot, which are whole.
"""

from __future__ import annotations

from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.kernel.linalg import (
    DEFICIENT,
    add_gram,
    add_product_of_transposed,
    add_transposed_times,
    blocks,
    copy,
    copy_matrix,
    integers,
    matrix,
    solve_transposed,
    sum_of,
    upper_cholesky,
    vector,
)
from consistency.bench.filters.kernel.part_functions import (
    Data,
    Factors,
    Frame,
    Slam,
    State,
    Triple,
    combine,
    expands,
    innovate_again,
    insert,
    landmark_point,
    landmark_width,
    locate,
    locate_jacobian,
    make_point_arrays,
    make_update_arrays,
    measure,
    measure_jacobian,
    observation_point,
    observed_width,
    predict_innovation,
    retract,
    robot_frame,
    stands_apart,
    to_body,
    to_body_jacobian,
    to_error,
    wrap_residual,
)
from consistency.bench.scenario import models
from consistency.referee.types import Array, Indices

OfUpdate = TypeVar("OfUpdate", covariant=True)
NOT_FINITE, INNOVATION, POSE = 1, 2, 3
REASONS = {
    NOT_FINITE: "the estimate is not finite",
    INNOVATION: "the innovation covariance is not positive definite",
    POSE: "the pose covariance is not positive definite",
}


class Scratch(NamedTuple, Generic[OfUpdate]):
    """``m``: the most landmarks seen in a step, ``n``: final size of the state, ``L`` = 3 + w m, s: of ``measure``."""

    known: Indices  # (m,) rows of the observations whose landmark is in the state
    at: Indices  # (m,) and its offset there
    label: Indices  # (m,) and its label
    used: Indices  # (1,) how many these are, fewer after an update that leaves some out
    zhat: Array  # (s m,) expected observations
    scale: Array  # (max(L, s m),) diagonal of what is factored
    S: Array  # (s m, s m) innovation covariance, upper half
    A: Array  # (s m, n + 1) Cov(z, x); in the column after the state the innovation
    rows: Array  # (L, n) rows of P of the robot and the seen landmarks
    delta: Array  # (n,) an error of the whole state
    Hp: Array  # (m, s, 3) Jacobians
    Hl: Array  # (m, s, w)
    Jp: Array  # (w, 3) of a new landmark
    Jz: Array  # (w, s)
    Jb: Array  # (3, s) of its position in the robot frame
    pose: Array  # (3,)
    prior: Array  # (L,) of the variables involved, for an update that iterates
    small: Array  # (3, 3)
    of_update: OfUpdate  # what the update alone needs
    of_point: Any  # what the linearisation point alone needs, of a type of its own


@inner
def make_scratch(slam: Slam, n: int, m: int, steps: int, labels: int) -> Scratch[NamedTuple]:
    """Arrays for a state of up to ``n`` variables, ``m`` landmarks in a step, and a trial with so many labels."""
    w, s = landmark_width(slam.landmark), observed_width(slam.sensor)
    rows = s * m
    return Scratch(
        integers(m, 0),
        integers(m, 0),
        integers(m, 0),
        integers(1, 0),
        vector(rows),
        vector(max(3 + w * m, rows)),
        matrix(rows, rows),
        matrix(rows, n + 1),
        matrix(3 + w * m, n),
        vector(n),
        blocks(m, s, 3),
        blocks(m, s, w),
        matrix(w, 3),
        matrix(w, s),
        matrix(3, s),
        vector(3),
        vector(3 + w * m),
        matrix(3, 3),
        make_update_arrays(slam.update, w, s, m, n),
        make_point_arrays(slam.point, w, steps, labels),
    )


@inner
def observe(slam: Slam, frame: Frame, values: Array, z: Array) -> None:
    """z (s,) <- h: the landmark ``values`` (w,) as the sensor of a robot at ``frame`` sees it."""
    bx, by, bz = to_body(slam.landmark, frame, values)
    cx, cy, cz = models.to_sensor(bx, by, bz, slam.sensor.mount)
    expected = measure(slam.sensor, cx, cy, cz)
    for i in range(observed_width(slam.sensor)):
        z[i] = expected[i]


@inner
def linearise_at(slam: Slam, frame: Frame, values: Array, z: Array, Hp: Array, Hl: Array) -> None:
    """z (s,), Hp (s, 3), Hl (s, w) <- h at ``frame`` and ``values`` (w,), and its Jacobians by variables of both."""
    body = to_body(slam.landmark, frame, values)
    mount = slam.sensor.mount
    cx, cy, cz = models.to_sensor(body[0], body[1], body[2], mount)
    expected = measure(slam.sensor, cx, cy, cz)
    for i in range(observed_width(slam.sensor)):
        z[i] = expected[i]
    J = measure_jacobian(slam.sensor, cx, cy, cz)
    for i in range(observed_width(slam.sensor)):
        j0, j1, j2 = J[3 * i], J[3 * i + 1], J[3 * i + 2]
        row: Triple = (
            j0 * mount.xx + j1 * mount.xy + j2 * mount.xz,
            j0 * mount.yx + j1 * mount.yy + j2 * mount.yz,
            j0 * mount.zx + j1 * mount.zy + j2 * mount.zz,
        )
        to_body_jacobian(slam.landmark, frame, values, body, row, Hp[i], Hl[i])


@inner
def linearise(
    slam: Slam,
    pose: Array,
    values: Array,
    k: int,
    label: int,
    z: Array,
    Hp: Array,
    Hl: Array,
    scratch: Scratch[NamedTuple],
) -> None:
    """z (s,) <- h expected of pose (3,), values (w,) in step k + 1; Hp (s, 3), Hl (s, w) <- Jacobians at the point."""
    at, landmark = observation_point(slam.point, pose, k), landmark_point(slam.point, values, label, scratch)
    linearise_at(slam, robot_frame(at), landmark, z, Hp, Hl)
    if expands(slam.point):
        for i in range(observed_width(slam.sensor)):
            for j in range(len(pose)):
                z[i] += Hp[i, j] * (pose[j] - at[j]) + Hl[i, j] * (values[j] - landmark[j])
    if stands_apart(slam.point):
        observe(slam, robot_frame(pose), values, z)


@inner
def place_observed(slam: Slam, pose: Array, z: Array, values: Array, scratch: Scratch[NamedTuple]) -> None:
    """values (w,) <- inverse of h at ``pose`` (3,) for z (s,); ``scratch.Jp`` (w, 3), ``Jz`` (w, s) <- Jacobians."""
    mount, Jb, s = slam.sensor.mount, scratch.Jb, observed_width(slam.sensor)
    cx, cy, cz = locate(slam.sensor, z)
    body = models.from_sensor(cx, cy, cz, mount)
    J = locate_jacobian(slam.sensor, z)
    for j in range(s):
        Jb[0, j] = mount.xx * J[j] + mount.xy * J[s + j] + mount.xz * J[2 * s + j]
        Jb[1, j] = mount.yx * J[j] + mount.yy * J[s + j] + mount.yz * J[2 * s + j]
        Jb[2, j] = mount.zx * J[j] + mount.zy * J[s + j] + mount.zz * J[2 * s + j]
    insert(slam.landmark, robot_frame(pose), body, Jb, mount, values, scratch.Jp, scratch.Jz)


@inner
def gather(slam: Slam, state: State, m: int, factors: Factors, scratch: Scratch[NamedTuple]) -> None:
    """``scratch.rows`` (3 + w m, n + base) <- rows of P and of Phi of the robot and of the ``m`` seen landmarks."""
    gather_all_rows(state, factors.Phi, landmark_width(slam.landmark), scratch.at, m, scratch.rows)


@inner
def linearise_seen(slam: Slam, state: State, k: int, m: int, scratch: Scratch[NamedTuple]) -> None:
    """``scratch``: zhat (s m,), Hp (m, s, 3), Hl (m, s, w) <- h of the seen landmarks, and Jacobians by the error."""
    pose, w, s = state.x[:3], landmark_width(slam.landmark), observed_width(slam.sensor)
    for i in range(m):
        o, expected = scratch.at[i], scratch.zhat[s * i : s * i + s]
        values = state.x[o : o + w]
        linearise(slam, pose, values, k, scratch.label[i], expected, scratch.Hp[i], scratch.Hl[i], scratch)
        to_error(slam.error, pose, values, scratch.Hp[i], scratch.Hl[i])


@inner
def combine_seen(slam: Slam, state: State, m: int, scratch: Scratch[NamedTuple]) -> None:
    """``scratch.A`` (s m, n + base) <- H P from the gathered rows; upper half of ``scratch.S`` (s m, s m) <- H P H'."""
    w, s = landmark_width(slam.landmark), observed_width(slam.sensor)
    A, S, Hp, Hl, width = scratch.A, scratch.S, scratch.Hp, scratch.Hl, state.n + state.base
    for i in range(m):
        combine(slam.landmark, Hp[i], Hl[i], scratch.rows[:, :width], i, A[s * i : s * i + s, :width])
    for i in range(m):
        o = scratch.at[i]
        for row in range(s * i + s):
            for a in range(s):
                total = 0.0
                for c in range(max(3, w)):
                    term = 0.0
                    if c < 3:
                        term += A[row, c] * Hp[i, a, c]
                    if c < w:
                        term += A[row, o + c] * Hl[i, a, c]
                    total += term
                S[row, s * i + a] = total


@inner
def innovate(slam: Slam, state: State, data: Data, m: int, scratch: Scratch[NamedTuple]) -> Array:
    """Innovation (s m,) of the ``m`` landmarks, which is the last column of ``scratch.A``."""
    s = observed_width(slam.sensor)
    y = scratch.A[: s * m, state.n + state.base]
    for i in range(m):
        measured, expected = data.z[scratch.known[i]], scratch.zhat[s * i : s * i + s]
        wrap_residual(slam.sensor, expected, measured)
        for a in range(s):
            y[s * i + a] = measured[a] - expected[a]
    return y


@inner
def correct_at_once(
    update: NamedTuple,
    slam: Slam,
    state: State,
    data: Data,
    k: int,
    m: int,
    has_innovation: bool,
    factors: Factors,
    scratch: Scratch[NamedTuple],
) -> tuple[int, float, float]:
    """The update of a filter that does not iterate: it uses what :func:`predict_innovation` leaves in ``scratch``."""
    code, total = 0, 0.0
    if not has_innovation:
        code, total = predict_innovation(update, slam, state, data, k, m, factors, scratch)
    if code > 0:
        return code, np.nan, np.nan
    code, nis, log_det = divide_by_root(state, observed_width(slam.sensor) * m, scratch, total)
    if code == 0:
        apply(slam, state, m, factors, scratch)
    return code, nis, log_det


@inner
def correct_iterated(
    update: Any,
    slam: Slam,
    state: State,
    data: Data,
    k: int,
    m: int,
    has_innovation: bool,
    factors: Factors,
    scratch: Scratch[Any],
) -> tuple[int, float, float]:
    """The update in ``update.passes``, each linearised where the one before led to, from the same prior."""
    w = landmark_width(slam.landmark)
    involved, first_nis, first_log_det = 3 + w * m, np.nan, np.nan
    gather(slam, state, m, factors, scratch)
    for a in range(involved):
        scratch.prior[a] = state.x[state_index(w, a, scratch.at)]
    for i in range(update.passes):
        if not innovate_again(update, slam, state, data, k, m, scratch):
            return POSE, np.nan, np.nan
        code, nis, log_det = whiten(slam, state, data, m, scratch)
        if code > 0:
            return code, nis, log_det
        if i == 0:
            first_nis, first_log_det = nis, log_det
        is_last = i == update.passes - 1
        for a in range(involved):
            j = state_index(w, a, scratch.at)
            state.x[j] = scratch.prior[a] + (0.0 if is_last else shift(slam, state, m, j, scratch))
    apply(slam, state, m, factors, scratch)
    return 0, first_nis, first_log_det


@inner
def whiten(slam: Slam, state: State, data: Data, m: int, scratch: Scratch[NamedTuple]) -> tuple[int, float, float]:
    """S (s m, s m) <- root of S + R; A and the innovation <- divided by it. As :func:`divide_by_root`."""
    total = add_noise(slam, state, data, m, scratch)
    return divide_by_root(state, observed_width(slam.sensor) * m, scratch, total)


@inner
def add_noise(slam: Slam, state: State, data: Data, m: int, scratch: Scratch[NamedTuple]) -> float:
    """S (s m, s m) <- S + R; returns a sum that is finite if innovation and S are."""
    s = observed_width(slam.sensor)
    rows, width = s * m, state.n + state.base
    S, joined = scratch.S[:rows, :rows], scratch.A[:rows, : width + 1]
    y, total = joined[:, width], 0.0
    for i in range(m):
        for a in range(s):
            row = s * i + a
            for c in range(s):
                S[row, s * i + c] += data.R[scratch.known[i], a, c]
            total += y[row] + sum_of(S[row, row:])
    return total


@inner
def divide_by_root(state: State, rows: int, scratch: Scratch[NamedTuple], total: float) -> tuple[int, float, float]:
    """S <- its root, and A and the innovation <- divided by it; ``total`` is finite if all that is given is.

    Returns a code of REASONS, 0 where all is well, the NIS, and log det S.
    """
    width = state.n + state.base
    S, joined = scratch.S[:rows, :rows], scratch.A[:rows, : width + 1]
    y = joined[:, width]
    if not definite_root(S, scratch.scale):
        return INNOVATION if np.isfinite(total) else NOT_FINITE, np.nan, np.nan
    solve_transposed(S, joined)
    nis, log_det = 0.0, 0.0
    for row in range(rows):
        nis += y[row] * y[row]
        log_det += 2.0 * np.log(S[row, row])
    if np.isfinite(nis):
        return 0, nis, log_det
    return INNOVATION if np.isfinite(total) else NOT_FINITE, np.nan, np.nan


@inner
def shift(slam: Slam, state: State, m: int, j: int, scratch: Scratch[NamedTuple]) -> float:
    """By how much the whitened gain moves variable j of an additive error."""
    total, y = 0.0, state.n + state.base
    for row in range(observed_width(slam.sensor) * m):
        total += scratch.A[row, j] * scratch.A[row, y]
    return total


@inner
def apply(slam: Slam, state: State, m: int, factors: Factors, scratch: Scratch[NamedTuple]) -> None:
    """x (n,) <- moved by W' S^-1/2 innovation, P (n, n) <- P - W' W; the columns of Phi as ``factors`` says."""
    rows, n = observed_width(slam.sensor) * m, state.n
    A, y = scratch.A[:rows, :n], scratch.A[:rows, n + state.base]
    retract(slam.error, slam, state, A, y, scratch)
    add_gram_to_state(-1.0, A, state.P, n)
    apply_beyond(state, rows, factors, scratch)


@inner
def apply_beyond(state: State, rows: int, factors: Factors, scratch: Scratch[NamedTuple]) -> None:
    """Phi, Psi and theta <- what a correction of the active part says of the rest."""
    n, base = state.n, state.base
    A, y = scratch.A[:rows, :n], scratch.A[:rows, n + base]
    if base > 0:
        beyond = scratch.A[:rows, n : n + base]
        add_product_of_transposed(-1.0, A, beyond, factors.Phi[:n, :base])
        add_gram(1.0, beyond, factors.Psi[:base, :base])
        add_transposed_times(beyond, y, factors.theta[:base])


@inner
def state_index(w: int, a: int, at: Indices) -> int:
    """Index in the state of the a-th of some variables: the robot's, then those of the landmarks at ``at``."""
    return a if a < 3 else at[(a - 3) // w] + (a - 3) % w


@inner
def gather_rows(P: Array, n: int, w: int, at: Indices, m: int, rows: Array) -> None:
    """``rows`` (3 + w m, n) <- whole rows of P (n, n): the robot's, then those of ``m`` landmarks at ``at`` (m,)."""
    copy_matrix(P[:3, :n], rows[:3, :n])
    for i in range(m):
        o, first = at[i], 3 + w * i
        for j in range(o):
            for a in range(w):
                rows[first + a, j] = P[j, o + a]
        for a in range(w):
            for j in range(o + a, n):
                rows[first + a, j] = P[o + a, j]
            for b in range(a):
                rows[first + a, o + b] = rows[first + b, o + a]


@inner
def gather_all_rows(state: State, Phi: Array, w: int, at: Indices, m: int, rows: Array) -> None:
    """:func:`gather_rows`, with those of Phi, which are treated alike, in columns n..n + base - 1."""
    n, base = state.n, state.base
    gather_rows(state.P, n, w, at, m, rows)
    for i in range(3 + w * m if base > 0 else 0):
        copy(Phi[state_index(w, i, at), :base], rows[i, n : n + base])


@inner
def definite_root(A: Array, scale: Array) -> bool:
    """Upper half of A (n, n) <- its root, ``scale`` (n,) <- its diagonal; False where a pivot is not above rounding."""
    for i in range(len(A)):
        scale[i] = A[i, i]
    definite = upper_cholesky(A)
    for i in range(len(A)):
        definite = definite and A[i, i] * A[i, i] > DEFICIENT * scale[i]
    return definite


@inner
def add_gram_to_state(weight: float, W: Array, P: Array, n: int) -> None:
    """P (n, n) <- P + weight W' W with W (k, n); the block of the robot is valid as a whole."""
    add_gram(weight, W, P[:n, :n])
    mirror(P)


@inner
def mirror(P: Array) -> None:
    """The lower half of the block of the robot <- its upper half."""
    for a in range(3):
        for b in range(a):
            P[a, b] = P[b, a]


@inner
def replace_rows(P: Array, n: int, o: int, rows: Array, own: Array) -> None:
    """Rows and columns of the three variables at ``o`` <- ``rows`` (3, >= n), their own block <- ``own`` (3, 3)."""
    for j in range(o):
        for a in range(3):
            P[j, o + a] = rows[a, j]
    for a in range(3):
        for j in range(o + 3, n):
            P[o + a, j] = rows[a, j]
        for b in range(a, 3):
            P[o + a, o + b] = P[o + b, o + a] = 0.5 * (own[a, b] + own[b, a])


@inner
def move_block(P: Array, n: int, o: int, F: Array) -> None:
    """P (n, n) <- G P G', with G the identity but for its block F (3, 3) at ``o``, beyond the robot's."""
    for j in range(o):
        multiply_columns(P[j], o, F)
    multiply_rows(P[o : o + 3], F, o + 3, n)
    p0, p1, p2 = P[o], P[o + 1], P[o + 2]
    xx, xy, xz, yy, yz, zz = p0[o], p0[o + 1], p0[o + 2], p1[o + 1], p1[o + 2], p2[o + 2]
    for a in range(3):
        v0 = F[a, 0] * xx + F[a, 1] * xy + F[a, 2] * xz
        v1 = F[a, 0] * xy + F[a, 1] * yy + F[a, 2] * yz
        v2 = F[a, 0] * xz + F[a, 1] * yz + F[a, 2] * zz
        for b in range(a, 3):
            P[o + a, o + b] = v0 * F[b, 0] + v1 * F[b, 1] + v2 * F[b, 2]


@inner
def multiply_rows(rows: Array, F: Array, first: int, last: int) -> None:
    """``rows`` (3, n) <- F rows in columns first..last-1, with F (3, 3)."""
    p0, p1, p2 = rows[0], rows[1], rows[2]
    for j in range(first, last):
        v0, v1, v2 = p0[j], p1[j], p2[j]
        p0[j] = F[0, 0] * v0 + F[0, 1] * v1 + F[0, 2] * v2
        p1[j] = F[1, 0] * v0 + F[1, 1] * v1 + F[1, 2] * v2
        p2[j] = F[2, 0] * v0 + F[2, 1] * v1 + F[2, 2] * v2


@inner
def multiply_columns(row: Array, o: int, F: Array) -> None:
    """The three entries of ``row`` (n,) at ``o`` <- F times them."""
    v0, v1, v2 = row[o], row[o + 1], row[o + 2]
    for a in range(3):
        row[o + a] = F[a, 0] * v0 + F[a, 1] * v1 + F[a, 2] * v2


@inner
def begin_landmark(P: Array, n: int, o: int, Jp: Array, Jz: Array, R: Array) -> None:
    """Rows and columns at ``o`` of P (n, n) <- covariance of a new landmark there, Jp (w, 3), Jz (w, s), R (s, s)."""
    w = len(Jp)
    for j in range(o):
        for a in range(w):
            P[j, o + a] = across(P, j, Jp, a)
    for a in range(w):
        for j in range(o + w, n):
            P[o + a, j] = across(P, j, Jp, a)
        for b in range(a, w):
            P[o + a, o + b] = 0.5 * (_own(P, o, Jp, Jz, R, a, b) + _own(P, o, Jp, Jz, R, b, a))


@inner
def across(P: Array, j: int, Jp: Array, a: int) -> float:
    """Entry (a, j) of Jp P_pose,all, (w, n)."""
    total = 0.0
    for c in range(Jp.shape[1]):
        total += Jp[a, c] * P[c, j]
    return total


@inner
def _own(P: Array, n: int, Jp: Array, Jz: Array, R: Array, a: int, b: int) -> float:
    """Entry (a, b) of Jp P_pose Jp' + Jz R Jz', (w, w)."""
    s, total = Jz.shape[1], 0.0
    for c in range(max(3, s)):
        if c < 3:
            total += P[c, n + a] * Jp[b, c]
        if c < s:
            for d in range(s):
                total += Jz[a, c] * R[c, d] * Jz[b, d]
    return total
