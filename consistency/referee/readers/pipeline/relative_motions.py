"""Motions over windows of a log, beside the true ones; estimate and truth need no common world frame.

The error of a window is Log(D^-1 M) of its estimated motion D = est_i^-1 est_j and its true one M = truth_i^-1 truth_j.
A change of either world frame changes neither. Log(M D^-1) is the adjoint of it and has the same NEES.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from consistency.referee.diagnostics.number_words import is_or_are, p_text, plural
from consistency.referee.diagnostics.record import Record
from consistency.referee.diagnostics.whiteness import ENOUGH, Independence, independence
from consistency.referee.diagnostics.whitening import whiten
from consistency.referee.errors import InputError
from consistency.referee.geometry import adjoint, composed, inverse, log, matrices, propagated, to_left
from consistency.referee.readers.mix_ups.hints import Pairs, hints
from consistency.referee.readers.runs_to_record import MARGINAL, Relative, Track, assemble, in_columns, windows
from consistency.referee.readers.truth_matching import Change, Poses, at, common_times, finite_rows
from consistency.referee.types import Array, Indices

KIND = "left"
DOUBTS = {  # by whether sizes of errors depend on each other, and whether they are alike: what they do, and its cause
    (True, True): ("are of like size", "conditions that last longer than a {0}"),
    (True, False): ("are of unlike size", "what takes turns from {0} to {0}"),
    (False, True): ("go the same way", "a bias, or noise that lasts longer than a {0}"),
    (False, False): ("go opposite ways", "noise of the pose that they share"),
}
DOUBTED = "the {} do not seem to be independent, on which this rests"
SEARCHED = 20_000  # rows with truth, of all runs, in which mix-ups are looked for
BENT = 0.1  # rad: sigma of a rotation over a window, from which first order errs (benchmarks/relative_poses.py)


@dataclass(frozen=True)
class Windows:
    """The windows of one run, W of them."""

    track: Track  # with the times of their beginnings
    error: Array  # (W, n), NaN where the estimate is
    covariance: Array  # (W, n, n)
    t: Array  # (W,), s, at the end of each
    left_out: int


def windows_of(p: Poses, relative: Relative) -> Windows:
    """Errors of the motions over windows of a run, with their covariances to first order.

    Estimates are poses, or motions since the row before. Independent motions M_k = D_k Exp(e_k) make up the window's
    motion D Exp(sum Ad(D_k+1 ... D_j)^-1 e_k): poses are compounded as in Barfoot (2017), State Estimation for
    Robotics, sec. 7.3.3. Errors e_i and e_j of two poses with a joint covariance make up D Exp(e_j - Ad(D)^-1 e_i).

    Raises
    ------
    InputError
        No window fits, a covariance is missing, or cross-covariances do not reach over a window.
    """
    file = str(p.source.files[0])
    if not relative.motions and p.own.cross is None:
        raise InputError(f"{file}: --relative: {MARGINAL}")
    known = p.known()
    t = p.seconds
    position = known.truth[:, : p.d]
    first, last, left_out = windows(t, position, known.rows, relative, file)
    sound = _sound(p, relative)
    whole = last < sound
    first = first[whole]
    last = last[whole]
    T = matrices(p.own.estimate[int(relative.motions) : sound])
    if relative.motions:  # from the origin on
        T = composed(np.concatenate([np.eye(p.d + 1)[None], T]))
    true = matrices(known.truth)
    start = np.searchsorted(known.rows, first)
    end = np.searchsorted(known.rows, last)
    D = inverse(T[first]) @ T[last]
    M = inverse(true[start]) @ true[end]
    error = log(inverse(D) @ M)
    covariance = _of_motions(p, T, first, last) if relative.motions else _of_poses(p, T, D, first, last, relative)
    if sound < len(t):  # a broken row ends the run, in a window of its own
        first = np.append(first, max(sound - 1, 0))
        last = np.append(last, sound)
        broken = 0.0
        if not np.isfinite(p.own.estimate[sound]).all():
            broken = np.nan
        error = np.vstack([error, np.full(error.shape[1], broken)])
        unknown = np.full((1, *p.own.covariance.shape[1:]), np.nan)
        covariance = np.concatenate([covariance, unknown])
    track = Track(
        p.source.run,
        np.arange(len(last)),
        p.own.place.at(last),
        error,
        covariance,
        t=t[first],
        by=at(p.own.by, first),
    )
    return Windows(track, error, covariance, t[last], left_out)


def _sound(p: Poses, relative: Relative) -> int:
    """The first row that is broken; the first row of motions is only where they start."""
    ok = finite_rows(p.own.estimate) & finite_rows(p.own.covariance)
    if p.own.cross is not None:
        ok[1:] &= finite_rows(p.own.cross[1:])
    if relative.motions:
        ok[0] = True
    return int(np.argmin(np.append(ok, False)))


def _of_motions(p: Poses, T: Array, first: Indices, last: Indices) -> Array:
    """Covariances of the windows' left errors from independent motions, (W, n, n)."""
    if not len(first):
        return np.empty((0, *p.own.covariance.shape[1:]))
    sizes = last - first
    begins = np.cumsum(sizes) - sizes
    window = np.repeat(np.arange(len(first)), sizes)
    rows = np.arange(sizes.sum()) - begins[window] + first[window] + 1
    own = to_left(inverse(T[rows - 1]) @ T[rows], p.convention)
    J = adjoint(inverse(T[last[window]]) @ T[rows]) @ own
    return np.asarray(np.add.reduceat(propagated(J, p.own.covariance[rows]), begins))


