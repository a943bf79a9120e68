"""The one way from poses to a record: match with the truth, align, take errors, assemble.

It is the same for poses in the plane and in space, for states of any components, and for errors that a file holds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from consistency.referee.diagnostics.records.record import Record, each_alone
from consistency.referee.diagnostics.records.validity import ROUNDED, Validity, classify
from consistency.referee.errors import InputError
from consistency.referee.readers.heading_units import require_radians
from consistency.referee.readers.mix_ups.hints import hints
from consistency.referee.readers.options import Reading
from consistency.referee.readers.pipeline.by_column import NO_TRUTH, beside_states, grouped, with_values
from consistency.referee.readers.places import exact, refuse
from consistency.referee.readers.runs_to_record import Track, assemble, not_estimated
from consistency.referee.readers.truth_matching import (
    AXES,
    ROUNDING,
    WHOLE,
    Aligned,
    Estimator,
    Known,
    Poses,
    at,
    common_steps,
    common_times,
)
from consistency.referee.types import Array, Indices

if TYPE_CHECKING:
    from consistency.referee.readers.windows import Relative

OF_WINDOWS = ("relative", "motions", "windows")  # options
BENT = 0.2  # sigma: adds its square, 0.04, to a NEES, which a thousand runs would just see
FAR = 1.0  # rad; a median rotation error beyond it is a matter of conventions, not of an estimator
STILL = (
    "not estimated and left out: their errors are 0 in every row, and their variances one constant each, as for a "
    "robot in the plane"
)


def records_of(e: Estimator, r: Reading) -> list[Record]:
    """The records of an estimator, one for each group of components that have cross terms.

    Clocks that differ, mix-ups, and components that are not estimated are looked for. With ``--relative`` motions over
    windows are judged in place of poses.

    Raises
    ------
    InputError
        A run has no estimate with truth and covariance, or the covariance is singular throughout.
    """
    if e.innovations_alone and r.by is not None:
        raise InputError(f"--by {r.by}: {e.path} {NO_TRUTH}")
    if e.innovations_alone:
        return [_innovations(e)]
    require_radians(str(e.path), e.runs)
    judged = _named(e, r)
    e, column = with_values(e, r, judged)
    relative = windows_asked(r)
    if relative is not None:
        return [grouped(_windows(e, judged, r, relative), column, r)]
    shift, clocks, moved = _clocks_and_frames(e, r, judged)
    runs = moved.runs
    known = [_known(e, p, r, shift) for p in runs]
    notes = [*e.notes, *_left_out(e, runs, known)]
    if _start_is_exact(e, runs):
        known = [k.of(p.t[k.rows] != 0) for p, k in zip(runs, known, strict=True)]
    for i, (p, k) in enumerate(zip(runs, known, strict=True)):
        if p.open_end and _is_cut(p, k.rows):
            known[i], notes = k.of(np.arange(len(k.rows) - 1)), [p.open_end, *notes]
    tracks = [_track(e, p, k, shift) for p, k in zip(runs, known, strict=True)]
    if e.in_space:
        notes += _space_notes(e, runs, known, tracks)
        still = _not_estimated(e, tracks, judged) if r.axes is None else []
        if still:
            names = ", ".join(e.axes[i] for i in still)
            notes.append(f"{e.said}: {names} are {STILL}; --axes {','.join(e.axes)} judges them, too")
        judged = [i for i in judged if i not in still]
    causes = [*_causes(e, runs, shift, judged), *e.causes]
    notes += [*clocks, *moved.notes, *causes]
    if e.convention:
        notes.append(f"error convention {e.convention}: {e.definition}")
    if column is not None:
        column = beside_states(column, e, judged, runs, known)
    tracks, t, numbering = _in_columns(e, runs, known, tracks)
    notes += numbering
    records = []
    for ending, group in e.stated.groups.items():
        part = [i for i in range(len(e.axes))[group] if i in judged]
        if not part:
            continue
        some, axes = [track.part(part) for track in tracks], tuple(e.axes[i] for i in part)
        record = assemble(f"{e.name}{ending}", some, t, axes, str(e.covariances or e.path), e.convention, notes)
        files = {p.run: str(p.files[0]) for p in runs}
        record = replace(moved.on(record), causes=tuple(causes), files=files)
        if e.stated.alone:
            record = each_alone(record)
        records.append(grouped(record, column, r))
        notes, causes = [], []
    return records


def windows_asked(r: Reading) -> Relative | None:
    """Windows of ``--relative`` that are judged in place of poses; None without the option."""
    if not r.given(OF_WINDOWS):
        return None
    from consistency.referee.readers.windows import relative_of

    return relative_of(r.relative, bool(r.motions), r.windows)


def _named(e: Estimator, r: Reading) -> list[int]:
    """Components of the error that are judged: those of ``--axes``, or all that are stated."""
    if unknown := [axis for axis in r.axes or () if axis not in e.axes]:
        raise InputError(f"--axes {','.join(r.axes or ())}: '{unknown[0]}' is not one of {', '.join(e.axes)}")
    if r.axes is not None:
        judged = [i for i, axis in enumerate(e.axes) if axis in r.axes]
    else:
        judged = list(range(len(e.axes)) if e.judged is None else e.judged)
    if e.in_space and e.stated != WHOLE:  # a velocity or a bias that is 0 throughout is not estimated
        poses = range(len(AXES))
        judged = [i for i in judged if i in poses or any((p.covariance[:, i, i] != 0).any() for p in e.runs)]
    return judged


def _clocks_and_frames(e: Estimator, r: Reading, judged: Sequence[int]) -> tuple[float, list[str], Aligned]:
    """Seconds to add to the times of the estimates, notes on them, and the runs in the world of the truth."""
    if r.align is not None:
        from consistency.referee.readers.alignment.residuals import clocks_and_frames

        return clocks_and_frames(e.said, e.runs, r.time_offset, r.align, judged)
    if e.runs[0].numbered:
        return 0.0, [], Aligned(e.runs)
    from consistency.referee.readers.clock_offset import clock_shift

    return *clock_shift(e.said, e.runs, r.time_offset), Aligned(e.runs)


# --- estimates and truth ---------------------------------------------------------------------------


def _known(e: Estimator, p: Poses, r: Reading, shift: float) -> Known:
    """The truth of the estimates that have a covariance.

    Raises
    ------
    InputError
        There is none, in a run that is not of an archive; or estimates and truth of a step have different times.
    """
    known = p.known(shift)
    if not len(known.rows) and e.t is None:
        raise _nothing_known(e, p, shift)
    stated = p.stated[known.rows]
    if len(stated) and not stated.any():
        raise InputError(f"{p.files[0]}: no estimate has both a truth and a covariance within {p.max_dt:g} s")
    if not stated.all():
        known = known.of(stated)
    if p.numbered and p.clock is not None and p.true_clock is not None:
        t, true_t = p.clock[known.rows], p.true_clock[known.before]
        where = f"in the same step of {p.files[1]}; number the same instants by the same step, or raise --max-dt"
        refuse(
            np.abs(t - true_t) > r.tolerance + ROUNDING,
            p.place.at(known.rows).__getitem__,
            lambda row: f"t is {exact(t[row])}, but {exact(true_t[row])} {where}",
        )
    return known


def _nothing_known(e: Estimator, p: Poses, shift: float) -> InputError:
    """Message that no estimate of a run has a truth."""
    if p.numbered:
        own, true = (f"{each.min():.15g} to {each.max():.15g}" for each in (p.t, p.true_t))
        return InputError(f"{p.files[0]}: no step of run {p.run} ({own}) is in {p.files[1]} ({true})")
    from consistency.referee.readers.clock_units import nothing_near

    what = "estimate"
    if len(e.runs) > 1 and e.runs[0].files == e.runs[-1].files:
        what = f"estimate of run {p.run}"
    return nothing_near(p.files, p.t + shift, p.true_t, p.max_dt, what, "truth")


def _start_is_exact(e: Estimator, runs: Sequence[Poses]) -> bool:
    """Whether step 0 is the start of every run, known exactly, and not an estimate."""
    if not runs[0].numbered or e.t is not None or any((p.t < 0).any() for p in runs):
        return False
    kinds = classify(np.concatenate([p.covariance[p.t == 0] for p in runs]), ROUNDED)
    return bool(np.isin(kinds, (Validity.DEFICIENT, Validity.INDEFINITE)).all())


def _is_cut(p: Poses, rows: Indices) -> bool:
    """Whether the last row of a file has a covariance that is not positive definite, unlike the row before."""
    if len(rows) < 2 or rows[-1] != len(p.t) - 1:
        return False
    before, last = classify(p.covariance[rows[-2:]], ROUNDED)
    finite = np.isfinite(p.estimate[-1]).all() and np.isfinite(p.covariance[-1]).all()
    return bool(finite and before == Validity.VALID and last != Validity.VALID)


def _track(e: Estimator, p: Poses, known: Known, shift: float) -> Track:
    """Errors of a run with their covariances; its columns are not yet known."""
    rows, width, P = known.rows, e.position, p.covariance
    return Track(
        p.run, rows, p.place.at(rows), p.error_of(rows, known.truth), P if len(rows) == len(P) else P[rows],
        at(p.nis, rows), at(p.nis_dof, rows), by=at(p.by, rows), t=None if e.t is not None else _times(p, rows),
        truth_covariance=p.truth_covariances(known, shift),
        path=np.stack([known.truth[:, :width], p.estimate[rows, :width]], axis=1) if width else None,
    )  # fmt: skip


def _times(p: Poses, rows: Indices) -> Array | None:
    """Times of some rows, s; None where steps have none."""
    return None if p.numbered and p.clock is None else p.seconds[rows]


# --- what is found -----------------------------------------------------------------------------------


def _left_out(e: Estimator, runs: Sequence[Poses], known: Sequence[Known]) -> list[str]:
    """Notes on left-out rows, and on a truth between whose samples estimates are."""
    notes, total = [], sum(len(p.t) for p in runs)
    if left_out := total - sum(len(k.rows) for k in known):
        what = "no truth"
        if not all(p.stated.all() for p in runs):
            what = "no truth or no covariance"
        if not runs[0].numbered:
            what += f" within {runs[0].max_dt:g} s (--max-dt)"
        notes.append(f"{e.said}: {left_out} of {total} estimates have {what} and are left out")
    furthest = max(float(k.apart.max(initial=0.0)) for k in known)
    if furthest > ROUNDING and not e.in_space:
        notes.append(f"{e.said}: the truth is interpolated, from samples up to {furthest:.2g} s away")
    return notes


def _space_notes(e: Estimator, runs: Sequence[Poses], known: Sequence[Known], tracks: Sequence[Track]) -> list[str]:
    """Notes on probable mix-ups of conventions, and on a truth of too low a rate."""
    notes = []
    angle = max(_median(np.linalg.norm(error[:, 3:6], axis=1)) for error in _errors(tracks))
    if angle > FAR:
        notes.append(
            f"{e.said}: the rotation error is {np.rad2deg(angle):.0f} degrees in the median of a run, which is a "
            "matter of conventions or frames rather than of an estimator"
        )
    bent = max(_median(_bend(p, k)) for p, k in zip(runs, known, strict=True))
    if bent > BENT:
        notes.append(
            f"{e.said}: the truth turns so fast that between its samples it may be off by {bent:.1f} sigma in the "
            "median of a run, which counts as error; give a truth of a higher rate"
        )
    return notes


def _errors(tracks: Sequence[Track]) -> list[Array]:
    return [track.error for track in tracks if track.error is not None]


def _bend(p: Poses, known: Known) -> Array:
    """What the interpolated truth may be off by, (k,), in standard deviations of the position."""
    variances = np.diagonal(p.covariance, axis1=1, axis2=2)[known.rows, :3]
    sigma = np.sqrt(np.abs(variances).mean(axis=1))
    bent = (sigma > 0) & (known.bend > 1e-9)
    return np.where(bent, known.bend / np.where(sigma > 0, sigma, 1.0), 0.0)


def _median(values: Array) -> float:
    """Median of the finite values; 0 without any."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 0.0
    return float(np.median(finite))


