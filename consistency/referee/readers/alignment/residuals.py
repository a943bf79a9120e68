"""Estimates moved from their own world frame into that of the truth, and the covariances of the residual errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from consistency.referee.diagnostics.imperfect_truth.residuals_of_fit import ENOUGH, inflation_of_mean, left_covariances
from consistency.referee.diagnostics.verdict.answers import BIAS, GROUP, INNOVATIONS, MAIN, SHARES, STEP
from consistency.referee.errors import InputError
from consistency.referee.readers.alignment.frame_fit import Sound, frame_of_least_nees, orthonormal, sound_of, tangent
from consistency.referee.readers.alignment.world_frames import WorldTransform, moved, positions, rotations
from consistency.referee.readers.clock_offset import CLOCK_ROUNDS, SETTLED, clock_shift
from consistency.referee.readers.truth_matching import Poses, finite_rows, submatrices
from consistency.referee.types import Array

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


@dataclass(frozen=True)
class Aligned:
    """Runs in the world of the truth, with notes on the alignment."""

    runs: Sequence[Poses]  # moved estimates, with covariances of the residual errors
    align: str = "none"  # the mode
    notes: tuple[str, ...] = ()
    caption: str = ""  # what the verdict has to say of it
    reduced: bool = False  # the errors may be smaller than the covariance says without a fault
    unavailable: tuple[str, ...] = ()  # questions that have no answer
    unseen: float = 0.0  # share of the NEES that a frame may have absorbed without a correction

    @property
    def of_record(self) -> dict[str, Any]:
        """What a record has of it."""
        return {name: value for name, value in vars(self).items() if name not in ("runs", "notes")}


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
        as_before.append(replace(p, t=own.t))
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
    sizes = _sizes_in_words(name, mode, frames)
    return replace(found, align=mode, notes=(sizes, *found.notes))


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
            tangents.append(tangent(p, sound, free, judged))
    of = "each run"
    if for_all:
        bases = orthonormal(tangents)
        of = "all runs"
    else:
        bases = [orthonormal([A])[0] for A in tangents]
    dof = max(Q.shape[-1] for Q in bases)
    what = f"aligned by {mode}, a frame of {dof} degrees of freedom for {of}"
    of_runs = Aligned(runs, caption=f"{what}: {OF_RUNS}", reduced=True, unavailable=ALL_BUT_SCALE)
    if len(some) < ENOUGH:
        note = f"fewer than {ENOUGH} runs do not show what the frame takes of the errors; nothing makes up for it"
        return replace(of_runs, notes=(f"{name}: {note}",))
    left = left_covariances(residuals, bases, for_all)
    if left.oscillating:
        most = f"at most about {100.0 * left.unseen:.2g} % of the NEES"
        note = f"the errors alternate or oscillate; nothing makes up for what the frame takes of them, {most}"
        caption = f"{of_runs.caption}, and {OSCILLATING} ({most})"
        return replace(of_runs, notes=(f"{name}: {note}",), caption=caption, unseen=left.unseen)
    kept = np.empty(len(some))
    largest = 0.0
    for k, M in enumerate(left.covariances):
        share = float(np.trace(M, axis1=1, axis2=2).mean()) / len(judged)
        kept[k] = max(share, LEAST)
        of_run = float(np.linalg.eigvalsh(M)[:, -1].max())
        largest = max(largest, of_run)
    out = list(runs)
    for i, share in zip(some, kept, strict=True):
        out[i] = replace(runs[i], covariance=runs[i].covariance * share)
    taken = 100.0 * (1.0 - kept.mean())
    notes = (f"{name}: the frame takes {taken:.2g} % of the NEES of a right covariance, made up for",)
    if not for_all:
        return replace(of_runs, runs=out, notes=notes)
    of_all = Aligned(out, notes=notes, caption=f"{what}: {OF_ALL}")
    if len(some) * (largest - 1.0) > COMMON:
        return replace(of_all, caption=f"{of_all.caption}, nor are single steps", unavailable=(STEP, GROUP, *BIAS))
    if inflation_of_mean(residuals, bases) > 1.0 + COMMON:
        return replace(of_all, caption=f"{of_all.caption}, nor is a bias: {NO_MEAN}", unavailable=BIAS)
    return of_all


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
        return Aligned(out, caption="aligned by origin: the error of the first pose of each run is not judged")
    note = (
        f"{name}: the first pose is not exact, and files do not say how its error is correlated with the others; "
        f"covariances are made {larger:.3g} times as large in the median, which holds whatever that is"
    )
    caption = "aligned by origin, whose first poses are not exact: a covariance that is too large is not judged"
    return Aligned(out, notes=(note,), caption=caption, reduced=True, unavailable=(*BIAS, "outliers"))


# --- words --------------------------------------------------------------------------------------------------


def _sizes_in_words(name: str, mode: str, frames: Sequence[WorldTransform]) -> str:
    if len(frames) == 1 or mode.endswith("-all"):
        x, y, z = np.rad2deg(frames[0].turn.as_rotvec())
        turned = f"turned by ({x:.4g}, {y:.4g}, {z:.4g}) degrees about x, y, z"
        x, y, z = frames[0].shift
        return f"{name}: aligned by {mode}: {turned} and shifted by ({x:.4g}, {y:.4g}, {z:.4g}) m"
    turns = _span(np.rad2deg([frame.turn.magnitude() for frame in frames]))
    shifts = _span(np.linalg.norm([frame.shift for frame in frames], axis=1))
    each = f"each of {len(frames)} runs by itself"
    return f"{name}: aligned by {mode}, {each}: turned by {turns} degrees and shifted by {shifts} m"


def _span(values: Array) -> str:
    return f"{values.min():.3g} to {values.max():.3g} (median {np.median(values):.3g})"


def frame_of_first_pose(name: str, p: Poses) -> WorldTransform:
    """The frame in which the first pose is the true one.

    Raises
    ------
    InputError
        No estimate is finite and has a truth and a covariance.
    """
    row, truth = _first(name, p)
    own = p.estimate[[row]]
    true = truth[None]
    turns = rotations(true, p.manifold) * rotations(own, p.manifold).inv()
    turn = turns[0]
    shift = positions(true, p.manifold) - turn.apply(positions(own, p.manifold))
    return WorldTransform(turn, shift[0])


def _first(name: str, p: Poses) -> tuple[int, Array]:
    """Row of the first estimate that is finite and has a truth and a covariance, and its truth (m,)."""
    known = p.known()
    fine = p.stated[known.rows] & finite_rows(p.estimate[known.rows])
    fine &= finite_rows(p.covariance[known.rows])
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
    row, _ = _first(name, p)
    sound = sound_of(p, judged)
    seen = submatrices(_seen(name, p, row, sound), judged)
    own = submatrices(p.covariance[sound.rows], judged)
    ratio = np.linalg.solve(own, seen)
    size = np.trace(ratio, axis1=1, axis2=2) / len(judged)
    t = np.sqrt(np.maximum(size, 0.0))
    wide = t[:, None, None]
    bound = (1.0 + wide) * own + seen + seen / np.where(wide > 0, wide, 1.0)
    P = p.covariance.copy()
    index = np.array(judged)
    mirrored = np.swapaxes(bound, 1, 2)
    P[np.ix_(sound.rows, index, index)] = 0.5 * (bound + mirrored)
    P[row] = 0.0
    return replace(p, covariance=P), np.square(1.0 + t[sound.rows != row])


def _seen(name: str, p: Poses, row: int, sound: Sound) -> Array:
    """Covariance (k, n, n) of the error that the pose in ``row`` causes in each sound row."""
    n = p.covariance.shape[-1]
    free = np.eye(6)
    if n == 3:
        free = free[[0, 1, 5]]
    alike = np.tile(np.eye(n), (len(p.t), 1, 1))
    plain = replace(p, covariance=alike)
    _, truth = _first(name, p)
    first = Sound(np.array([row]), truth[None], np.zeros((1, n)))
    of_first = tangent(plain, first, free, range(n))[0]
    J = tangent(plain, sound, free, range(n)) @ np.linalg.inv(of_first)
    return np.asarray(J @ p.covariance[row] @ np.swapaxes(J, 1, 2))
