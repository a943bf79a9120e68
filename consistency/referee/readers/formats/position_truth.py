"""A truth of positions alone, as GNSS receivers and total stations give it: the position of a point of the body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.errors import InputError
from consistency.referee.geometry.lie_groups import matrices, propagated, to_left
from consistency.referee.readers.alignment.world_frames import skew
from consistency.referee.readers.formats.geodetic import Fixes
from consistency.referee.readers.formats.text_blocks import Lines
from consistency.referee.readers.options import Reading, flag_of
from consistency.referee.readers.runs_to_record import symmetric
from consistency.referee.readers.truth_matching import AXES, Poses, finite_rows
from consistency.referee.types import Array

SAME = 1e-9  # of quaternions
FEWEST = 3  # estimates of a run
TURNED = 0.5  # rad: a turn that is not an error of a constant orientation
BEYOND = 10.0  # sigma, likewise
WINDING = 0.01  # 1 less the mean direction of a path
ALIGNED = 0.25  # the part of it that is left in the body's axes


def require_positions(path: Path, poses: Sequence[Poses], r: Reading) -> None:
    """Refuse what does not go with a truth of positions alone.

    Raises
    ------
    InputError
        Some runs have a truth with orientations, or an option needs one.
    """
    alone = f"{poses[0].files[1]} holds positions alone"
    if any(one.manifold != "vector" for one in poses):
        raise InputError(f"{path}: the truth of some runs has orientations, of others none; judge them apart")
    if r.relative is not None:
        raise InputError(f"--relative: needs a truth with orientations; {alone}")
    if r.align not in (None, "posyaw", "posyaw-all"):
        raise InputError(f"--align {r.align}: needs a truth with orientations; {alone}")
    for axis in r.axes or ():
        if axis not in AXES[:3]:
            raise InputError(f"--axes {','.join(r.axes or ())}: '{axis}' has no truth; {alone}")


def position_note(truth: Path | str, lever_arm: Sequence[float] | None) -> str:
    """A note on the point of the body that is judged."""
    at = "the origin of the body; --lever-arm x,y,z names another point"
    if lever_arm is not None:
        at = f"the point ({', '.join(f'{each:g}' for each in lever_arm)}) m of the body"
    return f"{truth}: the truth has no orientation, so that the position alone is judged, of {at}"


def point_positions(poses: Poses, lever: Sequence[float] | None, blocks: bool) -> Poses:
    """Estimated positions p + R l of a point of the body beside its true ones, with their covariances to first order.

    Parameters
    ----------
    poses : estimates in space; their truth (M, 3 or more) begins with the position
    lever : (3,), m, from the origin of the body to the point, in the axes of the body; None for the origin
    blocks : position and rotation are stated apart, or as deviations, so that their cross-covariance is not known

    Raises
    ------
    InputError
        The covariance of the point depends on cross terms that are not stated.
    """
    arm = np.zeros(3) if lever is None else np.asarray(lever, float)
    if blocks and (arm.any() or poses.convention == "right"):
        option = "--lever-arm" if arm.any() else "--error right"
        what = "moves errors of the rotation into that of the position, whose cross terms are not stated"
        raise InputError(f"{poses.place[0]}: {option} {what}; give covariances of whole poses")
    T = np.full((len(poses.t), 4, 4), np.nan)
    finite = finite_rows(poses.estimate)
    T[finite] = matrices(poses.estimate[finite, :7])
    point = poses.estimate[:, :3] + T[:, :3, :3] @ arm
    of_truth = poses.true_covariance
    if of_truth is not None:
        of_truth = of_truth[:, :3, :3]
    J = _jacobian(poses.convention, T, arm)
    return replace(
        poses,
        estimate=point,
        covariance=propagated(J, poses.covariance),
        truth=poses.truth[:, :3],
        manifold="vector",
        convention="vector",
        cross=None,
        true_covariance=of_truth,
    )


def placeholder(poses: Sequence[Poses]) -> tuple[bool, str]:
    """Whether a truth has one orientation in place of none, and a note where it may have.

    It is the same in every row of every run, while the estimates turn by more than their covariance allows. They turn
    with the path where the direction of a run's true way is the same in the axes of the estimated body.

    Parameters
    ----------
    poses : runs in space
    """
    quaternions = np.concatenate([one.truth[:, 3:7] for one in poses])
    if (np.abs(np.abs(quaternions @ quaternions[0]) - 1.0) > SAME).any():
        return False, ""
    turns = [turn for one in poses if (turn := _turning(one)) is not None]
    if not turns or np.median([turn[0] for turn in turns]) < TURNED:
        return False, ""
    angle, *lengths = np.transpose(turns)
    text = "the truth has the same orientation in every row, while the estimates turn by"
    text = f"{text} {np.rad2deg(np.median(angle)):.0f} degrees"
    way, body = map(_winding, lengths)
    if way > WINDING and body < ALIGNED * way:
        return True, f"{text} with the path: it is read as positions alone"
    return False, f"{text}; if it is a placeholder, give a truth of t x y z, or judge --axes x,y,z"


def _winding(lengths: Array) -> float:
    """1 - the mean length of mean directions; 0 where nothing moves."""
    known = lengths[np.isfinite(lengths)]
    return 1.0 - float(known.mean()) if len(known) else 0.0


def _turning(one: Poses) -> tuple[float, float, float] | None:
    """By how much the estimates of a run turn beyond their covariance, rad; lengths of two mean directions.

    They are of the true way in the world and in the axes of the estimated body, NaN where it stands still. None where
    too few rows have a truth.
    """
    known = one.known()
    finite = finite_rows(one.estimate[known.rows])
    rows = known.rows[finite]
    true = known.truth[finite, :3]
    if len(rows) < FEWEST:
        return None
    R = Rotation.from_quat(one.estimate[rows, 3:7])
    variance = np.trace(one.covariance[rows, 3:6, 3:6], axis1=1, axis2=2)
    sigma = np.sqrt(np.abs(variance))
    turned = (R[0].inv() * R).magnitude()
    turn = float(np.max(np.where(turned > BEYOND * sigma, turned, 0.0)))
    way = np.diff(true, axis=0)
    size = np.linalg.norm(way, axis=1)
    moving = size > 0.1 * np.median(size)
    if not moving.any():
        return turn, np.nan, np.nan
    way = way[moving] / size[moving, None]
    in_body = R[:-1][moving].inv().apply(way)
    of_way = float(np.linalg.norm(way.mean(axis=0)))
    return turn, of_way, float(np.linalg.norm(in_body.mean(axis=0)))


def fixed(own: Fixes, true: Lines, r: Reading, of_truth: Array | None = None) -> Poses:
    """Estimated positions without orientations beside the true ones, in one plane.

    Parameters
    ----------
    of_truth : (M, 3 or more, 3 or more), covariance of the truth, which begins with the position

    Raises
    ------
    InputError
        An option needs orientations, or the covariance from elsewhere.
    """
    if given := r.given(("covariance", "covariance_order", "error", "lever_arm")):
        raise InputError(f"{flag_of(given[0])}: does not go with {own.path}, of positions with their own covariances")
    if of_truth is not None:
        of_truth = of_truth[:, :3, :3]
    P = symmetric(own.covariances, own.place)
    return Poses(
        place=own.places,
        t=own.t,
        estimate=own.values[:, 1:4],
        covariance=P,
        stated=np.ones(len(P), bool),
        true_t=true.t,
        truth=true.values[:, 1:4],
        manifold="vector",
        convention="vector",
        max_dt=r.tolerance,
        true_covariance=of_truth,
    )


def _jacobian(convention: str, T: Array, arm: Array) -> Array:
    """Error of the point by the error of the pose, (N, 3, 6): R (rho - arm x phi) by its left error (rho, phi)."""
    R = T[:, :3, :3]
    by_left = np.concatenate([R, -R @ skew(arm)], axis=-1)
    return np.asarray(by_left @ to_left(T, convention))
