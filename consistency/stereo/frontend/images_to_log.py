"""A sequence of stereo pairs as a planar log.

The log has controls, observations of few landmarks, truth, trajectory, and the noise that a filter believes.
Trajectories are texts that `consistency analyse` and the usual tools read.

Motions in space become those of a robot on a plane: forward, left, up, and the heading about up.
"""

from __future__ import annotations

import io
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from consistency.bench.scenario import Belief, BelievedMotion, BelievedSensor, Mount, models
from consistency.bench.store.parquet import write_tables, write_texts
from consistency.bench.store.recorded_log import write_log
from consistency.bench.types import Trial
from consistency.referee.errors import InputError
from consistency.referee.system import manifest_of, require_free
from consistency.referee.types import Array, Indices
from consistency.stereo.frontend.camera_truth import find_truth, missing_of_drive, read_truth
from consistency.stereo.visual_odometry.arrays import opencv
from consistency.stereo.visual_odometry.odometry import motion_covariances, trajectory, visual_odometry
from consistency.stereo.visual_odometry.relative_motion import MotionSettings, RelativeMotion
from consistency.stereo.visual_odometry.relative_pose import angular, euler_angles
from consistency.stereo.visual_odometry.rig import StereoRig
from consistency.stereo.visual_odometry.sequence import StereoSequence, read_sequence
from consistency.stereo.visual_odometry.tracks import PIXELS, TrackSelection, linked, thinned

LANDMARKS = 200  # in a log; the filters' covariance is then 603 x 603
AXES = ("x", "y", "z", "roll", "pitch", "yaw")
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

FEWEST = MIN_LIFE + 1  # stereo pairs of a log: the first is not an observation


@dataclass(frozen=True)
class FrontendOptions:
    """Options for the part of a sequence that becomes a log."""

    calibration: Path | None = None
    truth: Path | None = None
    format: str | None = None
    left: str | None = None
    right: str | None = None
    rate: float | None = None  # Hz
    max_landmarks: int = LANDMARKS
    lever: float = 0.0  # m from the robot's point forward to the camera
    planar: bool = False  # whether the log is written where the motions leave the plane, too
    seed: int = 0  # of RANSAC
    settings: MotionSettings = field(default_factory=MotionSettings)