def _of_poses(p: Poses, T: Array, D: Array, first: Indices, last: Indices, relative: Relative) -> Array:
    """Covariances of the windows' left errors from the joint ones of their two ends, (W, n, n)."""
    assert p.own.cross is not None
    sizes = last - first
    wide = np.flatnonzero(sizes != 1)
    if len(wide):
        where = p.own.place[int(last[wide[0]])]
        raise InputError(
            f"{where}: --relative {relative.option}: the window spans {sizes[wide[0]]} rows, but "
            "a cross-covariance reaches one row back; keep only the rows at the ends of windows, or take --relative 1"
        )
    start = to_left(T[first], p.convention)
    end = to_left(T[last], p.convention)
    J = np.concatenate([-adjoint(inverse(D)) @ start, end], axis=-1)
    cross = p.own.cross[last]
    mirrored = np.swapaxes(cross, -1, -2)
    joint = np.block([[p.own.covariance[first], cross], [mirrored, p.own.covariance[last]]])
    return propagated(J, joint)


def relative_recording(
    name: str, file: str, runs: Sequence[Poses], axes: Sequence[str], judged: Sequence[int], relative: Relative
) -> Record:
    """The windows of some runs of one estimator as a recording, whose steps are windows.

    Parameters
    ----------
    axes : names of the components of the error; ``judged`` are the indices of those that count

    Raises
    ------
    InputError
        Input that :func:`windows_of` refuses, or a covariance that is singular in every window.
    """
    found = []
    tracks = []
    times = []
    whitened = []
    for p in runs:
        one = windows_of(p, relative)
        found.append(one)
        tracks.append(one.track.part(judged))
        times.append(one.t)
        whitened.append(whiten(one.error, one.covariance))
    t = np.full(max(map(len, times)), np.nan)
    if np.isfinite(np.concatenate(times)).all():
        columns, t = common_times(times)
        tracks = in_columns(tracks, columns)
    notes = _notes(name, found, len(axes), runs[0].convention, relative)
    of = independence(np.concatenate(whitened))
    if relative.independent and of.doubtful:
        notes.append(_doubt(name, of, "window", _whose(relative)))
    names = tuple(axes[i] for i in judged)
    record = assemble(name, tracks, t, names, file, KIND, notes, may_end=relative.independent)
    record = replace(
        record,
        runs=replace(record.runs, independent=relative.independent),
        origin=replace(record.origin, window=relative.text),
    )
    if not relative.independent:
        return record
    caption = ""
    if of.doubtful:
        caption = DOUBTED.format(_whose(relative))
    return replace(
        record,
        fit=replace(record.fit, caption=caption),
        origin=replace(record.origin, unshown=_too_few(of, relative)),
    )


