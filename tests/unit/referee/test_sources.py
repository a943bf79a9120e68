"""Nine sources, each written by what writes it, to a verdict with a picture by one command."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command import consistency
from drives import write_drive, write_states
from scipy.spatial.transform import Rotation
from test_conventions import FAULTS, RATE, run_example
from test_drives import estimates

from consistency.referee.types import Array

STEPS = 80
SIGMA = np.array([0.2, 0.1, 0.05, 0.01, 0.02, 0.01])
Make = Callable[[pytest.MonkeyPatch], list[str]]


def poses(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Times, estimates and truth, (N,) and (N, 7) twice; errors as ROS defines them."""
    t = 0.1 * np.arange(STEPS)
    turn = Rotation.from_rotvec(np.outer(t, [0.05, 0.1, 0.3]))
    place, e = np.column_stack([np.sin(t), np.cos(t), 0.1 * t]), SIGMA * rng.normal(size=(STEPS, 6))
    own = (Rotation.from_rotvec(-e[:, 3:]) * turn).as_quat()
    return t, np.column_stack([place - e[:, :3], own]), np.column_stack([place, turn.as_quat()])


def tum(_: pytest.MonkeyPatch) -> list[str]:
    for name in ("est", "truth"):
        Path(name).mkdir()
    for run in range(5):
        t, own, true = poses(np.random.default_rng())
        rows = np.tile(np.diag(SIGMA**2).ravel(), (STEPS, 1))
        np.savetxt(f"est/{run}.tum", np.column_stack([t, own, rows]))
        np.savetxt(f"truth/{run}.tum", np.column_stack([t, true]))
    return ["est", "--truth", "truth"]


def csv(_: pytest.MonkeyPatch) -> list[str]:
    rng = np.random.default_rng()
    true = np.column_stack([np.arange(1.0, STEPS + 1), rng.normal(size=(STEPS, 2))])
    own = true.copy()
    own[:, 1:] -= SIGMA[:2] * rng.normal(size=(STEPS, 2))
    P = np.tile([SIGMA[0] ** 2, 0.0, SIGMA[1] ** 2], (STEPS, 1))
    write = {"delimiter": ",", "comments": ""}
    np.savetxt("est.csv", np.column_stack([own, P]), header="step,a,b,P_a_a,P_a_b,P_b_b", **write)  # type: ignore[arg-type]
    np.savetxt("truth.csv", true, header="step,a,b", **write)  # type: ignore[arg-type]
    return ["est.csv", "--truth", "truth.csv", "--state", "a,b"]


def npz(_: pytest.MonkeyPatch) -> list[str]:
    errors = SIGMA[:3] * np.random.default_rng().normal(size=(6, STEPS, 3))
    np.savez("est.npz", errors=errors, covariances=np.broadcast_to(np.diag(SIGMA[:3] ** 2), (6, STEPS, 3, 3)))
    return ["est.npz"]


def openvins(_: pytest.MonkeyPatch) -> list[str]:
    write_states(Path())
    return ["state_estimate.txt", "--truth", "state_groundtruth.txt", "--covariance", "state_deviation.txt"]


def pose2(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    run_example("GTSAM Pose2", Path().absolute(), monkeypatch)
    return ["est.csv", "--truth", "truth.csv", "--error", "left"]


def pose3(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    run_example("GTSAM Pose3", Path().absolute(), monkeypatch)
    return ["est", "--truth", "truth", "--error", "left", "--covariance-order", "rotation-translation"]


def bag(ros: int) -> Make:
    def make(_: pytest.MonkeyPatch) -> list[str]:
        pytest.importorskip("rosbags", reason="needs the extra 'ros'")
        from test_bags import Drive, write

        name = "drive.bag" if ros == 1 else "drive"
        write(Path(name), ros, "odometry", Drive(np.random.SeedSequence().entropy))  # type: ignore[arg-type]
        return [name, "--topic", "/odom", "--truth-topic", "map:body"]

    return make


def kitti(_: pytest.MonkeyPatch) -> list[str]:
    estimates(write_drive(Path("drive_0001_sync")))
    return ["est.tum", "--truth", "drive_0001_sync"]


SOURCES: dict[str, Make] = {
    "TUM": tum, "CSV": csv, "npz": npz, "OpenVINS": openvins, "GTSAM Pose2": pose2, "GTSAM Pose3": pose3,
    "ROS 1 bag": bag(1), "ROS 2 bag": bag(2), "KITTI": kitti,
}  # fmt: skip


@pytest.mark.parametrize("name", SOURCES)
def test_one_command_to_a_verdict_with_a_picture(
    name: str, inside: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing is found in errors that have the stated covariance: false-alarm rate 1e-5 for each verdict."""
    out, _ = consistency(capsys, "analyse", *SOURCES[name](monkeypatch), "--report", "look", "--json", *RATE)
    verdicts = json.loads(out)
    assert verdicts
    for verdict in verdicts.values():
        assert verdict["status"] in {"consistent", "undecided"} - FAULTS
    page = Path("look/report.html").read_text(encoding="utf-8")
    assert "Errors and stated bounds" in page
    assert Path("look/report.pdf").read_bytes().startswith(b"%PDF")
