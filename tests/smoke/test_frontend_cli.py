"""Images to a log to a verdict, as a newcomer types it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import scene
from command import consistency

pytest.importorskip("cv2", reason="OpenCV (the extra vision) is not installed")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``images``, a KITTI sequence of a wall, and ``log``, what the front-end makes of it."""
    at = tmp_path_factory.mktemp("frontend")
    scene.write_kitti(at / "images", scene.drive(8), scene.texture(np.random.default_rng(0)))
    done = consistency("frontend", "images", "--calibration", "images/calib.txt", "--out", "log", cwd=at)
    assert "8 stereo pairs, 0.70 m" in done.stdout
    assert "uses the images twice" in done.stdout
    return at


def test_filters_run_on_the_log_and_are_judged(folder: Path) -> None:
    filters = ("--filter", "ekf-uvd", "--filter", "ukf-uvd")
    consistency("run", "--log", "log", *filters, "--out", "results", cwd=folder)
    verdicts = json.loads(consistency("analyse", "results", "--json", cwd=folder).stdout)
    assert set(verdicts) == {"ekf-uvd", "ukf-uvd"}
    assert "failed" not in {verdict["status"] for verdict in verdicts.values()}


def test_the_trajectory_is_judged(folder: Path) -> None:
    files = ("--truth", "log/truth.tum", "--covariance", "log/covariance.txt", "--error", "so3")
    done = consistency("analyse", "log/trajectory.tum", *files, cwd=folder)
    assert "trajectory" in done.stdout


def test_the_motions_are_judged_over_windows(folder: Path) -> None:
    """In whatever world: the truth of the log begins at the first camera, that of the sequence where it was driven."""
    files = ("--truth", "log/truth.tum", "--motions", "--relative", "0.2s")
    verdicts = consistency("analyse", "log/motions.tum", *files, "--json", cwd=folder)
    assert json.loads(verdicts.stdout)["motions"]["statistics"]["runs"] == 3
    assert "3 windows of 0.2 s" in verdicts.stderr


def test_a_log_is_not_overwritten_by_accident(folder: Path) -> None:
    done = consistency("frontend", "images", "--out", "log", cwd=folder, status=2)
    assert "exists already" in done.stderr
    consistency("frontend", "images", "--out", "log", "--overwrite", "--max-landmarks", "20", cwd=folder)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("nowhere",), "nowhere: no such folder of images"),
        (("images", "--calibration", "none.yaml"), "--calibration none.yaml: no such file"),
        (("images", "--format", "ros"), "--format ros: must be one of kitti, kitti-raw, euroc, opencv"),
        (("images", "--estimator", "icp"), "estimator 'icp': must be one of reprojection, svd, horn"),
        (("images", "--sigma-per-scale", "0"), "sigma_per_scale: 0.0, must be a positive number"),
        (("images", "--max-landmarks", "0"), "--max-landmarks 0: must be at least 1"),
        (("images", "--truth", "none.txt"), "--truth none.txt: no such file"),
        ((".",), ".: holds no stereo images of a known layout"),
        (("images", "--left", "a*", "--right", "b*"), "no image is like 'a*' (--left) or 'b*' (--right)"),
        (("images", "--lever", "nan"), "--lever nan: must be a finite number"),
        (("images", "--seed", "-1"), "--seed -1: must not be negative"),
    ],
)
def test_bad_input(folder: Path, arguments: tuple[str, ...], said: str) -> None:
    done = consistency("frontend", *arguments, "--out", "other", cwd=folder, status=2)
    assert said in done.stderr
    assert len(done.stderr.strip().splitlines()) <= 2
    assert not (folder / "other").exists()


def test_two_pairs_make_a_motion_and_no_log(folder: Path) -> None:
    """The rendered motion is known to 0.02 px, far below 7 stated sigma (1e-8 by chance)."""
    poses = scene.drive(2)
    scene.write_kitti(folder / "short", poses, scene.texture(np.random.default_rng(0)))
    done = consistency("frontend", "short", "--out", "one", cwd=folder)
    said = re.findall(r"(x|y|z|roll|pitch|yaw) ([+-][\d.]+) \+- ([\d.e-]+)", done.stdout)
    scale = np.repeat([1e3, 180.0 / np.pi], 3)
    for (_, value, sigma), true in zip(said, scale * poses[1].vector, strict=True):
        assert abs(float(value) - true) < 7.0 * float(sigma) + 0.01
    assert "no log of 2 pairs; motion in one" in done.stdout
    names = ("trajectory.tum", "covariance.txt", "motions.tum", "truth.tum", "manifest.json")
    assert {path.name for path in (folder / "one").iterdir()} == set(names)
    done = consistency("run", "--log", "one", "--filter", "ekf-uvd", "--out", "other", cwd=folder, status=2)
    assert "one/sensor.toml: missing" in done.stderr
    again = consistency("frontend", "short", "--out", "one", cwd=folder, status=2)
    assert "--out one: exists already" in again.stderr
    consistency("frontend", "short", "--out", "one", "--overwrite", cwd=folder)


def test_images_are_no_log(folder: Path) -> None:
    done = consistency("run", "--log", "images", "--filter", "ekf-uvd", "--out", "other", cwd=folder, status=2)
    assert "images/sensor.toml: missing; 'consistency frontend' makes" in done.stderr