class Summary(NamedTuple):
    """A built log, and what it is of."""

    sequence: StereoSequence
    motions: list[RelativeMotion]
    plane: Plane | None  # None of fewer pairs than a log takes
    log: tuple[Trial, Belief] | None  # None of fewer pairs than a log takes, and where the motions leave the plane
    truth: Path | None

    def lines(self, out: Path) -> list[str]:
        """What a terminal shows, and what to do next."""
        motions = self.motions
        stamps = self.sequence.t
        distance = sum(np.linalg.norm(m.pose.t) for m in motions)
        inliers = np.median([m.inliers.sum() for m in motions])
        lines = [f"{len(stamps)} stereo pairs, {distance:.2f} m, {inliers:.0f} inliers in the median"]
        doubts = [m.doubt for m in motions if m.doubt]
        if doubts:
            lines.append(f"{len(doubts)} of {len(motions)} motions: {doubts[0]}")
        faults = [m.fault for m in motions if m.fault]
        if faults:
            bridges = f"{len(faults)} of {len(motions)} motions could not be measured and are bridged"
            lines.append(f"{bridges}, with the covariance of that; the first: {faults[0]}")
        misfit = sum(m.chi2 for m in motions) / sum(m.dof for m in motions)
        lines.append(
            f"residuals: chi2/dof {misfit:.2f}; 1 where the stated noise of the features (--sigma-per-scale) is right"
        )
        if self.plane is not None and not self.plane.holds:
            lines.append(self.plane.line)
        lines += self._log_lines(out)
        if not self.sequence.timed:
            rate = len(motions) / (stamps[-1] - stamps[0])
            lines.append(f"the images have no times: {rate:g} Hz assumed, --rate says otherwise")
        return lines + self._truth_lines(out)

    def _log_lines(self, out: Path) -> list[str]:
        if self.log is not None:
            trial, belief = self.log
            u, v, d = belief.sensor.sigma
            return [
                f"log: {trial.n_landmarks} landmarks, {len(trial.z)} observations; sigma u {u:.2f} v {v:.2f} "
                f"d {d:.2f} px, v {belief.motion.sigma_v:.3g} m/s, omega {belief.motion.sigma_omega:.3g} rad/s",
                "controls come from these images too: a filter that takes both uses the images twice",
                f"log in {out}; next: consistency run --log {out} --filter ekf-uvd --out RESULTS",
            ]
        if self.plane is None:
            motion = self.motions[0]
            scale = np.repeat([1e3, 180.0 / np.pi], 3)
            values = scale * motion.pose.vector
            sigmas = scale * np.sqrt(np.diagonal(motion.covariance))
            texts = []
            for name, value, sigma in zip(AXES, values, sigmas, strict=True):
                texts.append(f"{name} {value:+.2f} +- {sigma:.2g}")
            return [
                f"motion of the left camera: {', '.join(texts[:3])} mm; {', '.join(texts[3:])} deg",
                f"no log of {FEWEST - 1} pairs; motion in {out}",
            ]
        return [
            f"no planar log of a camera that is not on a robot in the plane: trajectory and motions are in {out}; "
            "--planar writes the log nevertheless"
        ]

    def _truth_lines(self, out: Path) -> list[str]:
        if self.truth is None:
            oxts = ""
            lacking = missing_of_drive(self.sequence)  # files without which oxts of a drive is not a truth
            if lacking:
                oxts = f": that of oxts takes {' and '.join(lacking)} too"
            return [f"no truth found{oxts}; --truth FILE takes one"]
        judge = f"consistency analyse {out}/trajectory.tum --truth {out}/truth.tum --covariance {out}/covariance.txt"
        windows = f"consistency analyse {out}/motions.tum --truth {out}/truth.tum --motions --relative 1"
        return [
            f"truth from {self.truth}; next: {judge} --error so3",
            f"or motion by motion, whatever the world: {windows}",
        ]


def write_frontend_log(
    images: Path,
    out: Path,
    options: FrontendOptions,
    overwrite: bool = False,
) -> Summary:
    """Run the front-end on ``images`` and write the log folder ``out``, whole or not at all.

    Two pairs make one motion and no log; nor do motions that leave the plane, unless ``options.planar``.

    Beside the files of a log: trajectory.tum and covariance.txt (error convention so3), motions.tum with covariances of
    the motions (likewise), truth.tum where known.

    Raises
    ------
    InputError
        As :func:`consistency.vision.read_sequence` and :func:`consistency.vision.relative_motion`; ``out``
        exists; no landmark is left.
    """
    started = time.monotonic()
    if options.max_landmarks < 1:
        raise InputError(f"--max-landmarks {options.max_landmarks}: must be at least 1")
    if not np.isfinite(options.lever):
        raise InputError(f"--lever {options.lever}: must be a finite number of metres")
    if options.seed < 0:
        raise InputError(f"--seed {options.seed}: must not be negative")
    sequence = read_sequence(images, options.calibration, options.format, options.left, options.right, options.rate)
    kind = "motion"
    if len(sequence) >= FEWEST:
        kind = "log"
    require_free(out, overwrite, kind)
    rig = sequence.uvd_rig
    path = options.truth or find_truth(sequence)
    truth = None
    if path is not None:
        truth = read_truth(path, sequence)
    motions = visual_odometry(sequence, rng=np.random.default_rng(options.seed), settings=options.settings)
    texts = trajectory_texts(sequence, motions, truth)
    timestamps = "assumed"
    if sequence.timed:
        timestamps = "read"
    manifest = manifest_of(
        kind=kind,
        seed=options.seed,
        runs=1,
        complete=True,
        failures=0,
        wall=time.monotonic() - started,
        opencv=opencv().__version__,
        images=str(images),
        calibration=sequence.calibration.source,
        settings=asdict(options.settings),
        timestamps=timestamps,
        bridged={str(k): m.fault for k, m in enumerate(motions) if m.fault},
    )
    plane = None
    if kind == "log":
        trial, belief = log_of(sequence, motions, truth, options.max_landmarks, options.lever)
        plane = plane_of(motions, trial, belief)
        manifest["plane"] = plane.fields
        if plane.holds or options.planar:
            view = rig.image_size, rig.principal_point
            write_log(out, [trial], belief, None, manifest, overwrite, view, texts)
            return Summary(sequence, motions, plane, (trial, belief), path)
    write_tables(out, {}, manifest, lambda at: write_texts(at, texts), overwrite)
    return Summary(sequence, motions, plane, None, path)


