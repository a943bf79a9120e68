"""A sequence of stereo pairs as a log folder: controls, observations of few landmarks, truth, trajectory."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

from consistency.errors import InputError
from consistency.frontend.tum import covariance_text, trajectory_text
from consistency.frontend.truth import find_truth, read_truth
from consistency.log import write_log
from consistency.models import point, stereo
from consistency.scenario import Belief, BelievedMotion, BelievedSensor, Mount
from consistency.storage import manifest_of, require_free
from consistency.types import Array, Trial
from consistency.vision.features import opencv
from consistency.vision.matching import is_rectified
from consistency.vision.motion import RelativeMotion, Settings
from consistency.vision.odometry import trajectory, visual_odometry
from consistency.vision.planar import OPTICAL, in_robot_axes, planar_motions, planar_path, robot_axes
from consistency.vision.pose import RelativePose, angular
from consistency.vision.rig import StereoRig
from consistency.vision.sequence import Sequence, read_sequence
from consistency.vision.tracks import PIXELS, Selection, linked, thinned

LANDMARKS = 300  # in a log; the filters' covariance is then 903 x 903
MAX_AGE, MIN_LIFE, BANDS = 12, 2, 3  # observations of a landmark at most and at least, columns: as docs/kitti07.md
NEAR = 10.0  # standard deviations of its disparity that a landmark has at least: its range is nearly Gaussian
MOST_SLOTS = 64  # landmarks at once
CAMERA = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # right, down, forward <- forward, left, up


@dataclass(frozen=True)
class Options:
    """What of a sequence becomes a log."""

    calibration: Path | None = None
    truth: Path | None = None
    format: str | None = None
    left: str | None = None
    right: str | None = None
    rate: float | None = None  # Hz
    max_landmarks: int = LANDMARKS
    lever: float = 0.0  # m from the robot's point forward to the camera
    seed: int = 0  # of RANSAC
    settings: Settings = field(default_factory=Settings)


@dataclass(frozen=True)
class Summary:
    """What came of it."""

    frames: int
    landmarks: int
    observations: int
    distance: float  # m along the path
    inliers: float  # median of the motions
    noise_ratio: float  # chi2/dof of all motions: measured variance of the pixels over the stated one
    sigma_px: tuple[float, float, float]  # u, v, d
    sigma_v: float  # m/s
    sigma_omega: float  # rad/s
    timed: bool  # whether images had timestamps
    truth: Path | None


def write_frontend_log(images: Path, out: Path, options: Options, overwrite: bool = False) -> Summary:
    """Run the front-end on ``images`` and write the log folder ``out``, whole or not at all.

    Beside the files of a log: trajectory.tum and covariance.txt (error convention so3), truth.tum where known.

    Raises
    ------
    InputError
        As :func:`consistency.vision.sequence.read_sequence` and :func:`consistency.vision.relative_motion`; ``out``
        exists; no landmark is left.
    """
    started = time.monotonic()
    if options.max_landmarks < 1:
        raise InputError(f"--max-landmarks {options.max_landmarks}: must be at least 1")
    if not np.isfinite(options.lever):
        raise InputError(f"--lever {options.lever}: must be a finite number of metres")
    require_free(out, overwrite, "log")
    sequence = read_sequence(
        images, options.calibration, options.format, options.left, options.right, options.rate
    )  # fmt: skip
    if not is_rectified(sequence.rectification.rig):
        raise InputError(f"{sequence.calibration.source}: the cameras do not stand side by side; no uvd sensor does")
    path = options.truth or find_truth(sequence)
    truth = None if path is None else read_truth(path, sequence)
    motions = visual_odometry(sequence, rng=np.random.default_rng(options.seed), settings=options.settings)
    trial, belief = log_of(sequence, motions, truth, options)
    rig = sequence.rectification.rig
    manifest = manifest_of(
        kind="log", seed=options.seed, runs=1, complete=True, failures=0, wall=time.monotonic() - started,
        opencv=opencv().__version__, images=str(images), calibration=sequence.calibration.source,
        settings=asdict(options.settings), timestamps="read" if sequence.timed else "assumed",
    )  # fmt: skip
    view = (rig.image_size, (float(rig.K_left[0, 2]), float(rig.K_left[1, 2])))
    write_log(out, [trial], belief, None, manifest, overwrite, view, trajectory_files(sequence, motions, truth))
    chi2, dof = (sum(values) for values in zip(*((m.chi2, m.dof) for m in motions), strict=True))
    return Summary(
        len(sequence), trial.n_landmarks, len(trial.z),
        float(sum(np.linalg.norm(m.pose.t) for m in motions)), float(np.median([m.inliers.sum() for m in motions])),
        chi2 / dof, belief.sensor.sigma, belief.motion.sigma_v, belief.motion.sigma_omega, sequence.timed, path,
    )  # fmt: skip


def log_of(
    sequence: Sequence, motions: list[RelativeMotion], truth: tuple[Array, Array] | None, options: Options
) -> tuple[Trial, Belief]:
    """One trial of the sequence and what a filter is to believe about it.

    Controls are the visual odometry's own motions on the plane: a filter that takes them uses the same images twice.
    """
    rig, dt = sequence.rectification.rig, np.diff(sequence.t)
    R, t = np.array([m.pose.R for m in motions]), np.array([m.pose.t for m in motions])
    axes = robot_axes(t)
    moves = planar_motions(*in_robot_axes(R, t, axes, options.lever))
    mount = Mount(
        position=(options.lever, 0.0, 0.0), rotation=tuple(map(float, RelativePose(axes @ CAMERA, np.zeros(3)).rpy))
    )
    seen = selected(observations(rig, motions), options.max_landmarks, rig.image_size[0])
    sigma = misfit(seen, planar_path(moves), mount, rig)
    true_path = None
    if truth is not None:
        steps = in_robot_axes(*relative(*truth), axes, options.lever)
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
    sensor = BelievedSensor(model="uvd", sigma=sigma, f=float(rig.K_left[0, 0]), B=rig.baseline, mount=mount)
    return trial, Belief(motion=odometry_noise(motions, axes, dt), sensor=sensor)


def observations(rig: StereoRig, motions: list[RelativeMotion]) -> pd.DataFrame:
    """Rows (step, z0, z1, z2, sigma, piece): u, v, d in px of every track, ``sigma`` that of d.

    A track is a chain of inliers of the motions: where one is an outlier it ends, and another landmark begins.
    """
    pieces = linked([m.rows[m.inliers] for m in motions])
    parts, known = [], set[int]()
    for step, (m, piece) in enumerate(zip(motions, pieces, strict=True), start=1):
        new = np.array([p not in known for p in piece.tolist()], bool)
        known.update(piece.tolist())
        for at, uv, sigma, keep in ((step - 1, m.uv0, m.sigma0, new), (step, m.uv1, m.sigma1, np.full(len(new), True))):
            uv, sigma = uv[m.inliers][keep], sigma[m.inliers][keep]
            u, v = uv[:, 0] - rig.K_left[0, 2], uv[:, 1] - rig.K_left[1, 2]
            d = u - (uv[:, 2] - rig.K_right[0, 2])
            columns = {"piece": piece[keep], "z0": u, "z1": v, "z2": d, "sigma": np.hypot(sigma[:, 0], sigma[:, 2])}
            parts.append(pd.DataFrame(columns).assign(step=at))
    return pd.concat(parts, ignore_index=True).sort_values(["piece", "step"], ignore_index=True)


def selected(rows: pd.DataFrame, most: int, width: int) -> pd.DataFrame:
    """Rows (step, landmark, z0, z1, z2) of at most ``most`` landmarks, as many at once as that allows.

    Raises
    ------
    InputError
        No track can be used, or even one landmark at once makes more than ``most`` in all.
    """
    rows = rows[rows["z2"] >= NEAR * rows["sigma"]]
    rows = rows.assign(piece=np.cumsum((rows["piece"].diff() != 0) | (rows["step"].diff() != 1)))

    def chosen(slots: int) -> pd.DataFrame:
        return thinned(rows, Selection(slots, MAX_AGE, MIN_LIFE, BANDS, float(width)))

    low, high, best = 1, MOST_SLOTS, chosen(1)
    if best["landmark"].nunique() > most:
        raise InputError(
            f"--max-landmarks {most}: one landmark at once makes {best['landmark'].nunique()} over the sequence; allow more"
        )
    while low < high:  # the largest number at once
        middle = (low + high + 1) // 2
        table = chosen(middle)
        if table["landmark"].nunique() <= most:
            low, best = middle, table
        else:
            high = middle - 1
    return best


def misfit(seen: pd.DataFrame, path: Array, mount: Mount, rig: StereoRig) -> tuple[float, float, float]:
    """Root mean square of u, v, d (px) about landmarks placed by their nearest sight along the planar path.

    It holds the noise of the pixels and what the plane leaves out, roll and pitch above all. No truth is used.
    """
    f, B, packed = float(rig.K_left[0, 0]), rig.baseline, mount.packed()
    nearest = seen.loc[seen.groupby("landmark")["z2"].idxmax()].set_index("landmark")
    x, y, heading = path[nearest["step"]].T
    ahead = stereo.triangulate(*nearest[PIXELS].to_numpy(float).T, f, B)
    place = np.column_stack(point.to_world(x, y, heading, *point.from_sensor(*ahead, packed)))
    others = seen[seen["step"].to_numpy() != nearest["step"].loc[seen["landmark"]].to_numpy()]
    x, y, heading = path[others["step"]].T
    target = place[nearest.index.get_indexer(others["landmark"])].T
    back = point.to_sensor(*point.to_robot(x, y, heading, *target), packed)
    error = others[PIXELS].to_numpy(float) - np.column_stack(stereo.project(*back, f, B))
    u, v, d = np.sqrt(np.mean(error**2, axis=0))
    return float(u), float(v), float(d)


def odometry_noise(motions: list[RelativeMotion], axes: Array, dt: Array) -> BelievedMotion:
    """Noise of v and omega from the covariances of the motions, root mean square over the steps."""
    forward, up = axes[0], axes[2]
    along = [forward @ m.covariance[:3, :3] @ forward for m in motions]
    turn = [up @ angular(m.pose) for m in motions]
    about = [row @ m.covariance[3:, 3:] @ row for row, m in zip(turn, motions, strict=True)]
    sigma_v, sigma_omega = (float(np.sqrt(np.mean(np.array(variance) / dt**2))) for variance in (along, about))
    return BelievedMotion(sigma_v=sigma_v, sigma_omega=sigma_omega)


def relative(R: Array, t: Array) -> tuple[Array, Array]:
    """Motions from frame to frame of poses (n, 3, 3), (n, 3)."""
    back = np.swapaxes(R[:-1], 1, 2)
    return back @ R[1:], np.einsum("nij,nj->ni", back, np.diff(t, axis=0))


def trajectory_files(
    sequence: Sequence, motions: list[RelativeMotion], truth: tuple[Array, Array] | None
) -> dict[str, str]:
    """Texts of trajectory.tum, covariance.txt and truth.tum, all in the first camera's frame."""
    R, t, P = trajectory(motions)
    files = {"trajectory.tum": trajectory_text(sequence.t, R, t), "covariance.txt": covariance_text(sequence.t, P)}
    if truth is not None:
        back = truth[0][0].T
        files["truth.tum"] = trajectory_text(sequence.t, back @ truth[0], (truth[1] - truth[1][0]) @ back.T)
    return files
