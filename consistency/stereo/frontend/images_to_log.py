"""A sequence of stereo pairs as a log folder: controls, observations of few landmarks, truth, trajectory.

Trajectories are texts that `consistency analyse` and the usual tools read.
"""

from __future__ import annotations

import io
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.bench.scenario import Belief
from consistency.bench.store.folder_tables import write_tables
from consistency.bench.store.recorded_log import write_log
from consistency.bench.types import Trial
from consistency.referee.errors import InputError
from consistency.referee.system.folders import require_free
from consistency.referee.system.provenance import manifest_of
from consistency.referee.types import Array
from consistency.stereo.frontend.camera_truth import find_truth, missing_of_drive, read_truth
from consistency.stereo.frontend.planar_log import MIN_LIFE, Plane, log_of, plane_of, stacked
from consistency.stereo.visual_odometry.cameras.input_errors import opencv
from consistency.stereo.visual_odometry.odometry import motion_covariances, trajectory, visual_odometry
from consistency.stereo.visual_odometry.relative_motion import MotionSettings, RelativeMotion
from consistency.stereo.visual_odometry.sequence import StereoSequence, read_sequence

LANDMARKS = 200  # in a log; the filters' covariance is then 603 x 603
FEWEST = MIN_LIFE + 1  # stereo pairs of a log: the first is not an observation
AXES = ("x", "y", "z", "roll", "pitch", "yaw")


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
            motion = belief.motion
            return [
                f"log: {trial.n_landmarks} landmarks, {len(trial.z)} observations; sigma u {u:.2f} v {v:.2f} "
                f"d {d:.2f} px, v {motion.sigma_v:.3g} m/s, omega {motion.sigma_omega:.3g} rad/s",
                "controls come from these images too: a filter that takes both uses the images twice",
                f"log in {out}; next: consistency run --log {out} --filter ekf-uvd --out RESULTS",
            ]
        if self.plane is None:
            return _motion_lines(self.motions[0], out)
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


def _motion_lines(motion: RelativeMotion, out: Path) -> list[str]:
    scale = np.repeat([1e3, 180.0 / np.pi], 3)
    values = scale * motion.pose.vector
    sigmas = scale * np.sqrt(np.diagonal(motion.covariance))
    texts = [f"{name} {value:+.2f} +- {sigma:.2g}" for name, value, sigma in zip(AXES, values, sigmas, strict=True)]
    return [
        f"motion of the left camera: {', '.join(texts[:3])} mm; {', '.join(texts[3:])} deg",
        f"no log of {FEWEST - 1} pairs; motion in {out}",
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
    write_tables(out, {}, manifest, lambda at: _write_texts(at, texts), overwrite)
    return Summary(sequence, motions, plane, None, path)


def _write_texts(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")


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
