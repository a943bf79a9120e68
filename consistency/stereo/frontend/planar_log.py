"""Relative motions and matches as a planar log: controls, few landmarks, and the noise that a filter believes.

Motions in space become those of a robot on a plane: forward, left, up, and the heading about up.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from consistency.bench.models import point, stereo
from consistency.bench.models.motion import dead_reckoning
from consistency.bench.scenario import Belief, BelievedMotion, BelievedSensor, Mount
from consistency.bench.types import Trial
from consistency.referee.errors import InputError
from consistency.referee.types import Array, Indices
from consistency.stereo.visual_odometry.cameras.rig import StereoRig
from consistency.stereo.visual_odometry.relative_motion import RelativeMotion
from consistency.stereo.visual_odometry.relative_pose import angular, euler_angles
from consistency.stereo.visual_odometry.sequence import StereoSequence
from consistency.stereo.visual_odometry.tracks import PIXELS, TrackSelection, linked, thinned

MAX_AGE = 12  # observations of a landmark, at most, as docs/reference/recorded.md
MIN_LIFE = 2  # at least
BANDS = 3  # columns of the image that landmarks are spread over
NEAR = 10.0  # standard deviations of its disparity that a landmark has at least: its range is nearly Gaussian
MOST_SLOTS = 64  # landmarks at once
# rad: as many such tilts, at random, come to 1 / NEAR within a landmark's life
LEAVES = 1.0 / (NEAR * np.sqrt(MAX_AGE))
CAMERA = np.array(  # right, down, forward <- forward, left, up
    [
        [0.0, -1.0, 0.0],
        [0.0, 0.0, -1.0],
        [1.0, 0.0, 0.0],
    ]
)
WITHIN = 30.0  # degrees between optical axis and motion; a camera that looks elsewhere does not tell what is forward
MOVED = 0.1  # m over the whole sequence; below, a rig that stands still has no direction


class Plane(NamedTuple):
    """How well motions in space are those of a robot on a plane.

    The log's sigma says how far landmarks are off when they are seen along the planar path. A landmark that is off by
    more than a tenth of its distance, in any direction, is of no use to a filter that is of first order: that is the
    same limit as on the range of a landmark, 1 / NEAR.
    """

    sigma: tuple[float, float, float]  # u, v, d, px
    limit: tuple[float, float, float]  # px, a tenth of a landmark's distance: f / NEAR twice, the median d / NEAR
    tilts: Array  # (T,), by which each motion rolls and pitches, rad

    @property
    def holds(self) -> bool:
        return bool((np.array(self.sigma) <= self.limit).all())

    @property
    def leaving(self) -> int:
        return int((self.tilts > LEAVES).sum())

    @property
    def line(self) -> str:
        """What leaves the plane, and by how much."""
        u, v, d = self.sigma
        limits = ", ".join(f"{value:.0f}" for value in self.limit)
        tilts = np.rad2deg(self.tilts)
        return (
            f"seen along a plane, landmarks are off by {u:.0f}, {v:.0f}, {d:.0f} px in u, v, d, and a tenth of their "
            f"distance is {limits} px; {self.leaving} of {len(tilts)} motions tilt the camera by more than "
            f"{np.rad2deg(LEAVES):.1f} deg ({np.median(tilts):.2g} in the median, {tilts.max():.2g} at most)"
        )

    @property
    def fields(self) -> dict[str, object]:
        """What a manifest says of it."""
        tilts = np.rad2deg(self.tilts)
        return {
            "holds": self.holds,
            "sigma_px": self.sigma,
            "limit_px": self.limit,
            "motions": len(tilts),
            "leaving": self.leaving,
            "tilt_deg": {"median": float(np.median(tilts)), "most": float(tilts.max())},
        }


def plane_of(motions: list[RelativeMotion], trial: Trial, belief: Belief) -> Plane:
    """What of ``motions`` the planar log that :func:`log_of` makes of them leaves out."""
    R, t = stacked(motions)
    turn, _ = in_robot_axes(R, t, robot_axes(t), 0.0)
    roll, pitch, _ = Rotation.from_matrix(turn).as_rotvec().T
    sensor = belief.sensor
    u, v, d = sensor.sigma
    f, _ = sensor.rig
    disparity = float(np.median(trial.z[:, 2]))
    return Plane((u, v, d), (f / NEAR, f / NEAR, disparity / NEAR), np.hypot(roll, pitch))


def stacked(motions: list[RelativeMotion]) -> tuple[Array, Array]:
    """Rotations (T, 3, 3) and translations (T, 3) of motions, m."""
    return np.array([m.pose.R for m in motions]), np.array([m.pose.t for m in motions])


def log_of(
    sequence: StereoSequence,
    motions: list[RelativeMotion],
    truth: tuple[Array, Array] | None,
    max_landmarks: int,
    lever: float = 0.0,
) -> tuple[Trial, Belief]:
    """One trial of the sequence and what a filter is to believe about it.

    Controls are the visual odometry's own motions on the plane: a filter that takes them uses the same images twice.

    Parameters
    ----------
    truth : poses (n, 3, 3), (n, 3) of the left camera in the world, m, or None
    max_landmarks : in the log, at most
    lever : m from the robot's point forward to the camera

    Raises
    ------
    InputError
        No track can be used, or too few landmarks are allowed.
    """
    rig = sequence.rectification.rig
    dt = np.diff(sequence.t)
    R, t = stacked(motions)
    axes = robot_axes(t)
    moves = planar_motions(*in_robot_axes(R, t, axes, lever))
    mount = Mount(position=(lever, 0.0, 0.0), rotation=tuple(euler_angles(axes @ CAMERA).tolist()))
    seen = selected(observations(rig, motions), max_landmarks, rig.image_size[0])
    sigma = misfit(seen, planar_path(moves), mount, rig)
    true_path = None
    if truth is not None:
        steps = in_robot_axes(*relative(*truth), axes, lever)
        true_path = planar_path(planar_motions(*steps))
    trial = Trial(
        run=0,
        start=np.zeros(3),
        controls=np.column_stack([dt, moves[:, 0] / dt, moves[:, 2] / dt]),
        first=np.searchsorted(seen["step"], np.arange(1, len(sequence) + 1)),
        landmark=seen["landmark"].to_numpy(np.int64),
        z=seen[PIXELS].to_numpy(float),
        n_landmarks=int(seen["landmark"].max()) + 1,
        truth=true_path,
    )
    sensor = BelievedSensor(model="uvd", sigma=sigma, f=rig.f, B=rig.baseline, mount=mount)
    return trial, Belief(motion=odometry_noise(motions, axes, dt), sensor=sensor)


def observations(rig: StereoRig, motions: list[RelativeMotion]) -> pd.DataFrame:
    """Rows (step, z0, z1, z2, sigma, piece): u, v, d in px of every track, ``sigma`` that of d.

    A track is a chain of inliers of the motions: where one is an outlier it ends, and another landmark begins.
    """
    pieces = linked([m.rows[m.inliers] for m in motions])
    parts = []
    tracks = 0
    for step, (motion, piece) in enumerate(zip(motions, pieces, strict=True), start=1):
        good = motion.inliers
        before = _sights(rig, motion.uv0[good], motion.sigma0[good], piece, step - 1)
        after = _sights(rig, motion.uv1[good], motion.sigma1[good], piece, step)
        new = piece >= tracks  # tracks are numbered in the order in which they begin
        tracks += int(new.sum())
        parts += [before[new], after]
    return pd.concat(parts).sort_values(["piece", "step"], ignore_index=True)


def _sights(rig: StereoRig, uv: Array, sigma: Array, piece: Indices, step: int) -> pd.DataFrame:
    """Rows of one step from pixels (N, 4) of tracks and their standard deviations, px."""
    u = uv[:, 0] - rig.K_left[0, 2]
    return pd.DataFrame(
        {
            "piece": piece,
            "z0": u,
            "z1": uv[:, 1] - rig.K_left[1, 2],
            "z2": u - (uv[:, 2] - rig.K_right[0, 2]),
            "sigma": np.hypot(sigma[:, 0], sigma[:, 2]),
            "step": step,
        }
    )


def selected(rows: pd.DataFrame, most: int, width: int) -> pd.DataFrame:
    """Rows (step, landmark, z0, z1, z2) of at most ``most`` landmarks, as many at once as that allows.

    Raises
    ------
    InputError
        No track can be used, or even one landmark at once makes more than ``most`` in all.
    """
    rows = rows[rows["z2"] >= NEAR * rows["sigma"]]
    if rows.empty:
        raise InputError(f"no match has a disparity of at least {NEAR:g} of its sigmas; the scene is too far for a log")
    begins = (rows["piece"].diff() != 0) | (rows["step"].diff() != 1)
    rows = rows.assign(piece=begins.cumsum())

    def selection_of(slots: int) -> pd.DataFrame:
        return thinned(rows, TrackSelection(slots, MAX_AGE, MIN_LIFE, BANDS, float(width)))

    low = 1
    high = MOST_SLOTS
    best = selection_of(1)
    if (fewest := best["landmark"].nunique()) > most:
        raise InputError(f"--max-landmarks {most}: one landmark at once makes {fewest} over the sequence; allow more")
    while low < high:  # the largest number at once
        middle = (low + high + 1) // 2
        table = selection_of(middle)
        if table["landmark"].nunique() <= most:
            low = middle
            best = table
        else:
            high = middle - 1
    return best


def misfit(
    seen: pd.DataFrame,
    path: Array,
    mount: Mount,
    rig: StereoRig,
) -> tuple[float, float, float]:
    """Root mean square of u, v, d (px) about landmarks placed by their nearest sight along the planar path.

    ``path`` is (T + 1, 3). The misfit holds the noise of the pixels and what the plane leaves out, roll and pitch above
    all. No truth is used.
    """
    packed = mount.packed()
    nearest = seen.loc[seen.groupby("landmark")["z2"].idxmax()].set_index("landmark")
    u, v, d = nearest[PIXELS].to_numpy(float).T
    in_sensor = stereo.triangulate(u, v, d, rig.f, rig.baseline)
    in_robot = point.from_sensor(*in_sensor, packed)
    x, y, heading = path[nearest["step"]].T
    places = np.column_stack(point.to_world(x, y, heading, *in_robot))
    others = seen[seen["step"].to_numpy() != nearest["step"].loc[seen["landmark"]].to_numpy()]
    targets = places[nearest.index.get_indexer(others["landmark"])]
    in_robot = point.to_robot(*path[others["step"]].T, *targets.T)
    expected = stereo.project(*point.to_sensor(*in_robot, packed), rig.f, rig.baseline)
    error = others[PIXELS].to_numpy(float) - np.column_stack(expected)
    u, v, d = np.sqrt(np.mean(error**2, axis=0)).tolist()
    return u, v, d


def odometry_noise(motions: list[RelativeMotion], axes: Array, dt: Array) -> BelievedMotion:
    """Noise of v and omega from the covariances of the motions, root mean square over the steps.

    Parameters
    ----------
    axes : (3, 3), rows are forward, left and up of the robot in the camera's frame
    dt : (T,), duration of each motion, s
    """
    forward, _, up = axes
    variances = np.empty((len(motions), 2))
    for k, motion in enumerate(motions):
        about = up @ angular(motion.pose)
        variances[k, 0] = forward @ motion.covariance[:3, :3] @ forward
        variances[k, 1] = about @ motion.covariance[3:, 3:] @ about
    of_velocities = variances / dt[:, None] ** 2
    sigma_v, sigma_omega = np.sqrt(of_velocities.mean(axis=0)).tolist()
    return BelievedMotion(sigma_v=sigma_v, sigma_omega=sigma_omega)


def relative(R: Array, t: Array) -> tuple[Array, Array]:
    """Motions from frame to frame of poses (n, 3, 3), (n, 3)."""
    back = np.swapaxes(R[:-1], 1, 2)
    return back @ R[1:], np.einsum("nij,nj->ni", back, np.diff(t, axis=0))


def robot_axes(t: Array) -> Array:
    """Axes forward, left, up of the robot in those of the camera (right, down, forward), rows, (3, 3).

    Forward is the mean direction of the motions, so that the robot goes where it heads; the camera's rows are level.
    Where the rig moves less than 10 cm in all, or more than 30 degrees off the optical axis, forward is the optical
    axis.

    Parameters
    ----------
    t : (T, 3), translations from frame to frame in camera axes, m
    """
    total = t.sum(axis=0)
    length = np.linalg.norm(total)
    forward = total / max(length, 1e-12)
    if forward[2] < 0.0:
        forward = -forward
    if length < MOVED or forward[2] < np.cos(np.deg2rad(WITHIN)):
        return CAMERA.T.copy()
    left = np.cross([0.0, -1.0, 0.0], forward)
    left /= np.linalg.norm(left)
    return np.array([forward, left, np.cross(forward, left)])


def in_robot_axes(
    R: Array,
    t: Array,
    axes: Array,
    lever: float,
) -> tuple[Array, Array]:
    """Motions (T, 3, 3), (T, 3) of the camera as those of a robot point ``lever`` m behind it, in robot axes."""
    ahead = np.array([lever, 0.0, 0.0])
    turn = axes @ R @ axes.T
    return turn, t @ axes.T + ahead - turn @ ahead


def planar_motions(R: Array, t: Array) -> Array:
    """Forward, left (m) and turn (rad) of motions (T, 3, 3), (T, 3) in robot axes, (T, 3).

    Height, roll and pitch are left out step by step: a slope is unrolled, nothing of it adds up.
    """
    turn = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    return np.column_stack([t[:, :2], turn])


def planar_path(motions: Array) -> Array:
    """Poses x, y, heading (T + 1, 3) from :func:`planar_motions`, from the origin on; the heading is not wrapped."""
    forward, left, turn = motions.T
    controls = np.column_stack([np.ones(len(motions)), forward, turn])
    path = dead_reckoning(np.zeros(3), controls)
    heading = path[:-1, 2]
    path[1:, 0] -= np.cumsum(left * np.sin(heading))
    path[1:, 1] += np.cumsum(left * np.cos(heading))
    return path