def _not_estimated(e: Estimator, tracks: Sequence[Track], judged: Sequence[int]) -> list[int]:
    """Components, of those judged, that a robot in the plane does not estimate."""
    part = list(judged)
    variances = [np.diagonal(p.covariance, axis1=1, axis2=2)[p.stated][:, part] for p in e.runs]
    still = not_estimated([error[:, part] for error in _errors(tracks)], variances)
    return [i for i, idle in zip(part, still, strict=True) if idle]


def _causes(e: Estimator, runs: Sequence[Poses], shift: float, judged: Sequence[int]) -> list[str]:
    """Mix-ups of the whole state, or of its poses by themselves."""
    if not e.in_space:
        return hints(e.said, e.axes, runs, shift)
    whole = hints(e.said, e.axes, runs, shift, judged) if len(e.axes) > len(AXES) else []
    of_pose = [i for i in judged if i < len(AXES)]
    if whole or not of_pose:
        return whole
    return hints(e.said, e.axes[: len(AXES)], [p.alone() for p in runs], shift, of_pose)


# --- records -----------------------------------------------------------------------------------------


def _in_columns(
    e: Estimator, runs: Sequence[Poses], known: Sequence[Known], tracks: Sequence[Track]
) -> tuple[list[Track], Array, list[str]]:
    """Tracks on common columns, the time of each column, (steps,), s, and a note if the file numbers them otherwise.

    Runs without a row are left out, but for those of an archive, which numbers its steps.
    """
    if e.t is not None:
        return [replace(track, column=known.rows) for track, known in zip(tracks, known, strict=True)], e.t, []
    some = [(p, track) for p, track in zip(runs, tracks, strict=True) if len(track.column)]
    keys = [p.t[track.column] for p, track in some]
    if not runs[0].numbered:
        columns, t = common_times(keys)
        return [replace(track, column=column) for (_, track), column in zip(some, columns, strict=True)], t, []
    columns, steps = common_steps(keys)
    t = np.full(len(steps), np.nan)
    for (p, track), column in zip(reversed(some), reversed(columns), strict=True):
        t[column] = p.seconds[track.column]
    tracks = [replace(track, column=column) for (_, track), column in zip(some, columns, strict=True)]
    if np.array_equal(steps, np.arange(1, len(steps) + 1)):
        return tracks, t, []
    has = f"{steps[0]:g} to {steps[-1]:g}"
    return tracks, t, [f"{e.said}: step k below is the k-th step of the file, which has {has}"]


