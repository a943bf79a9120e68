"""Images to a log to a verdict, as a newcomer types it."""

import json
import re

import numpy as np
import pytest
import scene
from own_process import consistency

from consistency.vision import RelativePose

pytest.importorskip("cv2", reason="OpenCV (the extra vision) is not installed")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """``images``, a KITTI sequence of a wall, and ``log``, what the front-end makes of it."""
    at = tmp_path_factory.mktemp("frontend")
    scene.write_kitti(at / "images", scene.drive(8), scene.texture(np.random.default_rng(0)))
    done = consistency("frontend", "images", "--calibration", "images/calib.txt", "--out", "log", cwd=at)
    assert "8 stereo pairs, 0.70 m" in done.stdout
    assert "uses the images twice" in done.stdout
    assert "tilt" not in done.stdout
    assert json.loads((at / "log/manifest.json").read_text())["plane"]["holds"]
    return at


def test_filters_run_on_the_log_and_are_judged(folder):
    filters = ("--filter", "ekf-uvd", "--filter", "ukf-uvd")
    consistency("run", "--log", "log", *filters, "--out", "results", cwd=folder)
    verdicts = json.loads(consistency("analyse", "results", "--json", cwd=folder).stdout)
    assert set(verdicts) == {"ekf-uvd", "ukf-uvd"}
    assert "failed" not in {verdict["status"] for verdict in verdicts.values()}
    done = consistency("run", "--log", "log", "--screen", "3,3,3", *filters[:2], "--out", "screened", cwd=folder)
    assert re.search(r"screen: \d+ of \d+ observations that follow another", done.stderr)
    screening = json.loads((folder / "screened/manifest.json").read_text())["screening"]
    assert screening["gate"] == [3.0, 3.0, 3.0]
    assert 0 <= screening["broken"] < screening["judged"] < screening["offered"]
    again = ("run", "--log", "log", *filters[:2], "--out", "screened", "--resume")
    assert "have another --screen" in consistency(*again, cwd=folder, status=2).stderr
    done = consistency("run", "--log", "log", "--screen", "3,3", *filters[:2], "--out", "no", cwd=folder, status=2)
    assert "--screen 3,3: must be 3 positive numbers for a sensor 'uvd', as 2,2,1" in done.stderr
    done = consistency("run", "herath2007-stereo", "--screen", "3", *filters[:2], "--out", "no", cwd=folder, status=2)
    assert "--screen goes with --log" in done.stderr


def test_the_trajectory_is_judged(folder):
    files = ("--truth", "log/truth.tum", "--covariance", "log/covariance.txt", "--error", "so3")
    done = consistency("analyse", "log/trajectory.tum", *files, cwd=folder)
    assert "trajectory" in done.stdout


def test_the_motions_are_judged_over_windows(folder):
    """In whatever world: the truth of the log begins at the first camera, that of the sequence where it was driven."""
    files = ("--truth", "log/truth.tum", "--motions", "--relative", "0.2s")
    verdicts = consistency("analyse", "log/motions.tum", *files, "--json", cwd=folder)
    assert json.loads(verdicts.stdout)["motions"]["statistics"]["runs"] == 3
    assert "3 windows of 0.2 s" in verdicts.stderr


@pytest.mark.parametrize(
    "arguments, said",
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
def test_bad_input(folder, refused, arguments, said):
    assert said in refused(folder, "frontend", *arguments, "--out", "other")


def test_two_pairs_make_a_motion_and_no_log(folder):
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


def test_a_camera_that_leaves_the_plane_has_no_planar_log(folder):
    """It nods by 8 degrees at each pair; a tenth of a landmark's distance is 32 px, or 6 degrees."""
    poses = [
        pose.compose(RelativePose.from_vector(np.array([0.0, 0.0, 0.0, np.deg2rad(8.0) * (k % 2), 0.0, 0.0])))
        for k, pose in enumerate(scene.drive(5))
    ]
    scene.write_kitti(folder / "nodding", poses, scene.texture(np.random.default_rng(0)))
    done = consistency("frontend", "nodding", "--out", "nods", cwd=folder)
    assert "4 of 4 motions tilt the camera by more than 1.7 deg (8 in the median, 8 at most)" in done.stdout
    assert "no planar log of a camera that is not on a robot in the plane" in done.stdout
    names = ("trajectory.tum", "covariance.txt", "motions.tum", "truth.tum", "manifest.json")
    assert {path.name for path in (folder / "nods").iterdir()} == set(names)
    plane = json.loads((folder / "nods/manifest.json").read_text())["plane"]
    assert (plane["holds"], plane["leaving"], plane["motions"]) == (False, 4, 4)
    assert plane["sigma_px"][1] > plane["limit_px"][1] == pytest.approx(32.0)
    done = consistency("frontend", "nodding", "--planar", "--out", "nods", "--overwrite", cwd=folder)
    assert "log in nods; next: consistency run" in done.stdout
    assert (folder / "nods/sensor.toml").is_file()


def test_images_are_no_log(folder):
    done = consistency("run", "--log", "images", "--filter", "ekf-uvd", "--out", "other", cwd=folder, status=2)
    assert "images/sensor.toml: missing; 'consistency frontend' makes" in done.stderr
