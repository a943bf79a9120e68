"""Estimates in a world of their own, moved into that of the truth; what the fit takes is taken out of the covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.diagnostics.fitted import ENOUGH, left_covariances
from consistency.diagnostics.whitening import whiten
from consistency.errors import InputError
from consistency.recording.frames import IDENTITY, Frame, fitted_frame, moved
from consistency.recording.offset import clock_shift
from consistency.recording.poses import Poses
from consistency.recording.record import Recording
from consistency.types import Array, Indices

ALIGNMENTS = ("none", "origin", "posyaw", "posyaw-all", "se3", "se3-all")
TURNS, SHIFTS = np.eye(6)[3:], np.eye(6)[:3]
FREE = {
    ("posyaw", "spatial"): np.array([*SHIFTS, TURNS[2]]),
    ("posyaw", "planar"): np.array([*SHIFTS[:2], TURNS[2]]),
    ("se3", "spatial"): np.array([*SHIFTS, *TURNS]),
}  # directions (d, 6) in which a frame may move: shifts along x, y, z, turns about them
STEP = 1e-6  # m or rad, over which the change of an error is taken
MOST, DONE = 20, 1e-9  # rounds of a fit, and its last step in stated standard deviations
RANK = 1e-10  # of the largest singular value: directions that no error shows
LEAST = 0.05  # share of its variance that an error keeps at least: the fit goes through where it would keep less
SLIGHT = 0.01  # of a covariance: what the first pose adds to the others counts as nothing below
ROUNDS, SETTLED = 5, 1e-4  # of clocks and frames in turn, and the change of the offset, s, that ends them


@dataclass(frozen=True)
class Aligned:
    """Runs in the world of the truth, and what is to be said of it."""

    runs: Sequence[Poses]  # estimates moved; covariances those of the errors that are left
    mode: str = "none"
    notes: tuple[str, ...] = ()
    face: str = ""  # what the verdict has to say of it
    reduced: bool = False  # the errors may be smaller than the covariance says without a fault

    def on(self, recording: Recording) -> Recording:
        """The recording of these runs, which says how they were aligned."""
        return replace(recording, align=self.mode, face=self.face, reduced=self.reduced)


def require_alignment(mode: str | None, truth: object) -> str | None:
    """The mode, None for none.

    Raises
    ------
    InputError
        It is unknown, or there is no truth to align with.
    """
    if mode not in (None, *ALIGNMENTS):
        raise InputError(f"--align {mode}: must be one of {', '.join(ALIGNMENTS)}")
    if mode in (None, "none"):
        return None
    if truth is None:
        raise InputError(f"--align {mode} needs --truth, which the estimates are aligned with")
    return mode


def clocks_and_frames(
    name: str, runs: Sequence[Poses], time_offset: float | str | None, align: str | None, judged: Sequence[int]
) -> tuple[float, list[str], Aligned]:
    """Time to add to the timestamps, s, what to say of it, and the runs in the world of the truth.

    Parameters
    ----------
    align : one of ``ALIGNMENTS``, or None
    judged : components of the error that are judged, and by which frames are fitted

    Raises
    ------
    InputError
        The offset cannot be estimated, or nothing can be aligned.
    """
    if align is None:
        return *clock_shift(name, runs, time_offset), Aligned(runs)
    shift, before = time_offset if isinstance(time_offset, float) else 0.0, np.inf
    notes: list[str] = []
    for _ in range(ROUNDS):
        frames = _frames(name, [p.later(shift) for p in runs], align, judged)
        before = shift
        shift, notes = clock_shift(name, [moved(p, f) for p, f in zip(runs, frames, strict=True)], time_offset)
        if abs(shift - before) <= SETTLED:
            break
    found = aligned(name, [p.later(shift) for p in runs], align, judged)
    return shift, notes, replace(found, runs=[replace(p, t=own.t) for p, own in zip(found.runs, runs, strict=True)])


def aligned(name: str, runs: Sequence[Poses], mode: str, judged: Sequence[int]) -> Aligned:
    """Runs moved into the world of the truth by frames of least NEES, or by their first poses (``origin``).

    The covariance becomes that of the errors that are left. Frames of all runs, and those of each of at least
    ``ENOUGH`` runs, take what :func:`consistency.diagnostics.fitted.left_covariances` says; with fewer runs nothing is
    known of that, and the covariance stays, which is then too large. After ``origin`` it is a bound, as nothing is known
    of the correlation with the first pose.

    Raises
    ------
    InputError
        The errors are not those of a pose of six or three degrees of freedom, or no estimate can be aligned.
    """
    frames = _frames(name, runs, mode, judged)
    there = [moved(p, frame) for p, frame in zip(runs, frames, strict=True)]
    said = _sizes(name, mode, frames)
    if mode == "origin":
        return _from_first(name, there, judged, said)
    return _reduced(name, there, mode, judged, said)


# --- frames -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Sound:
    """Whitened errors of the estimates of one run that have truth and a covariance of full rank, k of them."""

    rows: Indices  # (k,)
    truth: Array  # (k, m)
    whitened: Array  # (k, n), of the components that are judged

    @property
    def nees(self) -> float:
        return float(np.square(self.whitened).sum())


def _sound(p: Poses, judged: Sequence[int]) -> Sound:
    known = p.known()
    w = _whitened(p, known.rows, p.error_of(known.rows, known.truth), judged)
    fine = np.isfinite(w).all(axis=1) & p.stated[known.rows]
    return Sound(known.rows[fine], known.truth[fine], w[fine])


def _whitened(p: Poses, rows: Indices, error: Array, judged: Sequence[int]) -> Array:
    index = list(judged)
    return whiten(error[:, index], p.covariance[rows][:, index][:, :, index])


def _frames(name: str, runs: Sequence[Poses], mode: str, judged: Sequence[int]) -> list[Frame]:
    """The frame of each run."""
    kind = runs[0].manifold
    if mode == "origin":
        return [_of_first(name, p) for p in runs]
    base, _, shared = mode.partition("-")
    if (base, kind) not in FREE:
        raise InputError(f"--align {mode}: for x, y, heading it is {', '.join(m for m in ALIGNMENTS if m[:2] != 'se')}")
    if shared:
        return [_fitted(name, runs, FREE[base, kind], judged)] * len(runs)
    return [_fitted(name, [p], FREE[base, kind], judged) for p in runs]


def _fitted(name: str, runs: Sequence[Poses], free: Array, judged: Sequence[int]) -> Frame:
    """The frame of least NEES for all of ``runs``, by Gauss and Newton from the best of three."""

    def at(frame: Frame) -> tuple[float, list[Poses], list[Sound]]:
        there = [moved(p, frame) for p in runs]
        found = [_sound(p, judged) for p in there]
        return sum(sound.nees for sound in found), there, found

    starts = [IDENTITY, *([frame] if (frame := fitted_frame(runs)) else []), _by_turns(runs, len(free) > 4)]
    nees, there, found, frame = min(((*at(start), start) for start in starts), key=lambda each: each[0])
    if not any(len(sound.rows) for sound in found):
        raise InputError(f"--align: no estimate of {name} has a truth and a covariance of full rank to be aligned by")
    for _ in range(MOST):
        A = np.concatenate([tangent(p, s, free, judged).reshape(-1, len(free)) for p, s in zip(there, found, strict=True)])
        scale = np.sqrt(np.square(A).sum(axis=0))
        scale[scale == 0] = 1.0
        w = np.concatenate([sound.whitened.ravel() for sound in found])
        step = -np.linalg.lstsq(A / scale, w, rcond=RANK)[0] / scale
        size = float(np.sqrt(np.square(A @ step).sum()))
        while size > DONE:
            after = _small(step @ free).after(frame)
            if (tried := at(after))[0] < nees:
                (nees, there, found), frame = tried, after
                break
            step, size = step / 2.0, size / 2.0
        else:
            break
    return frame


def _by_turns(runs: Sequence[Poses], free: bool) -> Frame:
    """The frame with which orientations are right in the mean, about z alone unless ``free``."""
    turns, own, true = [], [np.empty((0, 3))], [np.empty((0, 3))]
    for p in runs:
        known, d = p.known(), 3 if p.manifold == "spatial" else 2
        estimate = p.estimate[known.rows]
        finite = np.isfinite(estimate).all(axis=1)
        pair = [values[finite] for values in (estimate, known.truth)]
        for side, values in zip((own, true), pair, strict=True):
            side.append(np.pad(values[:, :d], ((0, 0), (0, 3 - d))))
        if finite.any():
            a, b = (Rotation.from_quat(v[:, 3:]) if d == 3 else Rotation.from_euler("z", v[:, 2:]) for v in pair)
            turns.append((b * a.inv()).mean())
    if not turns:
        return IDENTITY
    turn = Rotation.concatenate(turns).mean()
    turn = turn if free else Rotation.from_euler("z", turn.as_rotvec()[2])
    mean = [np.concatenate(side).mean(axis=0) for side in (own, true)]
    return Frame(turn, mean[1] - turn.apply(mean[0]))


def _small(motion: Array) -> Frame:
    """Shift and rotation vector (6,) as a frame."""
    return Frame(Rotation.from_rotvec(motion[3:]), motion[:3])


def tangent(p: Poses, sound: Sound, free: Array, judged: Sequence[int]) -> Array:
    """Change of the whitened errors with a small motion of the world of the estimates, (k, n, d).

    The truth is moved the other way instead: errors and covariances are carried alike, so that the whitened errors
    are the same but for a turn of their axes.
    """

    def change(motion: Array) -> Array:
        back, forth = (
            p.error_of(sound.rows, _small(side * STEP * motion).placed(sound.truth, p.manifold)) for side in (-1.0, 1.0)
        )
        return _whitened(p, sound.rows, (back - forth) / (2.0 * STEP), judged)

    return np.stack([change(motion) for motion in free], axis=-1)


# --- what the fit takes -------------------------------------------------------------------------------------


def _reduced(name: str, runs: Sequence[Poses], mode: str, judged: Sequence[int], said: str) -> Aligned:
    """Covariances of what a fit leaves; as they are where that is not known."""
    base, _, all_runs = mode.partition("-")
    shared = bool(all_runs) and len(runs) > 1
    found = [_sound(p, judged) for p in runs]
    whole = [i for i, sound in enumerate(found) if len(sound.rows)]
    bases = _bases([tangent(runs[i], found[i], FREE[base, runs[i].manifold], judged) for i in whole], shared)
    dof = bases[0].shape[-1]
    each = f"a frame of {dof} degrees of freedom {'for all runs' if all_runs else 'for each run'}"
    out = list(runs)
    if len(whole) < ENOUGH:
        face = f"aligned by {mode}, {each}: {_lost(True)}"
        note = f"{name}: fewer than {ENOUGH} runs do not show what the fit takes of the errors; nothing is made up for"
        return Aligned(out, mode, (said, note), face, reduced=True)
    left = left_covariances([found[i].whitened for i in whole], bases, shared)
    for i, M in zip(whole, left, strict=True):
        out[i] = _with_left(runs[i], found[i].rows, M, judged)
    kept = np.mean(np.concatenate([np.trace(M, axis1=1, axis2=2) for M in left])) / len(judged)
    face = f"aligned by {mode}, {each}: {_lost(not shared)}"
    note = f"{name}: the fit takes {100.0 * (1.0 - kept):.2g} % of the NEES of a right covariance, which is made up for"
    return Aligned(out, mode, (said, note), face, reduced=not shared)


def _lost(of_runs: bool) -> str:
    if of_runs:
        return "errors that are constant over a run, and a covariance that is too large, are not judged"
    return "an error that all runs share, constant over them, is not judged"


def _bases(tangents: Sequence[Array], shared: bool) -> list[Array]:
    """Orthonormal columns that span the tangents (k, n, d), of each run or of all; zero where a run has fewer."""
    groups = [list(tangents)] if shared else [[A] for A in tangents]
    out, width = [], 0
    for group in groups:
        A = np.concatenate([each.reshape(-1, each.shape[-1]) for each in group])
        scale = np.sqrt(np.square(A).sum(axis=0))
        U, s, _ = np.linalg.svd(A / np.where(scale > 0, scale, 1.0), full_matrices=False)
        U[:, s <= RANK * s[0]] = 0.0
        width = max(width, int((s > RANK * s[0]).sum()))
        ends = np.cumsum([each.shape[0] * each.shape[1] for each in group])[:-1]
        out += [part.reshape(each.shape[0], each.shape[1], -1) for part, each in zip(np.split(U, ends), group, strict=True)]
    return [Q[:, :, :width] for Q in out]


def _with_left(p: Poses, rows: Indices, M: Array, judged: Sequence[int]) -> Poses:
    """The covariance P = L L' of some rows made L M L' in the judged components, M (k, n, n) at least ``LEAST``."""
    values, vectors = np.linalg.eigh(M)
    M = (vectors * np.maximum(values, LEAST)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    block = np.ix_(rows, judged, judged)
    P = p.covariance.copy()
    L = np.linalg.cholesky(P[block])
    P[block] = L @ M @ np.swapaxes(L, 1, 2)
    P[block] = 0.5 * (P[block] + np.swapaxes(P[block], 1, 2))
    return replace(p, covariance=P)


# --- the first pose -----------------------------------------------------------------------------------------


def _first(name: str, p: Poses) -> tuple[int, Array]:
    """Row of the first estimate that is finite and has truth and covariance, and its truth (1, m)."""
    known = p.known()
    fine = p.stated[known.rows] & np.isfinite(p.estimate[known.rows]).all(axis=1)
    fine &= np.isfinite(p.covariance[known.rows]).all(axis=(1, 2))
    if not fine.any():
        raise InputError(f"--align origin: a run of {name} has no estimate with a truth and a covariance to begin at")
    k = int(np.argmax(fine))
    return int(known.rows[k]), known.truth[k : k + 1]


def _of_first(name: str, p: Poses) -> Frame:
    row, truth = _first(name, p)
    estimate = p.estimate[row : row + 1]
    if p.manifold == "planar":
        turn, d = Rotation.from_euler("z", float(truth[0, 2] - estimate[0, 2])), 2
    else:
        turn, d = Rotation.from_quat(truth[0, 3:]) * Rotation.from_quat(estimate[0, 3:]).inv(), 3
    own, true = (np.append(values[0, :d], np.zeros(3 - d)) for values in (estimate, truth))
    return Frame(turn, true - turn.apply(own))


def _from_first(name: str, runs: Sequence[Poses], judged: Sequence[int], said: str) -> Aligned:
    """Bounds of the covariances of errors that the first pose, whose error is now none, has a part in.

    The error of step k less that of the first pose, seen in step k with covariance R_k, has a covariance of at most
    (1 + t) P_k + (1 + 1/t) R_k for any t > 0, whatever their correlation (Young's inequality); t^2 = tr(P_k^-1 R_k) / n
    makes the sum of its variances, in units of those of P_k, least. If the first pose is exact it is P_k.
    """
    out, factors = [], [np.ones(1)]
    index = list(judged)
    for p in runs:
        row, _ = _first(name, p)
        sound, P = _sound(p, judged), p.covariance.copy()
        block = np.ix_(sound.rows, index, index)
        seen = _seen(p, row, sound)[:, index][:, :, index]
        part = np.trace(np.linalg.solve(P[block], seen), axis1=1, axis2=2) / len(index)
        t = np.sqrt(np.maximum(part, 0.0))[:, None, None]
        P[block] = (1.0 + t) * P[block] + seen + seen / np.where(t > 0, t, 1.0)
        P[row] = 0.0
        factor = np.square(1.0 + t[:, 0, 0])
        out.append(replace(p, covariance=P))
        factors.append(factor[sound.rows != row])
    added = float(np.median(np.concatenate(factors[1:]))) - 1.0
    if added < SLIGHT:
        return Aligned(out, "origin", (said,), "aligned by origin: the error of the first pose of each run is not judged")
    note = (
        f"{name}: the first pose is not exact, and files do not say how it is correlated with the others; covariances "
        f"are made {1.0 + added:.3g} times as large in the median, which holds whatever the correlation is"
    )
    face = "aligned by origin, whose first poses are not exact: a covariance that is too large is not judged"
    return Aligned(out, "origin", (said, note), face, reduced=True)


def _seen(p: Poses, row: int, sound: Sound) -> Array:
    """Covariance (k, n, n) of what the error of a pose in ``row`` makes of those of all sound rows."""
    n = p.covariance.shape[-1]
    free = np.array([*SHIFTS, *TURNS]) if n == 6 else FREE["posyaw", "planar"]
    plain = replace(p, covariance=np.tile(np.eye(n), (len(p.t), 1, 1)))
    every = range(n)
    _, truth = _first("", p)
    start = tangent(plain, Sound(np.array([row]), truth, np.empty((1, n))), free, every)[0]
    J = tangent(plain, sound, free, every) @ np.linalg.inv(start)
    return np.asarray(J @ p.covariance[row] @ np.swapaxes(J, 1, 2))


# --- words --------------------------------------------------------------------------------------------------


def _sizes(name: str, mode: str, frames: Sequence[Frame]) -> str:
    """How far the worlds are turned and shifted."""
    turns = [np.rad2deg(frame.turn.magnitude()) for frame in frames]
    shifts = [float(np.linalg.norm(frame.shift)) for frame in frames]
    if mode.endswith("-all") or len(frames) == 1:
        frame = frames[0]
        axis = ", ".join(f"{v:.4g}" for v in np.rad2deg(frame.turn.as_rotvec()))
        where = ", ".join(f"{v:.4g}" for v in frame.shift)
        return f"{name}: aligned by {mode}: turned by {turns[0]:.4g} degrees (rotation vector {axis}) and shifted by ({where}) m"

    def span(values: Sequence[float]) -> str:
        return f"{min(values):.3g} to {max(values):.3g}"

    return (
        f"{name}: aligned by {mode}, each of {len(frames)} runs by itself: turned by {span(turns)} degrees "
        f"(median {np.median(turns):.3g}) and shifted by {span(shifts)} m (median {np.median(shifts):.3g})"
    )
