"""The page of conventions: the example of each library, with right options and wrong ones; sources to verdict."""

import json
import re
import runpy
import secrets
from pathlib import Path

import numpy as np
import pytest
from command import consistency
from documents import blocks, read
from drives import write_drive, write_states
from scipy.spatial.transform import Rotation
from test_drives import estimates

PAGE = read("docs/reference/conventions.md")
SECTIONS = dict(part.split("\n", 1) for part in PAGE.split("\n## ")[1:])
NEEDED = {"GTSAM Pose2": "gtsam", "GTSAM Pose3": "gtsam", "Stone Soup": "stonesoup"}
FAULTS = {"overconfident", "conservative", "biased", "heavy-tailed", "inconsistent"}
WRONG = "Wrong, and seen:"
RATE = ("--false-alarm", "1e-5")


def commands(text):
    return [line.split()[1:] for line in text.splitlines() if line.startswith("    consistency analyse est")]


def run_example(name, at, monkeypatch, *changes):
    """The code of a section, with random numbers of its own."""
    if name in NEEDED:
        pytest.importorskip(NEEDED[name], reason=f"{NEEDED[name]} is not installed")
    (code,) = blocks("docs/reference/conventions.md", "python", part=name)
    text = code.text
    for old, new in (("default_rng(6021)", f"default_rng({secrets.randbits(60)})"), *changes):
        assert old in text
        text = text.replace(old, new)
    (at / "make.py").write_text(text)
    monkeypatch.chdir(at)
    runpy.run_path("make.py")


def statuses(command, capsys):
    options = ["--time-offset", "0"] if command[1] == "est" else []  # without a look at the clocks, which takes seconds
    out, _ = consistency(capsys, *command, "--json", *RATE, *options)
    return {verdict["status"] for verdict in json.loads(out).values()}


@pytest.mark.parametrize("name", SECTIONS)
def test_what_is_declared_is_right_and_its_neighbour_is_seen(name, tmp_path, monkeypatch, capsys):
    """False-alarm rate 1e-5 for each verdict, three or fewer an example."""
    run_example(name, tmp_path, monkeypatch)
    right, *wrong = SECTIONS[name].split(WRONG)
    assert commands(right)
    for command in commands(right):
        assert not statuses(command, capsys) & FAULTS, command
    for command in commands("".join(wrong)):
        assert statuses(command, capsys) & FAULTS, command
    assert wrong or name == "Stone Soup"


def test_the_names_of_stone_soup_are_in_the_order_of_its_state(tmp_path, monkeypatch, capsys):
    """The mix-up is seen; the truth keeps its names."""
    truth = ("truth.append(key | dict(zip(NAMES,", 'truth.append(key | dict(zip(["x", "vx", "y", "vy"],')
    names = 'NAMES = ["x", "y", "vx", "vy"]'
    assert names in SECTIONS["Stone Soup"]
    run_example("Stone Soup", tmp_path, monkeypatch, ('NAMES = ["x", "vx", "y", "vy"]', names), truth)
    assert statuses(commands(SECTIONS["Stone Soup"])[0], capsys) & FAULTS


def test_the_notebook_says_what_the_command_says(tmp_path, monkeypatch, capsys):
    run_example("GTSAM Pose3", tmp_path, monkeypatch)
    out, _ = consistency(capsys, *commands(SECTIONS["GTSAM Pose3"])[0], "--json")
    said = {verdict["status"] for verdict in json.loads(out).values()}
    (code,) = blocks("docs/reference/conventions.md", "python notebook", part="GTSAM Pose3")
    (tmp_path / "look.py").write_text(code.text)
    runpy.run_path("look.py")
    assert {capsys.readouterr().out.strip()} == said


def test_the_table_declares_what_the_examples_do():
    rows = [line for line in PAGE.splitlines() if line.startswith("| [")]
    assert [re.search(r"\]\(#([^)]*)\)", row).group(1) for row in rows] == [
        name.lower().replace(" ", "-") for name in SECTIONS
    ]
    for row, section in zip(rows, SECTIONS.values(), strict=True):
        declared = row.split("|")[3]
        options = " ".join(commands(section.split(WRONG)[0])[0][1:]).split(" --truth ")[1].split(" ", 1)[1:]
        assert (options[0] if options else "nothing") in declared


# --- sources, each written by what writes it ------------------------------------------------------------------


STEPS = 80
SIGMA = np.array([0.2, 0.1, 0.05, 0.01, 0.02, 0.01])


