"""The one way from poses to a record: match with the truth, align, take errors, assemble.

It is the same for poses in the plane and in space, for states of any components, and for errors that a file holds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from consistency.referee.diagnostics import Record
from consistency.referee.diagnostics.records.record import each_alone
from consistency.referee.diagnostics.records.validity import ROUNDED, Validity, classify
from consistency.referee.errors import InputError
from consistency.referee.readers.clock_offset import clock_shift
from consistency.referee.readers.clock_units import nothing_near
from consistency.referee.readers.estimator import AXES, WHOLE, Estimator
from consistency.referee.readers.heading_units import require_radians
from consistency.referee.readers.mix_ups.hints import hints
from consistency.referee.readers.options import Reading
from consistency.referee.readers.places import exact, refuse
from consistency.referee.readers.runs_to_record import Track, assemble, not_estimated
from consistency.referee.readers.truth_matching import ROUNDING, Aligned, Known, Poses, common_steps, common_times
from consistency.referee.readers.windows import Relative
from consistency.referee.types import Array, Indices

BENT = 0.2  # sigma: adds its square, 0.04, to a NEES, which a thousand runs would just see
FAR = 1.0  # rad; a median rotation error beyond it is a matter of conventions, not of an estimator
STILL = (
    "not estimated and left out: their errors are 0 in every row, and their variances one constant each, as of a robot "
    "in the plane"
)


@dataclass(frozen=True)
class Match:
    """The estimates of one run that have truth and covariance."""

    poses: Poses
    known: Known
    error: Array  # (k, n)

    @property
    def rows(self) -> Indices:
        """Rows of these estimates, (k,)."""
        return self.known.rows

    @property
    def covariance(self) -> Array:
        """Stated covariances, (k, n, n)."""
        P = self.poses.covariance
        return P if len(self.rows) == len(P) else P[self.rows]


def records_of(e: Estimator, r: Reading, relative: Relative | None = None) -> list[Record]:
    """The records of an estimator, one for each group of components that have cross terms.

    Clocks that differ, mix-ups, and components that are not estimated are looked for.

    Parameters
    ----------
    relative : judge motions over windows in place of poses

    Raises
    ------
    InputError
        A run has no estimate with truth and covariance, or the covariance is singular throughout.
    """
    if e.innovations_alone:
        return [_innovations(e)]
    require_radians(str(e.path), e.runs)
    judged = _named(e, r)
    if relative is not None:
        return [_windows(e, judged, r, relative)]
    shift, clocks, moved = _clocks_and_frames(e, r, judged)
    matches = [_match(e, p, r, shift) for p in moved.runs]
    notes = [*e.notes, *_matching_notes(e, matches)]
    matches = _without_exact_start(e, matches)
    if cut := [m for m in matches if _ends_cut(m)]:
        matches = [_without_last(m) if _ends_cut(m) else m for m in matches]
        notes = [*(m.poses.open_end for m in cut), *notes]
    idle = _not_estimated(e, matches, judged) if e.in_space and r.axes is None else []
    if idle:
        names = ", ".join(e.axes[i] for i in idle)
        notes.append(f"{e.said}: {names} are {STILL}; --axes {','.join(e.axes)} judges them, too")
    judged = [i for i in judged if i not in idle]
    causes = [*_causes(e, moved.runs, shift, judged), *e.causes]
    notes += [*clocks, *moved.notes, *causes]
    if e.convention:
        notes.append(f"error convention {e.convention}: {e.definition}")
    if e.t is None:  # the runs of an archive are there even if they have no step
        matches = [m for m in matches if len(m.rows)]
    columns, t = _columns(e, [(m.poses, m.rows) for m in matches], notes)
    tracks = [_track(e, m, column, shift) for m, column in zip(matches, columns, strict=True)]
    records = []
    for ending, group in e.stated.groups.items():
        part = [i for i in range(len(e.axes))[group] if i in judged]
        if not part:
            continue
        some, axes = [track.part(part) for track in tracks], tuple(e.axes[i] for i in part)
        record = assemble(f"{e.name}{ending}", some, t, axes, str(e.covariances or e.path), e.convention, notes)
        record = replace(moved.on(record), causes=tuple(causes))
        records.append(each_alone(record) if e.stated.alone else record)
        notes, causes = [], []
    return records


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
    return *clock_shift(e.said, e.runs, r.time_offset), Aligned(e.runs)


# --- estimates and truth ---------------------------------------------------------------------------


def _match(e: Estimator, p: Poses, r: Reading, shift: float) -> Match:
    """The estimates of a run that have truth and covariance, with their errors."""
    known = _known(e, p, shift)
    kept = p.stated[known.rows]
    if len(kept) and not kept.any():
        raise InputError(f"{p.files[0]}: no estimate has both a truth and a covariance within {p.max_dt:g} s")
    if not kept.all():
        known = _chosen(known, kept)
    if p.numbered and p.clock is not None and p.true_clock is not None:
        _require_same_time(p, known, r.tolerance)
    return Match(p, known, p.error_of(known.rows, known.truth))


def _known(e: Estimator, p: Poses, shift: float) -> Known:
    """The truth at the times or steps of the estimates.

    Raises
    ------
    InputError
        There is none, in a run that is not of an archive.
    """
    known = p.known(shift)
    if len(known.rows) or e.t is not None:
        return known
    several = len(e.runs) > 1 and e.runs[0].files == e.runs[-1].files
    if not p.numbered:
        what = f"estimate of run {p.run}" if several else "estimate"
        raise nothing_near(p.files, p.t + shift, p.true_t, p.max_dt, what, "truth")
    own, true = (f"{each.min():.15g} to {each.max():.15g}" for each in (p.t, p.true_t))
    raise InputError(f"{p.files[0]}: no step of run {p.run} ({own}) is in {p.files[1]} ({true})")


def _chosen(known: Known, kept: Array) -> Known:
    return Known(*(values[kept] for values in known))


def _require_same_time(p: Poses, known: Known, tolerance: float) -> None:
    """Refuse steps of estimates and truth that have other times than each other."""
    assert p.clock is not None
    assert p.true_clock is not None
    t, true_t = p.clock[known.rows], p.true_clock[known.before]
    where = f"in the same step of {p.files[1]}; number the same instants by the same step, or raise --max-dt"
    refuse(
        np.abs(t - true_t) > tolerance + ROUNDING,
        p.place.at(known.rows).__getitem__,
        lambda row: f"t is {exact(t[row])}, but {exact(true_t[row])} {where}",
    )


def _without_exact_start(e: Estimator, matches: list[Match]) -> list[Match]:
    """Steps without step 0 where it is the start of every run, known exactly, and not an estimate."""
    runs = [m.poses for m in matches]
    if not runs[0].numbered or e.t is not None or any((p.t < 0).any() for p in runs):
        return matches
    kinds = classify(np.concatenate([p.covariance[p.t == 0] for p in runs]), ROUNDED)
    if not len(kinds) or not np.isin(kinds, (Validity.DEFICIENT, Validity.INDEFINITE)).all():
        return matches
    return [_of(m, m.poses.t[m.rows] != 0) for m in matches]


def _of(m: Match, kept: Array) -> Match:
    return Match(m.poses, _chosen(m.known, kept), m.error[kept])


def _ends_cut(m: Match) -> bool:
    """Whether the last line of a file, which has no end, holds a covariance that is not positive definite."""
    if not m.poses.open_end or len(m.rows) < 2 or m.rows[-1] != len(m.poses.t) - 1:
        return False
    before, last = classify(m.covariance[-2:], ROUNDED)
    finite = np.isfinite(m.error[-1]).all() and np.isfinite(m.covariance[-1]).all()
    return bool(finite and before == Validity.VALID and last != Validity.VALID)


def _without_last(m: Match) -> Match:
    return _of(m, np.arange(len(m.rows)) < len(m.rows) - 1)


# --- what is found -----------------------------------------------------------------------------------


def _not_estimated(e: Estimator, matches: Sequence[Match], judged: Sequence[int]) -> list[int]:
    """Components, of those judged, that a robot in the plane does not estimate."""
    part = list(judged)
    variances = [np.diagonal(p.covariance, axis1=1, axis2=2)[p.stated][:, part] for p in e.runs]
    idle = not_estimated([m.error[:, part] for m in matches], variances)
    return [i for i, still in zip(part, idle, strict=True) if still]


def _causes(e: Estimator, runs: Sequence[Poses], shift: float, judged: Sequence[int]) -> list[str]:
    """Mix-ups of the whole state, or of its poses by themselves."""
    if not e.in_space:
        return hints(e.said, e.axes, runs, shift)
    whole = hints(e.said, e.axes, runs, shift, judged) if len(e.axes) > len(AXES) else []
    of_pose = [i for i in judged if i < len(AXES)]
    if whole or not of_pose:
        return whole
    return hints(e.said, e.axes[: len(AXES)], [p.alone() for p in runs], shift, of_pose)


def _matching_notes(e: Estimator, matches: Sequence[Match]) -> list[str]:
    """Notes on left-out rows, on the truth between its samples, and on probable mix-ups of conventions."""
    notes, runs = [], [m.poses for m in matches]
    total = sum(len(p.t) for p in runs)
    if left_out := total - sum(len(m.rows) for m in matches):
        what = "no truth" if all(p.stated.all() for p in runs) else "no truth or no covariance"
        within = "" if runs[0].numbered else f" within {runs[0].max_dt:g} s (--max-dt)"
        notes.append(f"{e.said}: {left_out} of {total} estimates have {what}{within} and are left out")
    if not e.in_space:
        furthest = max(float(m.known.apart.max(initial=0.0)) for m in matches)
        if furthest > ROUNDING:
            notes.append(f"{e.said}: the truth is interpolated, from samples up to {furthest:.2g} s away")
        return notes
    angle = max(_median(np.linalg.norm(m.error[:, 3:6], axis=1)) for m in matches)
    if angle > FAR:
        notes.append(
            f"{e.said}: the rotation error is {np.rad2deg(angle):.0f} degrees in the median of a run, which is a "
            "matter of conventions or frames rather than of an estimator"
        )
    bent = max(_median(_bend(m)) for m in matches)
    if bent > BENT:
        notes.append(
            f"{e.said}: the truth turns so fast that between its samples it may be off by {bent:.1f} sigma in the "
            "median of a run, which counts as error; give a truth of a higher rate"
        )
    return notes


def _bend(m: Match) -> Array:
    """What the interpolated truth may be off by, (k,), in standard deviations of the position."""
    sigma = np.sqrt(np.abs(np.diagonal(m.covariance[:, :3, :3], axis1=1, axis2=2)).mean(axis=1))
    known = (sigma > 0) & (m.known.bend > 1e-9)
    return np.where(known, m.known.bend / np.where(sigma > 0, sigma, 1.0), 0.0)


def _median(values: Array) -> float:
    """Median of the finite values; 0 without any."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else 0.0