def _notes(name: str, found: Sequence[Windows], n: int, convention: str, relative: Relative) -> list[str]:
    """Notes on the windows, what they do not show, and what is doubtful of them; errors have n components."""
    of = "poses, with cross-covariances,"
    if relative.motions:
        of = "motions"
    group = {3: "SE(2)", 6: "SE(3)"}[n]
    total = sum(len(one.t) for one in found)
    notes = [
        f"relative poses over {plural(total, 'window')} of {relative.text}; the error is Log(estimated^-1 true motion) "
        f"of {group}, in the frame of the body at the end of a window; covariances of {of} are of the error "
        f"{convention}",
        "what is constant over a window, or drifts more slowly than it, is not seen; longer windows see more",
    ]
    if relative.independent:
        notes.append(f"errors of different {_whose(relative)} are declared to be independent: each window is a run")
    else:
        notes.append(
            "windows are steps of their run, as their errors may depend on each other; where they do not, "
            "--windows independent makes each a run"
        )
    left_out = sum(one.left_out for one in found)
    if left_out:
        notes.append(f"{plural(left_out, 'window')} left out, too long because rows or truth are missing")
    wide = _widest(found)
    if wide > BENT:
        notes.append(
            f"the stated rotation over a window has a sigma of {wide:.2g} rad in the median; beyond {BENT:g} "
            "a covariance to first order is doubtful, so take shorter windows"
        )
    return [f"{name}: {note}" for note in notes]


def _whose(relative: Relative) -> str:
    return "motions" if relative.motions else "windows"


def _widest(found: Sequence[Windows]) -> float:
    """Largest standard deviation of a rotation about an axis, rad, in the median window."""
    P = np.concatenate([one.covariance for one in found])
    first = {3: 2, 6: 3}[P.shape[-1]]
    angles = P[:, first:, first:]
    angles = angles[finite_rows(angles)]
    if not len(angles):
        return 0.0
    largest = np.linalg.eigvalsh(angles)[:, -1]
    return float(np.median(np.sqrt(np.maximum(largest, 0.0))))


def rows_as_declared(record: Record) -> Record:
    """The record, with each row a run where rows are declared to be independent and no window was asked for."""
    return rows_as_runs(record) if record.runs.independent and record.origin.window is None else record


def rows_as_runs(record: Record) -> Record:
    """The record with each row a run, as ``--independent`` declares, noted where neighbours seem to be dependent."""
    note = f"{record.name}: errors of different rows are declared to be independent: each is a run"
    rows = record.as_runs.with_notes(note)
    if rows.errors.error is None or rows.errors.covariance is None:
        return rows
    of = independence(whiten(rows.errors.error, rows.errors.covariance)[:, 0])
    if not of.doubtful:
        return rows
    doubted = replace(rows, fit=replace(rows.fit, caption=rows.fit.caption or DOUBTED.format("rows")))
    return doubted.with_notes(_doubt(record.name, of, "row", "rows"))


def _doubt(name: str, of: Independence, unit: str, whose: str) -> str:
    """Note that rows or windows are correlated, of either sign, though they are declared to be independent."""
    way, cause = DOUBTS[bool(of.of_sizes), bool(of.alike)]
    return (
        f"{name}: errors of neighbouring {unit}s {way} (p {p_text(of.p_value)}), so that they do not seem to be "
        f"independent: {cause.format(unit)} may be behind it, and the verdict holds for independent {whose} only"
    )


def _too_few(of: Independence, relative: Relative) -> str:
    """Why windows that are only declared to be independent are too few to decide; "" where they are enough.

    Independent motions are never too few: their covariance over a window assumes independence, and is judged with it.
    """
    if relative.motions or of.pieces >= ENOUGH:
        return ""
    return (
        f"{plural(of.pieces, 'window')} {is_or_are(of.pieces)} too few windows to show independence, "
        f"which takes {ENOUGH}; without --windows independent they are steps of their run, however they depend on "
        "each other"
    )


def causes_of_motions(
    name: str, runs: Sequence[Poses], axes: Sequence[str], judged: Sequence[int], relative: Relative
) -> list[str]:
    """Mix-ups of motions, or of poses with cross-covariances, without which the errors of the windows fit."""
    some = []
    for p in runs:
        known = p.known()
        most = slice(SEARCHED // len(runs))
        t = p.own.t[known.rows[most]]
        some.append(p.with_values(true_t=t, truth=known.truth[most], true_covariance=None, max_dt=0.0))

    def errors_without(change: Change) -> Pairs:
        found = []
        for p in some:
            with np.errstate(invalid="ignore"), suppress(InputError):  # infinite covariances; no window fits
                changed = change(p)
                if p.own.cross is not None:
                    changed = changed.with_values(cross=change(p.with_values(covariance=p.own.cross)).own.covariance)
                one = windows_of(changed, relative)
                found.append((one.error, one.covariance))
        return found

    return hints(name, axes, some, judged=judged, errors_without=errors_without)
