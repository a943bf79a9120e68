"""Wrong options and wrong files of ``analyse``, beside those of test_recording: status 2, and one line that says it."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import refused
from drives import write_drive, write_states
from test_bags import Drive
from test_bags import write as write_bag
from test_recording import ERRORS, EST, LINE, MATRICES, P36, TUM, csv, npz, text

Make = Callable[[Path], Any]
STATES = ("state_estimate.txt", "--truth", "state_groundtruth.txt", "--covariance", "state_deviation.txt")
BAG = ("one.bag", "--truth-topic", "/vicon")
P21 = "".join(f"{line.split()[0]} {' '.join(['1.0'] * 21)}\n" for line in P36.splitlines())


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Right files that take time to write, each in a folder of its own."""
    folder = tmp_path_factory.mktemp("made")
    for name in ("bag", "drive"):
        (folder / name).mkdir()
    write_bag(folder / "bag/one.bag", 1, "pose", Drive(61))
    write_drive(folder / "drive/one", calibrated=False)
    return folder


def runs(**names: int) -> Make:
    """Folders of so many runs each."""

    def make(at: Path) -> None:
        rng = np.random.default_rng(331)
        for name, number in names.items():
            (at / name).mkdir()
            for run in range(number):
                rows = np.array([line.split() for line in (P36 if name == "P" else TUM).splitlines()], float)
                if name == "est":
                    rows[:, 1:4] += rng.normal(size=(3, 3))
                np.savetxt(at / name / f"{run}.txt", rows)

    return make


def doubled(at: Path) -> None:
    runs(est=2, truth=2, P=2)(at)
    shutil.copy(at / "est/0.txt", at / "est/1.txt")


def both_suffixes(at: Path) -> None:
    runs(est=1, truth=1, P=1)(at)
    shutil.copy(at / "est/0.txt", at / "est/0.tum")


def pipe(at: Path) -> None:
    text()(at)
    (at / "t.txt").unlink()
    os.mkfifo(at / "t.txt")


def folder_named(name: str) -> Make:
    def make(at: Path) -> None:
        text()(at)
        (at / name).mkdir()

    return make


def bytes_of(name: str, content: bytes, first: Make) -> Make:
    def make(at: Path) -> None:
        first(at)
        (at / name).write_bytes(content)

    return make


def of(name: str) -> Make:
    """What the fixture made."""
    return lambda at: shutil.copytree(at.parent / "made" / name, at, dirs_exist_ok=True)


