"""TUM trajectories: lines ``t tx ty tz qx qy qz qw``, the covariances in the same line or in a file of their own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from consistency.errors import InputError
from consistency.geometry.conventions import SPATIAL, spatial_error
from consistency.recording.record import DEFAULT_DT, Recording, Track, assemble, associate, common_times, symmetric
from consistency.recording.sheet import Lines, read_numbers
from consistency.types import Array, Indices

AXES: tuple[str, ...] = ("x", "y", "z", "roll", "pitch", "yaw")  # from roll on a rotation vector
ORDERS = ("translation-rotation", "rotation-translation")
POSE, SPLIT = 8, 20  # columns: a pose; a pose and two 3 x 3 covariances without a cross-covariance
FULL, TRIANGLE = 36, 21  # a 6 x 6 covariance row by row, or its upper triangle
UNIT = 1e-3  # quaternions of four decimals pass
SUFFIXES = (".txt", ".tum")
MOVED = 0.2  # sigma: adds its square, 0.04, to a NEES, which a thousand runs would just see
FAR = 1.0  # rad; a median rotation error beyond it is a matter of conventions, not of an estimator


@dataclass(frozen=True)
class Match:
    """The estimates of one run that have truth and covariance."""

    place: list[str]  # (k,)
    t: Array  # (k,)
    error: Array  # (k, 6)
    P: Array  # (k, 6, 6)
    left_out: int
    angle: float  # rad, median of the rotation error
    moved: float  # sigma, median of the motion between estimate and nearest truth


def read_tum(
    estimates: Path,
    truth: Path | None,
    covariance: Path | None,
    convention: str | None,
    order: str | None,
    max_dt: float | None,
) -> list[Recording]:
    """Recording of one estimator: a file, or a folder with a file for each run.

    With the 20 columns that the tools of OpenVINS write, position and rotation are two recordings: their
    cross-covariance is not in the file, so a joint NEES would be wrong.
    """
    if convention not in (None, *SPATIAL):
        raise InputError(f"--error {convention}: for a trajectory in space it is one of {', '.join(SPATIAL)}")
    if order not in (None, *ORDERS):
        raise InputError(f"--covariance-order {order}: must be {' or '.join(ORDERS)}")
    if truth is None:
        raise InputError(f"{estimates}: a trajectory needs --truth FILE, the true one in the same form")
    runs = _runs(estimates, truth, covariance)
    trajectories = [read_trajectory(path) for path, _, _ in runs]
    split = trajectories[0].values.shape[1] == SPLIT
    if split and order == ORDERS[0]:
        raise InputError(f"--covariance-order: {trajectories[0].path} has {SPLIT} columns, rotation before translation")
    error_kind = convention or ("so3-body" if split else "so3")
    matches = []
    for (_, true_path, P_path), own in zip(runs, trajectories, strict=True):
        if (own.values.shape[1] == SPLIT) != split:
            raise InputError(f"{own.path}: has {own.values.shape[1]} columns, {trajectories[0].path} another layout")
        matches.append(_run(own, true_path, P_path, error_kind, order or ORDERS[0], max_dt))
    columns, t = common_times([run.t for run in matches])
    tracks = [Track(i, c, run.place, run.error, run.P) for i, (c, run) in enumerate(zip(columns, matches, strict=True))]
    notes = _notes(estimates, matches, max_dt)
    why = "" if convention else f"; the default of this layout, {_origin(split)}"
    notes.append(f"error convention {error_kind}: {SPATIAL[error_kind]}{why}")
    name, file = estimates.stem, str(covariance or estimates)
    if not split:
        return [assemble(name, tracks, t, AXES, file, error_kind, notes)]
    halves = []
    for title, part in (("position", slice(0, 3)), ("rotation", slice(3, 6))):
        half = [_half(track, part) for track in tracks]
        halves.append(assemble(f"{name} {title}", half, t, AXES[part], file, error_kind, notes))
        notes = []
    return halves


def _origin(split: bool) -> str:
    if split:
        return "written by OpenVINS; --error so3 where it comes from another ROS topic"
    return "as in ROS messages with a covariance; declare yours with --error"


def _half(track: Track, part: slice) -> Track:
    assert track.error is not None
    assert track.covariance is not None
    return replace(track, error=track.error[:, part], covariance=track.covariance[:, part, part])


def _runs(estimates: Path, truth: Path, covariance: Path | None) -> list[tuple[Path, Path, Path | None]]:
    """Files of every run: estimates, truth, covariance."""
    if not estimates.is_dir():
        for option, path in (("--truth", truth), ("--covariance", covariance)):
            if path is not None and path.is_dir():
                raise InputError(f"{option} {path}: is a folder, but {estimates} is one file")
        return [(estimates, truth, covariance)]
    files = trajectory_files(estimates)
    if not files:
        raise InputError(f"{estimates}: holds no .txt or .tum file and no manifest.json")
    if covariance is not None and not covariance.is_dir():
        raise InputError(f"--covariance {covariance}: must be a folder like {estimates}, a file for each run")
    out = []
    for path in files:
        own_truth = _same_stem(truth, path, "--truth") if truth.is_dir() else truth
        own_covariance = None if covariance is None else _same_stem(covariance, path, "--covariance")
        out.append((path, own_truth, own_covariance))
    return out


def trajectory_files(folder: Path) -> list[Path]:
    """Files of a folder that may be trajectories, by name."""
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith("."))


def _same_stem(folder: Path, path: Path, option: str) -> Path:
    matches = [other for other in trajectory_files(folder) if other.stem == path.stem]
    if not matches:
        raise InputError(f"{option} {folder}: holds no file '{path.stem}' with .txt or .tum for {path}")
    return matches[0]


def _run(
    own: Lines, truth_path: Path, covariance_path: Path | None, convention: str, order: str, max_dt: float | None
) -> Match:
    """The estimates of a run that have truth and covariance."""
    tolerance = DEFAULT_DT if max_dt is None else max_dt
    truth = read_trajectory(truth_path, true=True)
    rows, match = _pairs(own, truth, tolerance, "truth")
    covariance, source = _inline(own, order), own
    picked = rows
    if covariance_path is not None:
        if covariance is not None:
            raise InputError(f"--covariance {covariance_path}: {own.path} holds covariances already; give one of them")
        source = read_covariances(covariance_path)
        covariance = _matrices(source.values[:, 1:], order)
        with_P, P_rows = _pairs(own, source, tolerance, "covariance")
        both, in_truth, in_P = np.intersect1d(rows, with_P, return_indices=True)
        rows, match, picked = both, match[in_truth], P_rows[in_P]
        if not len(rows):
            raise InputError(f"{own.path}: no estimate has both a truth and a covariance within {tolerance:g} s")
    if covariance is None:
        raise InputError(f"{own.path}: holds no covariance; give --covariance FILE, lines of t and {FULL} numbers")
    P = symmetric(covariance[picked], lambda row: source.place(int(picked[row])))
    estimate = own.values[rows, 1:8]
    finite = np.isfinite(estimate).all(axis=1)
    error = np.full((len(rows), 6), np.nan)
    error[finite] = spatial_error(truth.values[match][finite, 1:8], estimate[finite], convention)
    return Match(
        [own.place(int(row)) for row in rows], own.t[rows], error, P, len(own.t) - len(rows),
        *_doubts(truth, match, own.t[rows], error, P),
    )  # fmt: skip


def _pairs(own: Lines, other: Lines, tolerance: float, what: str) -> tuple[Indices, Indices]:
    rows, match = associate(own.t, other.t, tolerance)
    if not len(rows):
        raise InputError(
            f"{own.path}: no estimate has a {what} within {tolerance:g} s (--max-dt): t is {_span(own)}, "
            f"but {_span(other)} in {other.path}"
        )
    return rows, match


def _span(lines: Lines) -> str:
    return f"{lines.t[0]:.10g} to {lines.t[-1]:.10g}"


def _doubts(truth: Lines, match: Indices, t: Array, error: Array, P: Array) -> tuple[float, float]:
    """Medians over a run: angle of the rotation error, rad; motion between estimate and truth, sigma."""
    angles = np.linalg.norm(error[:, 3:], axis=1)
    angle = float(np.nanmedian(angles)) if np.isfinite(angles).any() else 0.0
    if len(truth.t) < 2:
        return angle, 0.0
    speed = np.linalg.norm(np.gradient(truth.values[:, 1:4], truth.t, axis=0), axis=1)[match]
    sigma = np.sqrt(np.abs(np.diagonal(P[:, :3, :3], axis1=1, axis2=2)).mean(axis=1))
    moved = speed * np.abs(t - truth.t[match])
    ratio = np.where((sigma > 0) & (moved > 1e-9), moved / np.where(sigma > 0, sigma, 1.0), 0.0)
    return angle, float(np.median(ratio[np.isfinite(ratio)])) if np.isfinite(ratio).any() else 0.0


def _notes(estimates: Path, matches: Sequence[Match], max_dt: float | None) -> list[str]:
    """What was left out, and what looks like a matter of clocks or of conventions."""
    notes = []
    total = sum(run.left_out + len(run.t) for run in matches)
    if left_out := sum(run.left_out for run in matches):
        notes.append(
            f"{estimates}: {left_out} of {total} estimates have no truth or no covariance "
            f"within {DEFAULT_DT if max_dt is None else max_dt:g} s (--max-dt) and are left out"
        )
    angle, moved = max(run.angle for run in matches), max(run.moved for run in matches)
    if angle > FAR:
        notes.append(
            f"{estimates}: the rotation error is {np.rad2deg(angle):.0f} degrees in the median of a run: "
            "are the quaternions of both files x y z w, body to world, of the same body frame?"
        )
    if moved > MOVED:
        notes.append(
            f"{estimates}: between estimate and nearest truth the body moves {moved:.1f} sigma in the median of a run, "
            "which counts as error; interpolate the truth to the timestamps of the estimates"
        )
    return notes


# --- files ---------------------------------------------------------------------------------------


def read_trajectory(path: Path, true: bool = False) -> Lines:
    """A trajectory, checked: increasing timestamps, quaternions of unit length; NaN only in estimates."""
    widths = (POSE, SPLIT, POSE + TRIANGLE, POSE + FULL)
    lines = read_numbers(path, widths, f"t tx ty tz qx qy qz qw ({', '.join(map(str, widths))} columns)")
    pose = lines.values[:, 1:8]
    if true and not np.isfinite(pose).all():
        row = int(np.flatnonzero(~np.isfinite(pose).all(axis=1))[0])
        raise InputError(f"{lines.place(row)}: the truth is not finite; leave such lines out")
    length = np.linalg.norm(pose[:, 3:], axis=1)
    bad = np.flatnonzero(np.isfinite(pose).all(axis=1) & (np.abs(length - 1.0) > UNIT))
    if len(bad):
        row = int(bad[0])
        raise InputError(
            f"{lines.place(row)}: the quaternion has length {length[row]:.4g}, not 1; columns 5 to 8 must be "
            "qx qy qz qw"
        )
    return lines


def read_covariances(path: Path) -> Lines:
    """A file of covariances: t, then 36 numbers row by row, or the 21 of the upper triangle."""
    return read_numbers(path, (1 + TRIANGLE, 1 + FULL), f"t and {FULL} numbers, or t and {TRIANGLE}")


def _inline(own: Lines, order: str) -> Array | None:
    numbers = own.values[:, POSE:]
    if not numbers.shape[1]:
        return None
    if own.values.shape[1] == SPLIT:  # rotation, then position
        rotation, position = _triangle(numbers[:, :6], 3), _triangle(numbers[:, 6:], 3)
        out = np.zeros((len(numbers), 6, 6))
        out[:, :3, :3], out[:, 3:, 3:] = position, rotation
        return out
    return _matrices(numbers, order)


def _matrices(numbers: Array, order: str) -> Array:
    """(N, 36) or (N, 21) -> (N, 6, 6), translation first."""
    P = numbers.reshape(-1, 6, 6) if numbers.shape[1] == FULL else _triangle(numbers, 6)
    if order == ORDERS[1]:
        turned = [3, 4, 5, 0, 1, 2]
        P = P[:, turned][:, :, turned]
    return np.asarray(P)


def _triangle(numbers: Array, n: int) -> Array:
    out = np.empty((len(numbers), n, n))
    i, j = np.triu_indices(n)
    out[:, i, j] = out[:, j, i] = numbers
    return out