def trajectory_texts(
    sequence: StereoSequence, motions: list[RelativeMotion], truth: tuple[Array, Array] | None
) -> dict[str, str]:
    """Texts of trajectory.tum, covariance.txt and truth.tum, all in the first camera's frame, and of motions.tum.

    ``truth`` is R (frames, 3, 3) and t (frames, 3), m; without it there is no truth.tum.
    """
    R, t, P = trajectory(motions)
    texts = {
        "trajectory.tum": trajectory_text(sequence.t, R, t),
        "covariance.txt": covariance_text(sequence.t, P),
        "motions.tum": motions_text(sequence.t, *stacked(motions), motion_covariances(motions)),
    }
    if truth is not None:
        true_R, true_t = truth
        back = true_R[0].T
        texts["truth.tum"] = trajectory_text(sequence.t, back @ true_R, (true_t - true_t[0]) @ back.T)
    return texts


def trajectory_text(stamps: Array, R: Array, t: Array) -> str:
    """Lines ``t tx ty tz qx qy qz qw`` of poses (n, 3, 3), (n, 3)."""
    quaternion = Rotation.from_matrix(R).as_quat(canonical=True)
    return _lines(stamps, np.column_stack([t, quaternion]))


def covariance_text(stamps: Array, P: Array) -> str:
    """Lines of t and 36 numbers of covariances (n, 6, 6), translation first; a start known exactly has none."""
    known = P.any(axis=(1, 2))
    return _lines(stamps[known], P[known].reshape(-1, 36))


def motions_text(
    stamps: Array,
    R: Array,
    t: Array,
    P: Array,
) -> str:
    """Lines of t, the motion since the line before (7 numbers) and 36 of its covariance, translation first.

    The first line is where the motions (T, 3, 3), (T, 3), (T, 6, 6) start, for T + 1 stamps.
    """
    rows = np.zeros((len(stamps), 7 + 36))
    rows[0, 6] = 1.0
    rows[1:, :3] = t
    rows[1:, 3:7] = Rotation.from_matrix(R).as_quat(canonical=True)
    rows[1:, 7:] = P.reshape(-1, 36)
    return _lines(stamps, rows)


def _lines(stamps: Array, values: Array) -> str:
    text = io.StringIO()
    formats = ["%.9f"] + ["%.17g"] * values.shape[1]
    np.savetxt(text, np.column_stack([stamps, values]), formats)
    return text.getvalue()


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
    in_sensor = models.triangulate(u, v, d, rig.f, rig.baseline)
    in_robot = models.from_sensor(*in_sensor, packed)
    x, y, heading = path[nearest["step"]].T
    places = np.column_stack(models.to_world(x, y, heading, *in_robot))
    others = seen[seen["step"].to_numpy() != nearest["step"].loc[seen["landmark"]].to_numpy()]
    targets = places[nearest.index.get_indexer(others["landmark"])]
    in_robot = models.to_robot(*path[others["step"]].T, *targets.T)
    expected = models.project(*models.to_sensor(*in_robot, packed), rig.f, rig.baseline)
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
    path = models.dead_reckoning(np.zeros(3), controls)
    heading = path[:-1, 2]
    path[1:, 0] -= np.cumsum(left * np.sin(heading))
    path[1:, 1] += np.cumsum(left * np.cos(heading))
    return path