# --- records -----------------------------------------------------------------------------------------


def _columns(e: Estimator, runs: Sequence[tuple[Poses, Indices]], notes: list[str]) -> tuple[list[Indices], Array]:
    """The column of each row in a record, (k,) of each run, and the time of each column, (steps,), s.

    Parameters
    ----------
    runs : poses and the rows of them that count
    notes : one on steps of a file that are not numbered 1, 2, ... is added
    """
    keys = [p.t[rows] for p, rows in runs]
    if e.t is not None:
        return [own.astype(np.int64) for own in keys], e.t
    if not e.runs[0].numbered:
        return common_times(keys)
    columns, steps = common_steps(keys)
    t = np.full(len(steps), np.nan)
    for (p, rows), column in zip(reversed(runs), reversed(columns), strict=True):
        t[column] = p.seconds[rows]
    if not np.array_equal(steps, np.arange(1, len(steps) + 1)):
        of = f"which has {steps[0]:g} to {steps[-1]:g}"
        notes.append(f"{e.said}: step k below is the k-th step of the file, {of}")
    return columns, t


def _track(e: Estimator, m: Match, column: Indices, shift: float) -> Track:
    p, rows, width = m.poses, m.rows, e.position
    times = p.seconds[rows] if e.t is None and not (p.numbered and p.clock is None) else None
    path = np.stack([m.known.truth[:, :width], p.estimate[rows, :width]], axis=1) if width else None
    return Track(
        p.run, column, p.place.at(rows), m.error, m.covariance, *_innovations_of(p, rows), t=times,
        truth_covariance=p.truth_covariances(m.known, shift), path=path,
    )  # fmt: skip