def _innovations(e: Estimator) -> Record:
    """The record of innovations without errors; a step whose estimate is broken fails."""
    tracks = []
    for p in e.runs:
        rows = np.arange(len(p.t))
        error = np.where(np.isfinite(p.estimate).all(axis=1), 0.0, np.nan)[:, None]
        tracks.append(Track(p.run, rows, p.place, error, nis=p.nis, nis_dof=p.nis_dof, t=p.clock))
    tracks, t, numbering = _in_columns(e, e.runs, [], tracks)
    record = assemble(e.name, tracks, t, tuple(e.axes), str(e.path), "", [*e.notes, *numbering])
    return replace(record, error=None, dof=0)


def _windows(e: Estimator, judged: Sequence[int], r: Reading, relative: Relative) -> Record:
    """The record of motions over windows."""
    from consistency.referee.readers.pipeline.motion_causes import causes_of_motions
    from consistency.referee.readers.pipeline.relative_motions import Stretch, relative_recording

    if e.stated != WHOLE:
        raise InputError(f"{e.path}: --relative needs covariances of whole poses; here parts are stated apart")
    stretches, runs, known = [], [], []
    for p in e.runs:
        if relative.motions:
            bare = np.append(False, ~p.stated[1:])
            refuse(bare, p.place.__getitem__, f"this motion has no covariance within {p.max_dt:g} s")
        elif p.cross is not None and not p.stated.all():
            p = p.of_rows(np.flatnonzero(p.stated))
        runs.append(p)
        known.append(p.known(r.shift))
        if not len(known[-1].rows):
            raise _nothing_known(e, p, r.shift)
        stretches.append(
            Stretch(
                p.run, str(p.files[0]), p.place, p.seconds + r.shift, p.estimate, p.covariance, p.cross,
                known[-1].rows, known[-1].truth, p.convention, p.by,
            )
        )  # fmt: skip
    of = str(e.covariances or e.path)
    axes = AXES
    if stretches[0].d == 2:  # archives do not name them
        axes = ("x", "y", "heading")
    record = relative_recording(e.name, of, stretches, axes, judged, relative)
    causes = causes_of_motions(e.said, stretches, axes, judged, relative)
    notes = (*e.notes, *_left_out(e, runs, known), *record.notes, *causes)
    return replace(record, notes=notes, causes=tuple(causes))
