"""The one way from poses to a record: match with the truth, align, take errors, assemble.

It is the same for poses in the plane and in space, for states of any components, and for errors that a file holds.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from consistency.referee.diagnostics.record import Record, TruthFit, each_alone
from consistency.referee.diagnostics.whitening import ROUNDED, Validity, classify
from consistency.referee.errors import InputError
from consistency.referee.readers.axes_and_units import require_radians
from consistency.referee.readers.mix_ups.reading_fit import is_plausible
from consistency.referee.readers.options import Reading
from consistency.referee.readers.places import exact, refuse
from consistency.referee.readers.runs_to_record import (
    Track,
    assemble,
    estimated_components,
    in_columns,
    level_components,
)
from consistency.referee.readers.truth_matching import (
    ALONE,
    AXES,
    ROUNDING,
    WHOLE,
    Estimator,
    Poses,
    common_steps,
    common_times,
    finite_rows,
)
from consistency.referee.types import Array

if TYPE_CHECKING:
    from consistency.referee.readers.runs_to_record import Relative

OF_WINDOWS = ("relative", "motions", "windows")  # options
INDEPENDENT = "independent"  # value of the last of them
BENT = 0.2  # sigma: adds its square, 0.04, to a NEES, which a thousand runs would just see
FAR = 1.0  # rad; a median rotation error beyond it is a matter of conventions, not of an estimator


def records_of(e: Estimator, r: Reading) -> list[Record]:
    """The records of an estimator, one for each group of components that have cross terms.

    Clocks that differ, mix-ups, and components that are not estimated are looked for. With ``--relative`` motions over
    windows are judged in place of poses.

    Raises
    ------
    InputError
        A run has no estimate with truth and covariance, or the covariance is singular throughout.
    """
    if e.innovations_alone and r.groups.by is None:
        return [_innovations(e, bool(r.runs.independent))]
    if r.statement.unstated:
        e = with_unit_covariances(e)
    require_radians(str(e.path), e.runs)
    judged = _judged(e, r)
    if r.statement.ensemble is not None:
        e = _without_cross_terms(e, judged, r.statement.ensemble)
    column = None
    if r.groups.by is not None:
        from consistency.referee.readers.pipeline.by_column import in_groups, with_values

        e, column = with_values(e, r.groups, judged)
    pairs: list[Poses] = []
    if (relative := windows_asked(r)) is not None:
        records = [_record_of_windows(e, judged, r, relative)]
    else:
        records, pairs = _records_of_poses(e, judged, r)
    if column is not None:
        records = in_groups(records, column, e, pairs, r.groups)
    if e.error.bounds is not None:
        from consistency.referee.readers.formats.bounds import judged_bounds

        records = [judged_bounds(record, e, str(r.statement.level)) for record in records]
    return records


def with_unit_covariances(e: Estimator) -> Estimator:
    """The estimator with covariances I, and a note, where none is stated; itself otherwise.

    Zeros state none, and neither does one multiple of I in every row of poses, whose units differ.
    """
    first = next((p.own.covariance[p.own.stated][0] for p in e.runs if p.own.stated.any()), np.zeros((1, 1)))
    placeholder = first[0, 0] * np.eye(len(first)) if e.runs[0].manifold != "vector" else np.zeros((1, 1))
    if not all((p.own.covariance[p.own.stated] == placeholder).all() for p in e.runs):  # NaN is stated, too: a failure
        return e
    runs = []
    for p in e.runs:
        unit = np.broadcast_to(np.eye(p.own.covariance.shape[-1]), p.own.covariance.shape)
        runs.append(p.with_values(covariance=unit, stated=np.ones(len(p.own.t), bool)))
    note = f"{e.said}: states no covariance; it is taken as I, which a factor for each component corrects"
    return replace(e, runs=runs).with_error(stated=WHOLE, assumed=True).with_notes(note)


def windows_asked(r: Reading) -> Relative | None:
    """Windows of ``--relative`` that are judged in place of poses; None without the option."""
    if not r.given(OF_WINDOWS):
        return None
    from consistency.referee.readers.runs_to_record import relative_of

    windows = INDEPENDENT if r.runs.independent and r.runs.relative is not None else r.runs.windows
    return relative_of(r.runs.relative, bool(r.runs.motions), windows)


def _judged(e: Estimator, r: Reading) -> list[int]:
    """Components of the error that are judged: those of ``--axes``, or all that are stated."""
    if r.components.axes is not None:
        if unknown := set(r.components.axes).difference(e.error.axes):
            first = next(axis for axis in r.components.axes if axis in unknown)
            raise InputError(f"--axes {','.join(r.components.axes)}: '{first}' is not one of {', '.join(e.error.axes)}")
        judged = [i for i, axis in enumerate(e.error.axes) if axis in r.components.axes]
    elif e.error.judged is not None:
        judged = list(e.error.judged)
    else:
        judged = list(range(len(e.error.axes)))
    if e.error.in_space and e.error.stated != WHOLE:  # a velocity or a bias that is 0 throughout is not estimated
        stated = np.any([p.variances.any(axis=0) for p in e.runs], axis=0)
        judged = [i for i in judged if i < len(AXES) or stated[i]]
    return judged


def _records_of_poses(e: Estimator, judged: Sequence[int], r: Reading) -> tuple[list[Record], list[Poses]]:
    """Records of the poses of an estimator, and the estimates of each run that they judge, beside their truth."""
    runs = e.runs
    shift = 0.0
    level: list[str] = []
    if e.error.in_space and r.components.axes is None:
        judged, level = level_components(e, judged)
    of_clocks: list[str] = []
    fit = TruthFit()
    if r.matching.align is not None:
        from consistency.referee.readers.alignment import clocks_and_frames

        shift, of_clocks, moved = clocks_and_frames(e.said, runs, r.matching.time_offset, r.matching.align, judged)
        runs = moved.runs
        fit = moved.fit
        of_clocks += moved.notes
    elif not runs[0].source.numbered:
        from consistency.referee.readers.clocks import clock_shift

        shift, of_clocks = clock_shift(e.said, runs, r.matching.time_offset, judged)
    pairs = [_paired(e, p, r, shift) for p in runs]
    notes = [*e.notes, *_left_out(e, runs, pairs)]
    if _start_is_exact(e, runs):
        pairs = [p.pairs(p.own.t != 0) for p in pairs]
    for i, p in enumerate(pairs):
        if p.source.open_end and _is_cut(p, runs[i]):
            pairs[i] = p.pairs(np.arange(len(p.own.t) - 1))
            notes.insert(0, p.source.open_end)
    errors = [p.errors() for p in pairs]
    if e.error.in_space:
        notes += _space_notes(e, pairs, errors)
        if r.components.axes is None:
            judged, still = estimated_components(e, errors, judged)
            notes += [*level, *still]
    causes = [*e.causes]
    are_covariances = e.error.bounds is None or e.error.bounds.gaussian
    if are_covariances and r.statement.ensemble is None and runs[0].own.members is None and not r.sources.repeats:
        causes = [*_causes(e, [p.later(shift) for p in runs], judged), *e.causes]
    notes += [*of_clocks, *causes]
    if e.error.convention:
        notes.append(f"error convention {e.error.convention}: {e.error.definition}")
    tracks = [_track(e, p, error) for p, error in zip(pairs, errors, strict=True)]
    tracks, t, numbering = _in_columns(e, pairs, tracks)
    notes += numbering
    files = {p.source.run: str(p.source.files[0]) for p in runs}
    bounds = () if e.error.bounds is None else e.error.bounds.bounds
    records = []
    for ending, group in e.error.stated.groups.items():
        part = [i for i in range(len(e.error.axes))[group] if i in judged]
        if not part:
            continue
        some = [track.part(part) for track in tracks]
        axes = tuple(e.error.axes[i] for i in part)
        file, rows = str(e.covariances or e.path), bool(r.runs.independent)
        record = assemble(
            f"{e.name}{ending}", some, t, axes, file, e.error.convention, notes, independent=rows, bounds=bounds
        )
        record = replace(
            record,
            errors=replace(record.errors, assumed=e.error.assumed),
            runs=replace(record.runs, independent=rows),
            fit=fit,
            origin=replace(record.origin, files=files, causes=tuple(causes)),
        )
        if e.error.stated.alone:
            record = each_alone(record)
        if runs[0].own.members is not None:
            from consistency.referee.diagnostics.normal_numbers import of_ranks

            members = np.concatenate([p.own.members for p in pairs if p.own.members is not None])
            record = of_ranks(record, part, members, np.concatenate([p.true.values for p in pairs]))
        records.append(record)
        notes = []
        causes = []
    return records, pairs


def _without_cross_terms(e: Estimator, judged: Sequence[int], N: int) -> Estimator:
    """The estimator with variances alone where the covariance of N members has no full rank."""
    if N < 2:
        raise InputError(f"--ensemble {N}: must be the number of members, 2 or more")
    if len(judged) < N or e.error.stated.alone:
        return e
    unit = np.eye(e.runs[0].own.covariance.shape[-1])
    runs = [p.with_values(covariance=np.where(unit, p.own.covariance, 0.0)) for p in e.runs]
    note = f"{e.said}: the covariance of {N} members has rank {N - 1}, so each component is judged by itself"
    return replace(e, runs=runs).with_error(stated=ALONE).with_notes(note)


# --- estimates and truth ---------------------------------------------------------------------------


def _paired(e: Estimator, p: Poses, r: Reading, shift: float) -> Poses:
    """The estimates that have a covariance and a truth, beside that truth.

    Raises
    ------
    InputError
        There is none, in a run that is not of an archive; or estimates and truth of a step have different times.
    """
    found = p.matched(shift)
    if not len(found.own.t) and e.t is None:
        raise _nothing_known(e, p, shift)
    if len(found.own.t) and not found.own.stated.any():
        raise InputError(f"{p.source.files[0]}: no estimate has both a truth and a covariance within {p.max_dt:g} s")
    found = found.pairs(found.own.stated)
    if found.source.numbered and found.own.clock is not None and found.true.clock is not None:
        t = found.own.clock
        true_t = found.true.clock
        where = f"in the same step of {p.source.files[1]}; number the same instants by the same step, or raise --max-dt"
        refuse(
            np.abs(t - true_t) > r.matching.tolerance + ROUNDING,
            found.own.place.__getitem__,
            lambda row: f"t is {exact(t[row])}, but {exact(true_t[row])} {where}",
        )
    return found


def _nothing_known(e: Estimator, p: Poses, shift: float) -> InputError:
    """Message that no estimate of a run has a truth."""
    if p.source.numbered:
        own, true = (f"{each.min():.15g} to {each.max():.15g}" for each in (p.own.t, p.true.t))
        estimates, truth = p.source.files
        return InputError(f"{estimates}: no step of run {p.source.run} ({own}) is in {truth} ({true})")
    from consistency.referee.readers.clocks import nothing_near

    what = "estimate"
    if len(e.runs) > 1 and e.runs[0].source.files == e.runs[-1].source.files:
        what = f"estimate of run {p.source.run}"
    return nothing_near(p.source.files, p.own.t + shift, p.true.t, p.max_dt, what, "truth")


def _start_is_exact(e: Estimator, runs: Sequence[Poses]) -> bool:
    """Whether step 0 is the start of every run, known exactly, and not an estimate."""
    if not runs[0].source.numbered or e.t is not None or any((p.own.t < 0).any() for p in runs):
        return False
    kinds = classify(np.concatenate([p.own.covariance[p.own.t == 0] for p in runs]), ROUNDED)
    return bool(np.isin(kinds, (Validity.DEFICIENT, Validity.INDEFINITE)).all())


def _is_cut(p: Poses, whole: Poses) -> bool:
    """Whether the last row of a whole file has a covariance that is not positive definite, unlike the row before."""
    if len(p.own.t) < 2 or p.own.t[-1] != whole.own.t[-1]:
        return False
    before, last = classify(p.own.covariance[-2:], ROUNDED)
    is_finite = np.isfinite(p.own.estimate[-1]).all() and np.isfinite(p.own.covariance[-1]).all()
    return bool(is_finite and before == Validity.VALID and last != Validity.VALID)


# --- what is found -----------------------------------------------------------------------------------


def _left_out(e: Estimator, runs: Sequence[Poses], pairs: Sequence[Poses]) -> list[str]:
    """Notes on left-out rows, and on a truth between whose samples estimates are."""
    notes = []
    what = "no truth"
    total = sum(len(p.own.t) for p in runs)
    left_out = total - sum(len(p.own.t) for p in pairs)
    furthest = 0.0
    for p, found in zip(runs, pairs, strict=True):
        if not p.own.stated.all():
            what = "no truth or no covariance"
        if found.interpolation is not None:
            furthest = max(furthest, found.interpolation.apart.max(initial=0.0))
    if left_out:
        if not runs[0].source.numbered:
            what += f" within {runs[0].max_dt:g} s (--max-dt)"
        notes.append(f"{e.said}: {left_out} of {total} estimates have {what} and are left out")
    if furthest > ROUNDING and not e.error.in_space:
        notes.append(f"{e.said}: the truth is interpolated, from samples up to {furthest:.2g} s away")
    return notes


def _space_notes(e: Estimator, pairs: Sequence[Poses], errors: Sequence[Array]) -> list[str]:
    """Notes on probable mix-ups of conventions, and on a truth of too low a rate."""
    notes = []
    angle = _largest_median(np.linalg.norm(error[:, 3:6], axis=1) for error in errors)
    if angle > FAR:
        notes.append(
            f"{e.said}: the rotation error is {np.rad2deg(angle):.0f} degrees in the median of a run, which is a "
            "matter of conventions or frames rather than of an estimator"
        )
    bent = _largest_median(map(_bent, pairs))
    if bent > BENT:
        notes.append(
            f"{e.said}: the truth turns so fast that between its samples it may be off by {bent:.1f} sigma in the "
            "median of a run, which counts as error; give a truth of a higher rate"
        )
    return notes


def _bent(p: Poses) -> Array:
    """What the interpolated truth may be off by, (k,), in standard deviations of the position."""
    assert p.interpolation is not None
    bend = p.interpolation.bend
    sigma = np.sqrt(np.abs(p.variances[:, :3]).mean(axis=1))
    bent = np.zeros(len(sigma))
    some = (sigma > 0) & (bend > 1e-9)
    bent[some] = bend[some] / sigma[some]
    return bent


def _largest_median(of_runs: Iterable[Array]) -> float:
    """The largest median of the finite values of a run; 0 without any."""
    largest = 0.0
    for values in of_runs:
        finite = values[np.isfinite(values)]
        if len(finite):
            largest = max(largest, float(np.median(finite)))
    return largest


def _causes(e: Estimator, runs: Sequence[Poses], judged: Sequence[int]) -> list[str]:
    """Mix-ups of the whole state, or of its poses by themselves."""
    if not e.error.in_space:
        return _hints(e, runs, range(len(e.error.axes)))
    whole = []
    if len(e.error.axes) > len(AXES):
        whole = _hints(e, runs, judged)
    of_pose = [i for i in judged if i < len(AXES)]
    if whole or not of_pose:
        return whole
    poses = e.with_error(axes=e.error.axes[: len(AXES)])
    return _hints(poses, [p.alone() for p in runs], of_pose)


def _hints(e: Estimator, runs: Sequence[Poses], judged: Sequence[int]) -> list[str]:
    """Hints on mix-ups, which are loaded where the errors do not fit."""
    if e.error.assumed or is_plausible(runs, judged):
        return []
    from consistency.referee.readers.mix_ups.hints import hints

    return hints(e.said, e.error.axes, runs, judged)


# --- records -----------------------------------------------------------------------------------------


def _track(e: Estimator, p: Poses, error: Array) -> Track:
    """Errors of a run with their covariances; its columns are not yet known."""
    path = t = ratios = regions = None
    if e.error.bounds is not None and p.own.bounds is not None:
        from consistency.referee.readers.formats.bounds import ratios_of, regions_of

        ratios = ratios_of(e.error.bounds, p.own.bounds, error)
        regions = regions_of(e.error.bounds, p.own.bounds, error)
    width = e.error.position
    if width:
        true = p.true.values[:, :width]
        path = np.stack([true, p.own.estimate[:, :width]], axis=1)
    if e.t is None and not (p.source.numbered and p.own.clock is None):  # an archive has the times of its steps
        t = p.seconds
    return Track(
        p.source.run,
        np.arange(len(p.own.t)),
        p.own.place,
        error,
        p.own.covariance,
        p.own.nis,
        p.own.nis_dof,
        by=p.own.by,
        t=t,
        truth_covariance=p.true.covariance,
        path=path,
        bound_ratios=ratios,
        regions=regions,
    )


def _in_columns(e: Estimator, pairs: Sequence[Poses], tracks: Sequence[Track]) -> tuple[list[Track], Array, list[str]]:
    """Tracks on common columns, the time of each column, (steps,), s, and a note if the file numbers them otherwise.

    Runs without a row are left out, but for those of an archive, which numbers its steps.
    """
    if e.t is not None:
        columns = [p.own.t.astype(np.int64) for p in pairs]
        return in_columns(tracks, columns), e.t, []
    keys = []
    seconds = []
    some = []
    for p, track in zip(pairs, tracks, strict=True):
        if len(p.own.t):
            keys.append(p.own.t)
            seconds.append(p.seconds)
            some.append(track)
    if not keys:
        raise InputError(f"{e.path}: holds the start alone, step 0, which is known exactly; add steps from 1 on")
    if not pairs[0].source.numbered:
        columns, t = common_times(keys)
        return in_columns(some, columns), t, []
    columns, steps = common_steps(keys)
    t = np.full(len(steps), np.nan)
    for column, times in zip(reversed(columns), reversed(seconds), strict=True):
        t[column] = times
    notes = []
    if not np.array_equal(steps, np.arange(1, len(steps) + 1)):
        has = f"{steps[0]:g} to {steps[-1]:g}"
        notes.append(f"{e.said}: step k below is the k-th step of the file, which has {has}")
    return in_columns(some, columns), t, notes


def _innovations(e: Estimator, independent: bool) -> Record:
    """The record of innovations without errors; a step whose estimate is broken fails."""
    tracks = []
    for p in e.runs:
        error = np.where(finite_rows(p.own.estimate), 0.0, np.nan)[:, None]
        tracks.append(replace(_track(e, p, error), covariance=None))
    tracks, t, numbering = _in_columns(e, e.runs, tracks)
    notes = [*e.notes, *numbering]
    record = assemble(e.name, tracks, t, tuple(e.error.axes), str(e.path), "", notes, independent=independent)
    errors = replace(record.errors, error=None, dof=0)
    return replace(record, errors=errors, runs=replace(record.runs, independent=independent))


def _record_of_windows(e: Estimator, judged: Sequence[int], r: Reading, relative: Relative) -> Record:
    """The record of motions over windows."""
    from consistency.referee.readers.pipeline.relative_motions import causes_of_motions, relative_recording

    if e.error.stated != WHOLE:
        raise InputError(f"{e.path}: --relative needs covariances of whole poses; here parts are stated apart")
    runs = []
    for p in e.runs:
        if relative.motions:
            bare = np.append(False, ~p.own.stated[1:])
            refuse(bare, p.own.place.__getitem__, f"this motion has no covariance within {p.max_dt:g} s")
        elif p.own.cross is not None and not p.own.stated.all():
            p = p.of_rows(np.flatnonzero(p.own.stated))
        p = p.later(r.matching.shift)
        if not len(p.known().rows):
            raise _nothing_known(e, p, 0.0)
        runs.append(p)
    axes = AXES
    if runs[0].d == 2:  # archives do not name them
        axes = ("x", "y", "heading")
    record = relative_recording(e.name, str(e.covariances or e.path), runs, axes, judged, relative)
    causes = causes_of_motions(e.said, runs, axes, judged, relative)
    left_out = _left_out(e, runs, [p.matched() for p in runs])
    notes = (*e.notes, *left_out, *record.origin.notes, *causes)
    return replace(record, origin=replace(record.origin, notes=notes, causes=tuple(causes)))