def cut(at: Path) -> None:
    of("bag")(at)
    data = (at / "one.bag").read_bytes()
    (at / "one.bag").write_bytes(data[: len(data) // 3])


def with_estimate(at: Path) -> None:
    of("drive")(at)
    (at / "t.txt").write_text("".join(f"0.{k} 0 0 0 0 0 0 1\n" for k in range(3)))
    (at / "P.txt").write_text(P36)


def late_estimate(at: Path) -> None:
    with_estimate(at)
    for path, content in ((at / "t.txt", TUM), (at / "P.txt", P36)):
        lines = [f"{1317042145.0 + k / 10} {line.split(' ', 1)[1]}" for k, line in enumerate(content.splitlines())]
        path.write_text("\n".join(lines) + "\n")


DRIVE = ("t.txt", "--covariance", "P.txt", "--truth", "one")
RUNS = ("est", "--truth", "truth", "--covariance", "P")
NAN = TUM.replace("0 0 0 1\n", "nan nan nan nan\n")
WRONG: dict[str, tuple[Make, tuple[str, ...], str]] = {
    # options
    "false alarm and confidence": (csv(), (*EST, "--false-alarm", "0.01", "--confidence", "0.9"), "give one of them"),
    "detect of 1": (csv(), (*EST, "--detect", "1"), "detect must"),
    "detect no number": (csv(), (*EST, "--detect", "much"), "Invalid value for '--detect'"),
    "fail on what": (csv(), (*EST, "--fail-on", "biased"), "--fail-on must be 'inconsistent', got 'biased'"),
    "innovations of what": (csv(), (*EST, "--innovations", "white"), "--innovations must be 'optimal', got 'white'"),
    "overwrite nothing": (csv(), (*EST, "--overwrite"), "--overwrite goes with --report"),
    "unknown option": (csv(), (*EST, "--units", "deg"), "No such option: --units"),
    "offset no number": (csv(), (*EST, "--time-offset", "soon"), "--time-offset soon: must be a number of seconds"),
    "offset not finite": (csv(), (*EST, "--time-offset", "nan"), "--time-offset nan: must be a number of seconds"),
    "offset without truth": (csv(), ("est.csv", "--time-offset", "1"), "--time-offset needs --truth"),
    "offset of steps": (
        csv(lambda e: e.drop(columns="t")),
        (*EST, "--time-offset", "1"),
        "--time-offset: needs a column t",
    ),
    "axes of a table": (csv(), (*EST, "--axes", "x"), "--axes: does not go with est.csv"),
    "empty state": (csv(), (*EST, "--state", ""), "needs names of columns, each once"),
    "order of a table": (csv(), (*EST, "--covariance-order", "rotation-translation"), "does not go with est.csv"),
    "convention without truth": (csv(), ("est.csv", "--error", "left"), "--error needs --truth"),
    "topic of a trajectory": (text(), (*LINE, "--topic", "/odom"), "--topic: does not go with t.txt"),
    "name too long": (text(), ("x" * 300 + ".txt", *LINE[1:]), "x.txt: "),
    # files
    "other width below": (text(t=TUM + "0.3 1 2 3 0 0 0 1 5\n"), LINE, "t.txt, line 4: has 9 columns"),
    "other layout below": (
        text(P=P36 + P21.replace("0.", "0.5", 1)),
        LINE,
        "P.txt, line 4: has 22 columns, the lines before 37",
    ),
    "covariances twice": (
        text(t="".join(f"{a} {b.split(' ', 1)[1]}\n" for a, b in zip(TUM.splitlines(), P36.splitlines(), strict=True))),
        LINE,
        "t.txt holds covariances already; give one of them",
    ),
    "columns of no layout": (
        text(t="".join(f"{k} " + "2 " * 39 + "\n" for k in range(3))),
        LINE,
        "line 1: has 40 columns",
    ),
    "a pipe": (pipe, LINE, "t.txt: is a device, not a file"),
    "truth a folder": (
        folder_named("gt"),
        ("t.txt", "--truth", "gt", "--covariance", "P.txt"),
        "gt: is a folder, but t.txt",
    ),
    "a run twice": (doubled, RUNS, "a run that is there twice; leave one of them out"),
    "a run in two files": (both_suffixes, RUNS, "est: holds the run '0' twice, as .txt and .tum"),
    "empty filter": (
        csv(lambda e: e.assign(filter=["a"] * 14 + [None])),
        EST,
        "est.csv, line 16: column 'filter' is empty",
    ),
    "dof of a half": (csv(lambda e: e.assign(nis=1.0, nis_dof=1.5)), EST, "est.csv, line 2: nis 1 with nis_dof 1.5"),
    # archives
    "npz lengths": (
        npz(errors=ERRORS, covariances=MATRICES, lengths=[3, 4]),
        ("a.npz",),
        "key 'lengths' must be 2 whole",
    ),
    "npz times": (
        npz(errors=ERRORS, covariances=MATRICES, t=[0, 1, 1]),
        ("a.npz",),
        "key 't' must be 3 increasing numbers",
    ),
    "npz truth not finite": (
        npz(estimates=ERRORS, truth=ERRORS + np.nan, covariances=MATRICES),
        ("a.npz",),
        "key 'truth', run 0, step 1: not finite",
    ),
    "npz convention of two": (
        npz(estimates=ERRORS, truth=ERRORS, covariances=MATRICES),
        ("a.npz", "--error", "left"),
        "--error left: here it is",
    ),
    # bags
    "bag without truth": (of("bag"), ("one.bag",), "one.bag: needs --truth-topic, of poses or PARENT:CHILD"),
    "bag and a truth": (of("bag"), (*BAG, "--truth", "one.bag"), "--truth: does not go with one.bag"),
    "bag cut short": (cut, BAG, "one.bag: cannot be read as a ROS bag"),
    # OpenVINS and KITTI
    "states with a matrix": (
        lambda at: (write_states(at), text()(at)),
        (*STATES[:4], "P.txt"),
        "P.txt, line 1: has 37 columns",
    ),
    "drive of another clock": (
        late_estimate,
        DRIVE,
        "no estimate has a truth within 0.01 s",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_input_is_refused_in_one_line(
    case: str, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    make, arguments, expected = WRONG[case]
    (tmp_path / "made").symlink_to(made)
    work = tmp_path / "work"
    work.mkdir()
    make(work)
    monkeypatch.chdir(work)
    before = sorted(path.name for path in work.iterdir())
    err = refused(capsys, "analyse", *arguments)
    assert expected in err
    assert len(err) < 700
    assert before == sorted(path.name for path in work.iterdir())  # nothing is half written
