"""Estimates moved from their own world frame into that of the truth.

The frame is that of least NEES, and the covariances are those of the residual errors.

Errors of estimates are carried with them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.diagnostics.record import TruthFit
from consistency.referee.diagnostics.residuals_of_fit import ENOUGH, inflation_of_mean, left_covariances
from consistency.referee.diagnostics.verdict_parts import BIAS, GROUP, INNOVATIONS, MAIN, SHARES, STEP
from consistency.referee.diagnostics.whitening import by_runs, whiten
from consistency.referee.errors import InputError
from consistency.referee.geometry import (
    CHARTS,
    adjoint,
    from_left,
    inverse,
    matrices,
    propagated,
    to_left,
    vectors,
    wrap,
)
from consistency.referee.readers.clocks import CLOCK_ROUNDS, SETTLED, clock_shift
from consistency.referee.readers.truth_matching import Known, Manifold, Poses, finite_rows, submatrices
from consistency.referee.types import Array, Indices

FREE = {  # directions (d, 6) in which a frame may move: shift along x, y, z, turn about them
    ("posyaw", "spatial"): np.eye(6)[[0, 1, 2, 5]],
    ("posyaw", "planar"): np.eye(6)[[0, 1, 5]],
    ("posyaw", "vector"): np.eye(6)[[0, 1, 2, 5]],  # of positions alone
    ("se3", "spatial"): np.eye(6),
}
LEAST = 0.05  # least share of its NEES that a run keeps; a run of a step or two might keep none
COMMON = 0.25  # largest variance of the frame, over that of the mean error of all runs, to judge single steps
ALL_BUT_SCALE = tuple(q for q in SHARES if q != MAIN and q not in INNOVATIONS)
OF_RUNS = "what is constant over a run, a covariance that is too large, and single steps and axes are not judged"
OF_ALL = "an error that is the same in all runs and steps is not judged"
OSCILLATING = "the errors alternate or oscillate, so that it is not known what the frame takes of them"
NO_MEAN = "the errors cancel over each run, so that the frame's own error outweighs their mean"
SLIGHT = 0.01  # of a covariance: what an uncertain first pose adds to the others, and counts as nothing below
DIFFERENCE = 1e-6  # m or rad, over which the change of an error is taken
FRAME_ROUNDS = 20  # steps of a fit at most
DONE = 1e-3  # size of the last one, in stated standard deviations: the next is its square
RANK = 1e-10  # of the largest singular value: directions that no error shows
PLANE = (0, 1, 5)  # components of a pose in the plane, of one in space


@dataclass(frozen=True)
class Aligned:
    """Runs in the world of the truth, with notes on the alignment."""

    runs: Sequence[Poses]  # moved estimates, with covariances of the residual errors
    fit: TruthFit  # what the frames leave of the errors
    notes: tuple[str, ...] = ()


def frames_of(name: str, runs: Sequence[Poses], mode: str, judged: Sequence[int]) -> list[WorldTransform]:
    """The frame of each run.

    Raises
    ------
    InputError
        The errors are not those of a pose that such a frame has, or no estimate can be aligned.
    """
    if mode == "origin":
        return [frame_of_first_pose(name, p) for p in runs]
    free = _directions(mode, runs)
    if mode.endswith("-all"):
        return [frame_of_least_nees(name, runs, free, judged)] * len(runs)
    return [frame_of_least_nees(name, [p], free, judged) for p in runs]


def _directions(mode: str, runs: Sequence[Poses]) -> Array:
    """Directions (d, 6) in which frames of a mode may move."""
    key = mode.removesuffix("-all"), runs[0].manifold
    if key not in FREE:
        raise InputError(f"--align {mode}: turns about x and y are for poses in space; for x, y, heading it is posyaw")
    return FREE[key]


def clocks_and_frames(
    name: str, runs: Sequence[Poses], time_offset: float | str | None, align: str, judged: Sequence[int]
) -> tuple[float, list[str], Aligned]:
    """Time to add to the timestamps, s, notes on it, and the runs in the world of the truth, in turn until both settle.

    Parameters
    ----------
    align : one of ``ALIGNMENTS`` but none
    judged : components of the error that are judged, and by which frames are fitted

    Raises
    ------
    InputError
        The offset cannot be estimated, or nothing can be aligned.
    """
    shift = 0.0
    if isinstance(time_offset, float):
        shift = time_offset
    for _ in range(CLOCK_ROUNDS):
        before = shift
        later = [p.later(shift) for p in runs]
        frames = frames_of(name, later, align, judged)
        shift, notes = clock_shift(name, _moved(runs, frames), time_offset, judged)
        if abs(shift - before) <= SETTLED:
            break
    later = [p.later(shift) for p in runs]
    found = aligned(name, later, align, judged, frames if shift == before else None)
    as_before = []
    for p, own in zip(found.runs, runs, strict=True):
        as_before.append(p.with_values(t=own.own.t))
    return shift, notes, replace(found, runs=as_before)


def _moved(runs: Sequence[Poses], frames: Sequence[WorldTransform]) -> list[Poses]:
    return [moved(p, frame) for p, frame in zip(runs, frames, strict=True)]


def aligned(
    name: str, runs: Sequence[Poses], mode: str, judged: Sequence[int], frames: Sequence[WorldTransform] | None = None
) -> Aligned:
    """Runs moved into the world of the truth by frames of least NEES, or by their first poses (``origin``).

    The covariance is multiplied by the share of the NEES that a run keeps, which
    ``diagnostics.imperfect_truth.residuals_of_fit.left_covariances`` finds. Only the sum of the NEES of a run is
    known: a frame may make errors larger in some steps or axes. Fewer than ``ENOUGH`` runs do not show the share; their
    covariance is unchanged, and too large. After ``origin`` it is a bound, as files lack the correlation with the
    first pose.

    Parameters
    ----------
    frames : frame of each run, if known

    Raises
    ------
    InputError
        The errors have no such frame, or no estimate can be aligned, as in :func:`frames_of`.
    """
    if frames is None:
        frames = frames_of(name, runs, mode, judged)
    there = _moved(runs, frames)
    found = _from_first(name, there, judged) if mode == "origin" else _fitted(name, there, mode, judged)
    if len(frames) == 1 or mode.endswith("-all"):
        x, y, z = np.rad2deg(frames[0].turn.as_rotvec())
        of = mode
        turns = f"({x:.4g}, {y:.4g}, {z:.4g}) degrees about x, y, z"
        x, y, z = frames[0].shift
        shifts = f"({x:.4g}, {y:.4g}, {z:.4g})"
    else:
        of = f"{mode}, each of {len(frames)} runs by itself"
        turns = f"{_span(np.rad2deg([frame.turn.magnitude() for frame in frames]))} degrees"
        shifts = _span(np.linalg.norm([frame.shift for frame in frames], axis=1))
    sizes = f"{name}: aligned by {of}: turned by {turns} and shifted by {shifts} m"
    return replace(found, fit=replace(found.fit, align=mode), notes=(sizes, *found.notes))


# --- residual errors -------------------------------------------------------------------------------------------


def _fitted(name: str, runs: Sequence[Poses], mode: str, judged: Sequence[int]) -> Aligned:
    """Covariances of the residuals of a fit; unchanged where these are not known."""
    for_all = mode.endswith("-all")
    free = _directions(mode, runs)
    residuals = []
    tangents = []
    some = []
    for i, p in enumerate(runs):
        sound = sound_of(p, judged)
        if len(sound.rows):
            some.append(i)
            residuals.append(sound.whitened)
            tangents.append(tangent(p, sound, free))
    of = "each run"
    if for_all:
        bases = orthonormal(tangents)
        of = "all runs"
    else:
        bases = [orthonormal([A])[0] for A in tangents]
    dof = max(Q.shape[-1] for Q in bases)
    what = f"aligned by {mode}, a frame of {dof} degrees of freedom for {of}"
    of_runs = Aligned(runs, TruthFit(caption=f"{what}: {OF_RUNS}", reduced=True, unavailable=ALL_BUT_SCALE))
    if len(some) < ENOUGH:
        note = f"fewer than {ENOUGH} runs do not show what the frame takes of the errors; nothing makes up for it"
        return replace(of_runs, notes=(f"{name}: {note}",))
    left = left_covariances(residuals, bases, for_all)
    if left.oscillating:
        most = f"at most about {100.0 * left.unseen:.2g} % of the NEES"
        note = f"the errors alternate or oscillate; nothing makes up for what the frame takes of them, {most}"
        caption = f"{of_runs.fit.caption}, and {OSCILLATING} ({most})"
        fit = replace(of_runs.fit, caption=caption, unseen=left.unseen)
        return replace(of_runs, fit=fit, notes=(f"{name}: {note}",))
    kept = np.empty(len(some))
    largest = 0.0
    for k, M in enumerate(left.covariances):
        share = float(np.trace(M, axis1=1, axis2=2).mean()) / len(judged)
        kept[k] = max(share, LEAST)
        of_run = float(np.linalg.eigvalsh(M)[:, -1].max())
        largest = max(largest, of_run)
    out = list(runs)
    for i, share in zip(some, kept, strict=True):
        out[i] = runs[i].with_values(covariance=runs[i].own.covariance * share)
    taken = 100.0 * (1.0 - kept.mean())
    notes = (f"{name}: the frame takes {taken:.2g} % of the NEES of a right covariance, made up for",)
    if not for_all:
        return replace(of_runs, runs=out, notes=notes)
    fit = TruthFit(caption=f"{what}: {OF_ALL}")
    if len(some) * (largest - 1.0) > COMMON:
        fit = TruthFit(caption=f"{fit.caption}, nor are single steps", unavailable=(STEP, GROUP, *BIAS))
    elif inflation_of_mean(residuals, bases) > 1.0 + COMMON:
        fit = TruthFit(caption=f"{fit.caption}, nor is a bias: {NO_MEAN}", unavailable=BIAS)
    return Aligned(out, fit, notes)


def _from_first(name: str, runs: Sequence[Poses], judged: Sequence[int]) -> Aligned:
    out = []
    factors = []
    for p in runs:
        first, larger_by = from_first_pose(name, p, judged)
        out.append(first)
        factors.append(larger_by)
    every = np.concatenate(factors)
    larger = 1.0
    if len(every):
        larger = float(np.median(every))
    if larger < 1.0 + SLIGHT:
        return Aligned(
            out, TruthFit(caption="aligned by origin: the error of the first pose of each run is not judged")
        )
    note = (
        f"{name}: the first pose is not exact, and files do not say how its error is correlated with the others; "
        f"covariances are made {larger:.3g} times as large in the median, which holds whatever that is"
    )
    caption = "aligned by origin, whose first poses are not exact: a covariance that is too large is not judged"
    return Aligned(out, TruthFit(caption=caption, reduced=True, unavailable=(*BIAS, "outliers")), (note,))


def _span(values: Array) -> str:
    return f"{values.min():.3g} to {values.max():.3g} (median {np.median(values):.3g})"


# --- frames -------------------------------------------------------------------------------------------------


def frame_of_first_pose(name: str, p: Poses) -> WorldTransform:
    """The frame in which the first pose is the true one.

    Raises
    ------
    InputError
        No estimate is finite and has a truth and a covariance.
    """
    row, truth = _first(name, p)
    own = p.own.estimate[[row]]
    true = truth[None]
    turns = rotations(true, p.manifold) * rotations(own, p.manifold).inv()
    turn = turns[0]
    shift = positions(true, p.manifold) - turn.apply(positions(own, p.manifold))
    return WorldTransform(turn, shift[0])


def _first(name: str, p: Poses) -> tuple[int, Array]:
    """Row of the first estimate that is finite and has a truth and a covariance, and its truth (m,)."""
    known = p.known()
    fine = p.own.stated[known.rows] & finite_rows(p.own.estimate[known.rows])
    fine &= finite_rows(p.own.covariance[known.rows])
    if not fine.any():
        raise InputError(f"--align origin: a run of {name} has no estimate with a truth and a covariance to begin at")
    k = int(np.argmax(fine))
    return int(known.rows[k]), known.truth[k]


def from_first_pose(name: str, p: Poses, judged: Sequence[int]) -> tuple[Poses, Array]:
    """A run whose first pose is the true one, with bounds of the covariances of the residual errors.

    The error of step k less that of the first pose, seen in step k with covariance R_k, has a covariance of at most
    (1 + t) P_k + (1 + 1/t) R_k for any t > 0, whatever their correlation (Young's inequality); t^2 = tr(P_k^-1 R_k) / n
    makes the sum of its variances, in units of those of P_k, least. If the first pose is exact it is P_k. The
    covariance of the first pose itself, which has no error now, is 0.

    Returns
    -------
    the run, and (k,) how many times as large its covariances are in the mean over components
    """
    row, truth = _first(name, p)
    sound = sound_of(p, judged)
    n = p.own.covariance.shape[-1]
    free = np.eye(6)
    if n == 3:
        free = free[[0, 1, 5]]
    plain = p.with_values(covariance=np.tile(np.eye(n), (len(p.own.t), 1, 1)))
    first = Sound(np.array([row]), truth[None], np.zeros((1, n)), range(n))
    of_first = tangent(plain, first, free)[0]
    J = tangent(plain, replace(sound, judged=range(n)), free) @ np.linalg.inv(of_first)
    seen = submatrices(J @ p.own.covariance[row] @ np.swapaxes(J, 1, 2), judged)
    own = submatrices(p.own.covariance[sound.rows], judged)
    ratio = np.linalg.solve(own, seen)
    size = np.trace(ratio, axis1=1, axis2=2) / len(judged)
    t = np.sqrt(np.maximum(size, 0.0))
    wide = t[:, None, None]
    bound = (1.0 + wide) * own + seen + seen / np.where(wide > 0, wide, 1.0)
    P = p.own.covariance.copy()
    index = np.array(judged)
    mirrored = np.swapaxes(bound, 1, 2)
    P[np.ix_(sound.rows, index, index)] = 0.5 * (bound + mirrored)
    P[row] = 0.0
    return p.with_values(covariance=P), np.square(1.0 + t[sound.rows != row])


@dataclass(frozen=True)
class Sound:
    """Estimates of one run that have truth and a covariance of full rank, k of them."""

    rows: Indices  # (k,)
    truth: Array  # (k, m)
    whitened: Array  # (k, n), errors of the components that are judged
    judged: Sequence[int]  # (n,)


def sound_of(p: Poses, judged: Sequence[int], known: Known | None = None) -> Sound:
    """Estimates usable for an alignment; ``known`` is the truth at all timestamps, if already computed."""
    if known is None:
        known = p.known()
    w = _whitened(p, known.rows, p.error_of(known.rows, known.truth), judged)
    fine = finite_rows(w) & p.own.stated[known.rows]
    return Sound(known.rows[fine], known.truth[fine], w[fine], judged)


def _whitened(p: Poses, rows: Indices, error: Array, judged: Sequence[int]) -> Array:
    index = list(judged)

    def of_block(e: Array, at: Indices) -> Array:
        return whiten(e[:, index], submatrices(p.own.covariance[at], index))

    return by_runs(of_block, error, rows)


def tangent(p: Poses, sound: Sound, free: Array) -> Array:
    """Change of the whitened errors with a small motion of the world of the estimates, (k, n, d).

    The truth is moved the other way instead: errors and covariances are carried alike, so that the whitened errors
    are the same but for a turn of their axes.

    Parameters
    ----------
    free : (d, 6), directions in which the world moves: shift, then rotation vector
    """

    def of_block(truth: Array, rows: Indices) -> Array:
        out = np.empty((len(rows), len(sound.judged), len(free)))
        for k, motion in enumerate(DIFFERENCE * free):
            after = p.error_of(rows, _small(-motion).placed(truth, p.manifold))
            before = p.error_of(rows, _small(motion).placed(truth, p.manifold))
            change = (after - before) / (2.0 * DIFFERENCE)
            out[:, :, k] = _whitened(p, rows, change, sound.judged)
        return out

    return by_runs(of_block, sound.truth, sound.rows)


def _small(motion: Array) -> WorldTransform:
    return WorldTransform(Rotation.from_rotvec(motion[3:]), motion[:3])


def frame_of_least_nees(name: str, runs: Sequence[Poses], free: Array, judged: Sequence[int]) -> WorldTransform:
    """The frame in which the sum of the NEES of all ``runs`` is least, by Gauss-Newton iteration.

    Raises
    ------
    InputError
        No estimate has a truth and a covariance of full rank.
    """
    known = [p.known() for p in runs]

    def at(frame: WorldTransform) -> tuple[float, list[tuple[Poses, Sound]]]:
        found = []
        nees = 0.0
        for p, k in zip(runs, known, strict=True):
            there = moved(p, frame)
            sound = sound_of(there, judged, k)
            found.append((there, sound))
            nees += float(np.square(sound.whitened).sum())
        return nees, found

    frame = turned_frame(runs) if free[:, 3:5].any() else fitted_frame(runs) or IDENTITY
    nees, found = at(frame)
    if not any(len(sound.rows) for _, sound in found):
        raise InputError(f"--align: no estimate of {name} has a truth and a covariance of full rank to be aligned by")
    for _ in range(FRAME_ROUNDS):
        step, size = _step(found, free)
        further = _small(step @ free).after(frame)
        while size > DONE and (tried := at(further))[0] > nees:
            step = 0.5 * step
            size = 0.5 * size
            further = _small(step @ free).after(frame)
        frame = further
        if size <= DONE:
            break
        nees, found = tried
    return frame


def _step(found: Sequence[tuple[Poses, Sound]], free: Array) -> tuple[Array, float]:
    """Gauss-Newton step (d,), and its length in stated standard deviations."""
    tangents = []
    whitened = []
    for p, sound in found:
        tangents.append(tangent(p, sound, free).reshape(-1, len(free)))
        whitened.append(sound.whitened.ravel())
    A = np.concatenate(tangents)
    w = np.concatenate(whitened)
    scale = _column_norms(A)
    step = -np.linalg.lstsq(A / scale, w, rcond=RANK)[0] / scale
    return step, float(np.linalg.norm(A @ step))


def _column_norms(A: Array) -> Array:
    size = np.sqrt(np.square(A).sum(axis=0))
    return np.where(size > 0, size, 1.0)


def orthonormal(tangents: Sequence[Array]) -> list[Array]:
    """Columns Q, (k, n, d) of each run, that span the tangents of one frame of all runs; fewer where some are 0."""
    A = np.concatenate([each.reshape(-1, each.shape[-1]) for each in tangents])
    U, s, _ = np.linalg.svd(A / _column_norms(A), full_matrices=False)
    U = U[:, s > RANK * s[0]]
    bases = []
    start = 0
    for each in tangents:
        end = start + each.shape[0] * each.shape[1]
        bases.append(U[start:end].reshape(*each.shape[:2], -1))
        start = end
    return bases


@dataclass(frozen=True)
class WorldTransform:
    """Maps a point x of the world of the estimates to turn x + shift in that of the truth."""

    turn: Rotation
    shift: Array  # (3,), m; 0 along z in the plane

    @staticmethod
    def about_z(angle: float, shift: Array) -> WorldTransform:
        """Turn by ``angle``, rad, and shift (2,) or (3,), m."""
        level = np.zeros(3 - len(shift))
        return WorldTransform(Rotation.from_euler("z", angle), np.append(shift, level))

    @property
    def heading(self) -> float:
        """Turn about z, rad, of a frame that turns about nothing else."""
        return float(self.turn.as_rotvec()[2])

    def after(self, other: WorldTransform) -> WorldTransform:
        """Composition of frames: first ``other``, then this one."""
        return WorldTransform(self.turn * other.turn, self.turn.apply(other.shift) + self.shift)

    def placed(self, values: Array, manifold: Manifold) -> Array:
        """Poses or positions (k, m) of one world in the other; those that are not finite stay."""
        out: Array = values.copy()
        finite = finite_rows(values)
        if manifold == "planar":
            R = self.turn.as_matrix()[:2, :2]
            out[:, :2] = values[:, :2] @ R.T + self.shift[:2]
            out[:, 2] = wrap(values[:, 2] + self.heading)
        elif finite.any():
            out[finite, :3] = self.turn.apply(values[finite, :3]) + self.shift
            if manifold == "spatial":
                turned = self.turn * Rotation.from_quat(values[finite, 3:])
                out[finite, 3:] = turned.as_quat()
        return out


IDENTITY = WorldTransform(Rotation.identity(), np.zeros(3))


def moved(p: Poses, frame: WorldTransform) -> Poses:
    """The estimates in another world, with their covariance."""
    estimate = frame.placed(p.own.estimate, p.manifold)
    if p.convention in CHARTS:
        finite = finite_rows(p.own.estimate)
        before, after = (matrices(poses[finite]) for poses in (p.own.estimate, estimate))
        J = from_left(after, p.convention) @ to_left(before, p.convention)
        covariance = p.own.covariance.copy()
        covariance[finite] = propagated(J, p.own.covariance[finite])
        return p.with_values(estimate=estimate, covariance=covariance)
    T = carried(p.convention, frame, p.own.covariance.shape[-1])
    return p.with_values(estimate=estimate, covariance=T @ p.own.covariance @ T.T)


def carried(convention: str, frame: WorldTransform, n: int) -> Array:
    """Matrix (n, n) that carries an error of a pose over to another world.

    An error in the body frame is unchanged; that of ``right`` maps by the adjoint (Sola et al. 2018, eq. 159 and 175).
    """
    F = matrices(np.array([[*frame.shift, *frame.turn.as_quat()]]))
    T: Array = from_left(F, convention)[0]
    if n == 6:
        return T
    return T[np.ix_(PLANE[:n], PLANE[:n])]


def fitted_frame(runs: Sequence[Poses]) -> WorldTransform | None:
    """The turn about z and the shift with which the positions of all runs are nearest to the truth.

    Umeyama (1991), in the plane. None with fewer than three estimates.
    """
    own, true = _positions(runs)
    if len(own) < 3:
        return None
    a = own - own.mean(axis=0)
    b = true - true.mean(axis=0)
    across = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()
    along = (a[:, :2] * b[:, :2]).sum()
    angle = float(np.arctan2(across, along))
    turn = Rotation.from_euler("z", angle)
    return WorldTransform(turn, true.mean(axis=0) - turn.apply(own.mean(axis=0)))


def turned_frame(runs: Sequence[Poses]) -> WorldTransform:
    """The frame in which orientations of poses in space, and then positions, are right on average."""
    turns = []
    for p in runs:
        own, true = matched(p)
        if len(own):
            apart = rotations(true, p.manifold) * rotations(own, p.manifold).inv()
            turns.append(apart.mean())
    if not turns:
        return IDENTITY
    turn = Rotation.concatenate(turns).mean()
    own, true = _positions(runs)
    return WorldTransform(turn, true.mean(axis=0) - turn.apply(own.mean(axis=0)))


def spread(runs: Sequence[Poses]) -> float:
    """Root mean square distance of the true positions from their mean, m; 0 where there are none."""
    true = _positions(runs)[1]
    if not len(true):
        return 0.0
    squares = np.square(true - true.mean(axis=0)).sum(axis=1)
    return float(np.sqrt(squares.mean()))


def _positions(runs: Sequence[Poses]) -> tuple[Array, Array]:
    """Estimated and true positions (N, 3) of all runs, z = 0 in the plane."""
    own = [np.empty((0, 3))]
    true = [np.empty((0, 3))]
    for p in runs:
        estimate, truth = matched(p)
        own.append(positions(estimate, p.manifold))
        true.append(positions(truth, p.manifold))
    return np.concatenate(own), np.concatenate(true)


def matched(p: Poses) -> tuple[Array, Array]:
    """Estimates that are finite and have a truth, and that truth, (k, m) both."""
    known = p.known()
    estimate = p.own.estimate[known.rows]
    finite = finite_rows(estimate)
    return estimate[finite], known.truth[finite]


@dataclass(frozen=True)
class BodyTransform:
    """The body of the truth as that of the estimates sees it."""

    turn: Rotation  # about z in the plane
    arm: Array  # (3,), m; 0 along z in the plane


def fitted_body(runs: Sequence[Poses]) -> BodyTransform | None:
    """The turn and the lever arm with which poses in a common world are nearest to the truth; None without a pose.

    The turn is the mean of R_estimate' R_truth, the arm the mean of R_estimate' (p_truth - p_estimate).
    """
    turns = []
    arms = []
    for p in runs:
        own, true = matched(p)
        if len(own):
            back = rotations(own, p.manifold).inv()
            turns.append((back * rotations(true, p.manifold)).mean())
            gap = positions(true, p.manifold) - positions(own, p.manifold)
            arms.append(back.apply(gap))
    if not turns:
        return None
    arm = np.concatenate(arms).mean(axis=0)
    return BodyTransform(Rotation.concatenate(turns).mean(), arm)


def on_body(p: Poses, body: BodyTransform) -> Poses:
    """The estimates as poses of the other body, with their covariance to first order.

    The left error of T B is Ad(B)^-1 e of the left error e of T (Sola et al. 2018, eq. 175).
    """
    finite = finite_rows(p.own.estimate)
    pose = [*body.arm, *body.turn.as_quat()]
    if p.manifold == "planar":
        pose = [*body.arm[:2], body.turn.as_rotvec()[2]]
    B = matrices(np.array([pose]))
    T = matrices(p.own.estimate[finite])
    other = T @ B
    J = from_left(other, p.convention) @ adjoint(inverse(B)) @ to_left(T, p.convention)
    estimate = p.own.estimate.copy()
    covariance = p.own.covariance.copy()
    estimate[finite] = vectors(other)
    covariance[finite] = propagated(J, p.own.covariance[finite])
    return p.with_values(estimate=estimate, covariance=covariance)


def skew(v: Array) -> Array:
    """Matrices (..., 3, 3) of the cross product with v (..., 3)."""
    return np.asarray(np.cross(np.eye(3), v[..., None, :]))


def rotations(values: Array, manifold: Manifold) -> Rotation:
    """Orientations of poses (k, m)."""
    if manifold == "planar":
        return Rotation.from_rotvec(values[:, 2:3] * [0.0, 0.0, 1.0])
    return Rotation.from_quat(values[:, 3:])


def positions(values: Array, manifold: Manifold) -> Array:
    """Positions (k, 3) of poses (k, m), z = 0 in the plane."""
    if manifold == "planar":
        return np.pad(values[:, :2], ((0, 0), (0, 1)))
    return values[:, :3]
