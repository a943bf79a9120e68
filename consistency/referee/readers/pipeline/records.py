"""Trajectories in space from any kind of file: errors of poses with their 6 x 6 covariances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from consistency.referee.diagnostics import Evidence
from consistency.referee.diagnostics.records.record import each_alone
from consistency.referee.errors import InputError
from consistency.referee.geometry.conventions import INERTIAL, PLANAR
from consistency.referee.readers.clock_offset import clocks_and_frames
from consistency.referee.readers.clock_units import unit_apart
from consistency.referee.readers.mix_ups.hints import hints
from consistency.referee.readers.options import Reading
from consistency.referee.readers.places import refuse
from consistency.referee.readers.relative_motions import Stretch, relative_recording
from consistency.referee.readers.runs_to_record import Track, assemble, not_estimated
from consistency.referee.readers.truth_matching import Poses, common_times, truth_at
from consistency.referee.readers.windows import Relative
from consistency.referee.types import Array

AXES: tuple[str, ...] = ("x", "y", "z", "roll", "pitch", "yaw")  # from roll on a rotation vector
REST = ("vx", "vy", "vz", "bgx", "bgy", "bgz", "bax", "bay", "baz")  # velocity, biases of gyroscope and accelerometer
STATE = (*AXES, *REST)
WHOLE = {"": range(len(STATE))}  # what is one recording, by what its name ends in
ALONE = dict(WHOLE)  # one recording, each of whose components is judged by itself; told from WHOLE by identity
POINTS = {"": range(3)}  # positions without orientations
BLOCKS = {" position": range(3), " rotation": range(3, 6)}  # their cross-covariance is not known
SINGLE = {f" {axis}": range(i, i + 1) for i, axis in enumerate(AXES)}  # no covariance is; the rest as ALONE
SINGLE[" velocity and biases"] = range(len(AXES), len(STATE))
BENT = 0.2  # sigma: adds its square, 0.04, to a NEES, which a thousand runs would just see
FAR = 1.0  # rad; a median rotation error beyond it is a matter of conventions, not of an estimator


@dataclass(frozen=True)
class TrajectorySource:
    """Origin of trajectories, for names and messages."""

    path: Path
    files: Sequence[tuple[Path | str, Path | str]]  # of each run: its estimates, its truth
    covariance: Path
    why: str = ""  # the convention is what it is
    notes: tuple[str, ...] = ()  # what the files were read as


@dataclass(frozen=True)
class Match:
    """The estimates of one run that have truth and covariance."""

    track: Track
    t: Array  # (k,), s
    left_out: int
    angle: float  # rad, median of the rotation error
    bent: float  # sigma, median of what the interpolated truth may be off by


def require_axes(axes: Sequence[str] | None, there: Sequence[str] = AXES) -> None:
    """Refuse components that a pose in space, or what is judged of a state, does not have."""
    if unknown := [axis for axis in axes or () if axis not in there]:
        raise InputError(f"--axes {','.join(axes or ())}: '{unknown[0]}' is not one of {', '.join(there)}")


def recordings_of(
    source: TrajectorySource,
    poses: Sequence[Poses],
    parts: Mapping[str, range],
    r: Reading,
    relative: Relative | None = None,
) -> list[Evidence]:
    """The recording of one estimator, each of whose runs is one of ``poses``; clocks and mix-ups are looked for.

    Parameters
    ----------
    parts : ``WHOLE``, ``ALONE``, ``BLOCKS`` or ``SINGLE``: components whose covariance is known, each a recording
    relative : judge motions over windows in place of poses

    Raises
    ------
    InputError
        A run has no estimate with truth and covariance, or the covariance is singular throughout.
    """
    kind, axes = poses[0].convention, STATE[: poses[0].covariance.shape[-1]]
    require_axes(r.axes, axes)
    judged = [i for i, axis in enumerate(axes) if r.axes is None or axis in r.axes]
    if parts is not WHOLE:  # what is 0 throughout is not estimated
        judged = [i for i in judged if i < len(AXES) or any((one.covariance[:, i, i] != 0).any() for one in poses)]
    if relative is not None:
        if parts is not WHOLE:
            raise InputError(f"{source.path}: --relative needs covariances of whole poses; here parts are stated apart")
        stretches = [
            _stretch(run, one, *files, r.shift, relative)
            for run, (one, files) in enumerate(zip(poses, source.files, strict=True))
        ]
        one = relative_recording(source.path.stem, str(source.covariance), stretches, AXES, judged, relative)
        return [replace(one, notes=(*source.notes, *one.notes))]
    shift, clocks, moved = clocks_and_frames(source.path.name, poses, r.time_offset, r.align, judged)
    stated, poses = poses, moved.runs
    matches = [
        _match(run, one, *files, shift) for run, (one, files) in enumerate(zip(poses, source.files, strict=True))
    ]
    columns, t = common_times([each.t for each in matches])
    tracks = [replace(each.track, column=column) for each, column in zip(matches, columns, strict=True)]
    variances = [np.diagonal(one.covariance[one.stated], axis1=1, axis2=2) for one in stated]
    idle = not_estimated([track.error for track in tracks if track.error is not None], variances)
    left_out = [axes[i] for i in judged if idle[i]] if r.axes is None else []
    judged = [i for i in judged if axes[i] not in left_out]
    why = "errors are 0 in every row, and their variances one constant each, as of a robot in the plane"
    said = f"not estimated and left out: their {why}; --axes {','.join(axes)} judges them, too"
    notes = [
        *source.notes,
        *[f"{source.path.name}: {', '.join(left_out)} are {said}"][: len(left_out)],
        *_notes(source.path, matches, poses[0].max_dt),
        *clocks,
        *moved.notes,
        *(causes := _causes(source.path.name, axes, poses, shift, judged)),
    ]
    notes.append(f"error convention {kind}: {INERTIAL.get(kind) or PLANAR[kind]}{source.why}")
    recordings = []
    for title, whole in parts.items():
        if part := [i for i in judged if i in whole]:
            some = [track.part(part) for track in tracks]
            names, name = tuple(axes[i] for i in part), f"{source.path.stem}{title}"
            record = moved.on(assemble(name, some, t, names, str(source.covariance), kind, notes))
            record = replace(record, causes=tuple(causes))
            recordings.append(each_alone(record) if parts is ALONE or parts is SINGLE else record)
            notes, causes = [], []
    return recordings


def _causes(name: str, axes: Sequence[str], poses: Sequence[Poses], shift: float, judged: Sequence[int]) -> list[str]:
    """Mix-ups of the whole state, or of its poses by themselves."""
    whole = hints(name, axes, poses, shift, judged) if len(axes) > len(AXES) else []
    of_pose = [i for i in judged if i < len(AXES)]
    if whole or not of_pose:
        return whole
    return hints(name, axes[: len(AXES)], [one.alone() for one in poses], shift, of_pose)


def _match(run: int, poses: Poses, path: Path | str, truth: Path | str, shift: float) -> Match:
    known = poses.known(shift)
    if not len(known.rows):
        raise apart(path, poses.t + shift, truth, poses.true_t, poses.max_dt, "truth")
    kept = poses.stated[known.rows]
    if not kept.any():
        raise InputError(f"{path}: no estimate has both a truth and a covariance within {poses.max_dt:g} s")
    rows = known.rows[kept]
    error = poses.error_of(rows, known.truth[kept])
    P = poses.covariance if len(rows) == len(poses.t) else poses.covariance[rows]
    angles, bend = np.linalg.norm(error[:, 3:6], axis=1), known.bend[kept]
    angle = float(np.nanmedian(angles)) if np.isfinite(angles).any() else 0.0
    sigma = np.sqrt(np.abs(np.diagonal(P[:, :3, :3], axis1=1, axis2=2)).mean(axis=1))
    ratio = np.where((sigma > 0) & (bend > 1e-9), bend / np.where(sigma > 0, sigma, 1.0), 0.0)
    bent = float(np.median(ratio[np.isfinite(ratio)])) if np.isfinite(ratio).any() else 0.0
    t = poses.t[rows]
    of_truth = poses.truth_covariances(known, shift)
    of_truth = None if of_truth is None else of_truth[kept]
    track = Track(run, np.arange(len(rows)), poses.place.at(rows), error, P, t=t, truth_covariance=of_truth)
    track = replace(track, path=np.stack([known.truth[kept, :3], poses.estimate[rows, :3]], axis=1))
    return Match(track, t, len(poses.t) - len(rows), angle, bent)


def _stretch(run: int, poses: Poses, path: Path | str, truth: Path | str, shift: float, relative: Relative) -> Stretch:
    """A run before its windows are taken: all its motions, or the poses that have a covariance."""
    rows = np.arange(len(poses.t))
    if relative.motions:
        bare = np.append(False, ~poses.stated[1:])
        refuse(bare, poses.place.__getitem__, f"this motion has no covariance within {poses.max_dt:g} s")
    elif poses.cross is not None:
        rows = rows[poses.stated]
    t = poses.t[rows] + shift
    known = truth_at(t, poses.true_t, poses.truth, poses.manifold, poses.max_dt)
    if not len(known.rows):
        raise apart(path, t, truth, poses.true_t, poses.max_dt, "truth")
    cross = None if poses.cross is None else poses.cross[rows]
    return Stretch(
        run, str(path), poses.place.at(rows), t, poses.estimate[rows], poses.covariance[rows], cross,
        known.rows, known.truth, poses.convention,
    )  # fmt: skip


def apart(path: Path | str, t: Array, other: Path | str, other_t: Array, tolerance: float, what: str) -> InputError:
    """Message that no timestamp of one is near one of the other."""
    own_span, span = (f"{each[0]:.15g} to {each[-1]:.15g}" for each in (t, other_t))
    where = f"t is {own_span}, but {span} in {other}{unit_apart(t, other_t, (path, other))}"
    return InputError(f"{path}: no estimate has a {what} within {tolerance:g} s (--max-dt): {where}")


def _notes(estimates: Path, matches: Sequence[Match], max_dt: float) -> list[str]:
    """Notes on left-out rows, and on probable mix-ups of clocks or conventions."""
    notes = []
    total = sum(run.left_out + len(run.t) for run in matches)
    if left_out := sum(run.left_out for run in matches):
        notes.append(
            f"{estimates}: {left_out} of {total} estimates have no truth or no covariance "
            f"within {max_dt:g} s (--max-dt) and are left out"
        )
    angle, bent = max(run.angle for run in matches), max(run.bent for run in matches)
    if angle > FAR:
        notes.append(
            f"{estimates}: the rotation error is {np.rad2deg(angle):.0f} degrees in the median of a run, which is a "
            "matter of conventions or frames rather than of an estimator"
        )
    if bent > BENT:
        notes.append(
            f"{estimates}: the truth turns so fast that between its samples it may be off by {bent:.1f} sigma in the "
            "median of a run, which counts as error; give a truth of a higher rate"
        )
    return notes
