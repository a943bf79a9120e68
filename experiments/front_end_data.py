"""Stereo pairs with true motions, for e11: KITTI 06, EuRoC at rest, a rover. Their origin: docs/front-end.md."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.types import Array
from consistency.stereo.frontend.camera_truth import read_truth
from consistency.stereo.frontend.images_to_log import relative
from consistency.stereo.visual_odometry.calibration_files import read_opencv
from consistency.stereo.visual_odometry.odometry import visual_odometry
from consistency.stereo.visual_odometry.relative_motion import RelativeMotion
from consistency.stereo.visual_odometry.relative_pose import angular
from consistency.stereo.visual_odometry.sequence import read_image, read_sequence
from consistency.vision import RelativePose, StereoRig, relative_motion

KITTI, EUROC, MINNIE = "kitti06_f0-50", "euroc_static", "minnie_quad"
MINNIE_K = np.array([[1018.6, 0.0, 956.501], [0.0, 1018.6, 617.314], [0.0, 0.0, 1.0]])  # px, of the .meta files
SAME = 2e-5  # rad; successive turns of a car differ by more than ten times that
MINNIE_FILES = ("MinnieRectLeft", "MinnieRectRight", "MinnieRectLeftNext", "MinnieRectRightNext")


@dataclass(frozen=True)
class Case:
    """Relative motions of one data set and the truth of each."""

    name: str
    rig: StereoRig
    motions: list[RelativeMotion]
    truth: list[RelativePose]
    image: Array  # of the first left camera
    t: Array  # of the stereo pairs, s

    @property
    def surveyed(self) -> Array:
        """Motions (n,) bool whose truth was measured: a rotation equal to the next one's was interpolated."""
        turns = np.array([Rotation.from_matrix(true.R).as_rotvec() for true in self.truth])
        same = np.linalg.norm(np.diff(turns, axis=0), axis=1) < SAME
        return np.asarray(~(np.append(same, False) | np.insert(same, 0, False)))

    @property
    def errors(self) -> Array:
        """Estimate minus truth, (n, 6): m, and the rotation vector of R R_true' in rad, both in frame 0."""
        return np.array([pose_error(m.pose, true) for m, true in zip(self.motions, self.truth, strict=True)])

    @property
    def covariances(self) -> Array:
        """(n, 6, 6) of :attr:`errors`."""
        return np.array([by_vector(m.pose, m.covariance) for m in self.motions])


def pose_error(pose: RelativePose, true: RelativePose) -> Array:
    """Translation difference and rotation vector of R R_true', (6,)."""
    return np.concatenate([pose.t - true.t, Rotation.from_matrix(pose.R @ true.R.T).as_rotvec()])


def by_vector(pose: RelativePose, S: Array) -> Array:
    """Covariance with a rotation vector about the axes of frame 0 in place of roll, pitch, yaw."""
    J = np.eye(6)
    J[3:, 3:] = angular(pose)
    return np.asarray(J @ S @ J.T)


# --- the data ------------------------------------------------------------------------------------


def cases_of(folder: Path, seed: int) -> dict[str, Case]:
    """All three data sets with default settings."""
    truths = {KITTI: "poses.txt", EUROC: "groundtruth_first97.csv"}
    cases = {name: sequence_case(folder / name, np.random.default_rng(seed), truth) for name, truth in truths.items()}
    return cases | {MINNIE: _minnie(folder / MINNIE, np.random.default_rng(seed))}


def sequence_case(folder: Path, rng: np.random.Generator, truth: str = "poses.txt", step: int = 1) -> Case:
    """Every ``step``-th stereo pair of a sequence: a drive that is as many times faster."""
    sequence = read_sequence(folder)
    R, t = read_truth(folder / truth, sequence)
    left, right, times = sequence.left[::step], sequence.right[::step], sequence.t[::step]
    sequence = replace(sequence, left=left, right=right, t=times)
    turns, shifts = relative(R[::step], t[::step])
    motions = visual_odometry(sequence, rng=rng)
    true = [RelativePose(R, t) for R, t in zip(turns, shifts, strict=True)]
    name = folder.name if step == 1 else f"{folder.name}, every {step}."
    return Case(name, sequence.rectification.rig, motions, true, sequence.pair(0)[0], sequence.t)


def _minnie(folder: Path, rng: np.random.Generator) -> Case:
    raw = read_opencv(folder / "raw_stereo_calibration.yml")
    images = [read_image(folder / f"{name}.png") for name in MINNIE_FILES]
    height, width = images[0].shape
    baseline = np.array([np.linalg.norm(raw.T), 0.0, 0.0])  # the .meta files have it to four digits less
    rig = StereoRig(MINNIE_K, MINNIE_K, np.eye(3), baseline, (width, height))
    motion = relative_motion(rig, (images[0], images[1]), (images[2], images[3]), rng=rng)
    before, after = (_onboard(folder / f"{MINNIE_FILES[i]}.meta") for i in (0, 2))
    return Case(folder.name, rig, [motion], [before.inverse().compose(after)], images[0], np.arange(2.0))


def _onboard(path: Path) -> RelativePose:
    """Pose of the left camera in the world by the rover's own localisation; numbers run together in the file."""
    text = path.read_text(encoding="utf-8")
    poses = []
    for frame in ("pose_fixedFrame_robotFrame", "pose_robotFrame_sensorFrame"):
        part = text.split(f".{frame}.data:")[1]
        rows = [part.split(f".{key}:")[1].splitlines()[0] for key in ("orientation", "translation")]
        q, t = (np.array(re.findall(r"-?\d+\.\d+?(?=-|\d\.|\s*$)", row), float) for row in rows)
        poses.append(RelativePose(Rotation.from_quat(q).as_matrix(), t))
    return poses[0].compose(poses[1])