def poses(rng):
    """Times, estimates and truth, (N,) and (N, 7) twice; errors as ROS defines them."""
    t = 0.1 * np.arange(STEPS)
    turn = Rotation.from_rotvec(np.outer(t, [0.05, 0.1, 0.3]))
    place, e = np.column_stack([np.sin(t), np.cos(t), 0.1 * t]), SIGMA * rng.normal(size=(STEPS, 6))
    own = (Rotation.from_rotvec(-e[:, 3:]) * turn).as_quat()
    return t, np.column_stack([place - e[:, :3], own]), np.column_stack([place, turn.as_quat()])


def tum(_):
    for name in ("est", "truth"):
        Path(name).mkdir()
    for run in range(5):
        t, own, true = poses(np.random.default_rng())
        rows = np.tile(np.diag(SIGMA**2).ravel(), (STEPS, 1))
        np.savetxt(f"est/{run}.tum", np.column_stack([t, own, rows]))
        np.savetxt(f"truth/{run}.tum", np.column_stack([t, true]))
    return ["est", "--truth", "truth"]


def csv(_):
    rng = np.random.default_rng()
    true = np.column_stack([np.arange(1.0, STEPS + 1), rng.normal(size=(STEPS, 2))])
    own = true.copy()
    own[:, 1:] -= SIGMA[:2] * rng.normal(size=(STEPS, 2))
    P = np.tile([SIGMA[0] ** 2, 0.0, SIGMA[1] ** 2], (STEPS, 1))
    write = {"delimiter": ",", "comments": ""}
    np.savetxt("est.csv", np.column_stack([own, P]), header="step,a,b,P_a_a,P_a_b,P_b_b", **write)
    np.savetxt("truth.csv", true, header="step,a,b", **write)
    return ["est.csv", "--truth", "truth.csv", "--state", "a,b"]


def npz(_):
    errors = SIGMA[:3] * np.random.default_rng().normal(size=(6, STEPS, 3))
    np.savez("est.npz", errors=errors, covariances=np.broadcast_to(np.diag(SIGMA[:3] ** 2), (6, STEPS, 3, 3)))
    return ["est.npz"]


def openvins(_):
    write_states(Path())
    return ["state_estimate.txt", "--truth", "state_groundtruth.txt", "--covariance", "state_deviation.txt"]


def pose2(monkeypatch):
    run_example("GTSAM Pose2", Path().absolute(), monkeypatch)
    return ["est.csv", "--truth", "truth.csv", "--error", "left"]


def pose3(monkeypatch):
    run_example("GTSAM Pose3", Path().absolute(), monkeypatch)
    return ["est", "--truth", "truth", "--error", "left", "--covariance-order", "rotation-translation"]


def bag(ros):
    def make(_):
        pytest.importorskip("rosbags", reason="needs the extra 'ros'")
        from test_bags import Drive, write

        name = "drive.bag" if ros == 1 else "drive"
        write(Path(name), ros, "odometry", Drive(np.random.SeedSequence().entropy))
        return [name, "--topic", "/odom", "--truth-topic", "map:body"]

    return make


def kitti(_):
    estimates(write_drive(Path("drive_0001_sync")))
    return ["est.tum", "--truth", "drive_0001_sync"]


SOURCES = {
    "TUM": tum, "CSV": csv, "npz": npz, "OpenVINS": openvins, "GTSAM Pose2": pose2, "GTSAM Pose3": pose3,
    "ROS 1 bag": bag(1), "ROS 2 bag": bag(2), "KITTI": kitti,
}  # fmt: skip


@pytest.mark.parametrize("name", SOURCES)
def test_one_command_to_a_verdict(name, inside, monkeypatch, capsys):
    """Nothing is found in errors that have the stated covariance: false-alarm rate 1e-5 for each verdict."""
    out, _ = consistency(capsys, "analyse", *SOURCES[name](monkeypatch), "--json", *RATE)
    verdicts = json.loads(out)
    assert verdicts
    for verdict in verdicts.values():
        assert verdict["status"] in {"consistent", "undecided"} - FAULTS


def test_one_command_to_a_picture(inside, monkeypatch, capsys):
    consistency(capsys, "analyse", *pose2(monkeypatch), "--report", "look", *RATE)
    page = Path("look/report.html").read_text(encoding="utf-8")
    assert "Errors and stated bounds" in page
    assert Path("look/report.pdf").read_bytes().startswith(b"%PDF")