def _innovations_of(p: Poses, rows: Indices) -> tuple[Array | None, Array | None]:
    """NIS and degrees of freedom of some rows; None without any."""
    if p.nis is None or p.nis_dof is None:
        return None, None
    return p.nis[rows], p.nis_dof[rows]


def _innovations(e: Estimator) -> Record:
    """The record of innovations without errors; a step whose estimate is broken fails."""
    notes, rows = list(e.notes), [(p, np.arange(len(p.t))) for p in e.runs]
    columns, t = _columns(e, rows, notes)
    tracks = []
    for (p, all_rows), column in zip(rows, columns, strict=True):
        broken = ~np.isfinite(p.estimate).all(axis=1)
        nis, dof = _innovations_of(p, all_rows)
        error = np.where(broken, np.nan, 0.0)[:, None]
        tracks.append(Track(p.run, column, p.place, error, nis=nis, nis_dof=dof, t=p.clock))
    record = assemble(e.name, tracks, t, tuple(e.axes), str(e.path), "", notes)
    return replace(record, error=None, dof=0)


def _windows(e: Estimator, judged: Sequence[int], r: Reading, relative: Relative) -> Record:
    """The record of motions over windows."""
    from consistency.referee.readers.relative_motions import Stretch, relative_recording

    if e.stated != WHOLE:
        raise InputError(f"{e.path}: --relative needs covariances of whole poses; here parts are stated apart")
    stretches, matches = [], []
    for p in e.runs:
        rows = np.arange(len(p.t))
        if relative.motions:
            bare = np.append(False, ~p.stated[1:])
            refuse(bare, p.place.__getitem__, f"this motion has no covariance within {p.max_dt:g} s")
        elif p.cross is not None:
            rows = rows[p.stated]
        part = p.of_rows(rows)
        known = _known(e, part, r.shift)
        matches.append(Match(part, known, np.empty((0, 6))))
        stretches.append(
            Stretch(
                p.run, str(p.files[0]), part.place, part.seconds + r.shift, part.estimate, part.covariance, part.cross,
                known.rows, known.truth, p.convention,
            )
        )  # fmt: skip
    of = str(e.covariances or e.path)
    record = relative_recording(e.name, of, stretches, e.axes[: len(AXES)], judged, relative)
    return replace(record, notes=(*e.notes, *_matching_notes(e, matches), *record.notes))
