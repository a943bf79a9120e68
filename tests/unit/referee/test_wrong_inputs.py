"""Wrong options and wrong files of ``analyse``: status 2, and one line that says it."""

import os
import shutil

import numpy as np
import pandas as pd
import pytest
from command import refused
from drives import write_states
from test_recording import POSE_COLUMNS, archive, poses, set_cell, write

TUM = "0.0 0 0 0 0 0 0 1\n0.1 1 0 0 0 0 0 1\n0.2 2 0 0 0 0 0 1\n"
P36 = "".join(f"{t} {' '.join(str(float(v)) for v in np.eye(6).ravel())}\n" for t in (0.0, 0.1, 0.2))
EST = ("est.csv", "--truth", "truth.csv")
LINE = ("t.txt", "--truth", "truth.txt", "--covariance", "P.txt")


def csv(edit=None, edit_truth=None):
    return lambda at: write(at, edit, edit_truth)


def text(**files):
    whole = {"t": TUM, "truth": TUM, "P": P36} | files

    def make(at):
        for name, content in whole.items():
            (at / f"{name}.txt").write_text(content)

    return make


def raw(content):
    def make(at):
        write(at)
        (at / "est.csv").write_text(content)

    return make


def npz(**arrays):
    return lambda at: archive(at, **arrays)


def columns(*names):
    return lambda table: table.drop(columns=list(names))


def twice(table):
    return pd.concat([table, table.iloc[[3]]])


HEADER = ",".join(["step", "x", "y", "heading", *POSE_COLUMNS]) + "\n"
ERRORS, MATRICES = np.zeros((2, 3, 2)), np.tile(np.eye(2), (2, 3, 1, 1))
ASYMMETRIC = np.array([[1.0, 0.5], [0.4, 1.0]])
STATES = ("state_estimate.txt", "--truth", "state_groundtruth.txt", "--covariance", "state_deviation.txt")
P21 = "".join(f"{line.split()[0]} {' '.join(['1.0'] * 21)}\n" for line in P36.splitlines())


def runs(**names):
    """Folders of so many runs each."""

    def make(at):
        rng = np.random.default_rng(331)
        for name, number in names.items():
            (at / name).mkdir()
            for run in range(number):
                rows = np.array([line.split() for line in (P36 if name == "P" else TUM).splitlines()], float)
                if name == "est":
                    rows[:, 1:4] += rng.normal(size=(3, 3))
                np.savetxt(at / name / f"{run}.txt", rows)

    return make


def doubled(at):
    runs(est=2, truth=2, P=2)(at)
    shutil.copy(at / "est/0.txt", at / "est/1.txt")


def both_suffixes(at):
    runs(est=1, truth=1, P=1)(at)
    shutil.copy(at / "est/0.txt", at / "est/0.tum")


def pipe(at):
    text()(at)
    (at / "t.txt").unlink()
    os.mkfifo(at / "t.txt")


def folder_named(name):
    def make(at):
        text()(at)
        (at / name).mkdir()

    return make


RUNS = ("est", "--truth", "truth", "--covariance", "P")
WRONG = {
    "no such truth": (csv(), ("est.csv", "--truth", "other.csv"), "other.csv: no such file"),
    "empty file": (raw(""), EST, "est.csv: is empty"),
    "header alone": (raw(HEADER), EST, "est.csv: holds no row"),
    "short line": (
        raw(HEADER + "1,0,0,0,1,0,0,1,0,1\n2,0,0\n"),
        EST,
        "est.csv, line 3: has 3 columns, the header has 10",
    ),
    "binary": (lambda at: (at / "est.csv").write_bytes(b"\xff\xfe\x00PAR1"), ("est.csv",), "est.csv: not a text file"),
    "column twice": (raw("x,x\n1,2\n"), EST, "column 'x' is duplicated"),
    "no truth": (csv(), ("est.csv",), "needs --truth FILE, or columns nis and nis_dof"),
    "some of the truth beside it": (
        csv(lambda e: e.assign(true_x=0.0, true_y=0.0, true_head=0.0)),
        ("est.csv",),
        "column 'true_heading' is missing; there are: run, step, ",
    ),
    "truth of another state beside it": (
        csv(lambda e: e.assign(true_x=0.0, true_vx=0.0)),
        ("est.csv",),
        "the state is x,y,heading: --state names another, and --columns true_y=NAME that column",
    ),
    "missing state of the truth": (csv(None, columns("y")), EST, "truth.csv: column 'y' is missing"),
    "other state": (csv(), (*EST, "--state", "x,vx"), "est.csv: column 'vx' is missing"),
    "state twice": (csv(), (*EST, "--state", "x,x"), "--state x,x: needs names of columns, each once"),
    "no common key": (csv(columns("t"), columns("step")), EST, "truth.csv: column 'step' is missing"),
    "text": (
        csv(lambda e: e.astype({"x": object}).assign(x="one")),
        EST,
        "est.csv, line 2: column 'x': not a number (one)",
    ),
    "fraction of a step": (
        csv(set_cell(4, "step", 4.5)),
        EST,
        "est.csv, line 6: column 'step': not a whole number (4.5)",
    ),
    "NaN step": (csv(set_cell(4, "step", np.nan)), EST, "est.csv, line 6: column 'step': not a finite number"),
    "NaN truth": (csv(None, set_cell(4, "y", np.nan)), EST, "truth.csv, line 6: column 'y': not a finite number"),
    "asymmetric": (
        csv(lambda e: e.assign(P_y_x=e["P_xy"] + 0.01)),
        EST,
        "est.csv, line 2: the covariance is not symmetric",
    ),
    "row twice": (csv(twice), EST, "est.csv, line 17: step 4 of run 0 is duplicated"),
    "runs without run": (csv(columns("run")), EST, "is duplicated; several runs need a column 'run'"),
    "time runs back": (
        csv(lambda e: e.drop(columns=["run", "step"]), columns("step")),
        EST,
        "est.csv, line 7: t 0.1 is less than the one",
    ),
    "run without truth": (csv(None, lambda t: t[t["run"] < 2]), EST, "truth.csv: holds no run 2"),
    "no common step": (
        csv(None, lambda t: t.assign(step=t["step"] + 99)),
        EST,
        "no step of run 0 (1 to 5) is in truth.csv (100",
    ),
    "shifted steps": (
        csv(None, lambda t: t.assign(t=t["t"] + 0.1)),
        EST,
        "est.csv, line 2: t is 0.1, but 0.2 in the same step",
    ),
    "covariance zero": (
        csv(lambda e: e.assign(**dict.fromkeys(POSE_COLUMNS, 0.0))),
        EST,
        "the covariance is zero in every step",
    ),
    "covariance singular": (
        csv(lambda e: e.assign(P_hh=0.0, P_xh=0.0, P_yh=0.0)),
        EST,
        "singular in every step (variance zero: heading)",
    ),
    "unknown convention": (
        csv(),
        (*EST, "--error", "se2"),
        "--error se2: must be one of so2, left, right, vector, so3, so3-body",
    ),
    "spatial convention": (csv(), (*EST, "--error", "so3"), "--error so3: for x, y, heading it is one of so2"),
    "convention of a vector": (csv(), (*EST, "--state", "x,y", "--error", "left"), "needs the states x,y,heading"),
    "covariance of a table": (csv(), (*EST, "--covariance", "truth.csv"), "--covariance: does not go with est.csv"),
    "max-dt without time": (csv(columns("t")), (*EST, "--max-dt", "1"), "--max-dt: needs a column t"),
    "negative max-dt": (csv(), (*EST, "--max-dt", "-1"), "--max-dt -1: must be 0 or more"),
    "confidence": (csv(), (*EST, "--confidence", "1.5"), "confidence must lie between 0 and 1"),
    "cut Parquet": (
        lambda at: (at / "est.parquet").write_bytes(b"PAR1"),
        ("est.parquet",),
        "est.parquet: cannot be read as Parquet",
    ),
    "TUM without truth": (text(), ("t.txt", "--covariance", "P.txt"), "a trajectory needs --truth"),
    "TUM without covariance": (text(), LINE[:3], "t.txt: holds no covariance; give --covariance FILE"),
    "TUM too few columns": (text(t=TUM + "0.3 1 2\n"), LINE, "t.txt, line 4: has 3 columns"),
    "TUM not a number": (text(t=TUM.replace("0.1 1", "0.1 one")), LINE, "t.txt, line 2: not a number in '0.1 one"),
    "TUM quaternion": (
        text(t=TUM + "# c\n0.3 1 2 3 0.5 0 0 1\n"),
        LINE,
        "t.txt, line 5: the quaternion has length 1.118",
    ),
    "TUM timestamp twice": (text(t=TUM + "0.2 0 0 0 0 0 0 1\n"), LINE, "t.txt, line 4: timestamp 0.2 is duplicated"),
    "TUM back in time": (
        text(truth=TUM + "0.1 0 0 0 0 0 0 1\n"),
        LINE,
        "truth.txt, line 4: timestamp 0.1 is less than",
    ),
    "TUM NaN timestamp": (text(t=TUM + "nan 0 0 0 0 0 0 1\n"), LINE, "t.txt, line 4: the timestamp is not finite"),
    "TUM no overlap": (
        text(truth=TUM.replace("0.", "9.")),
        LINE,
        "no estimate has a truth within 0.01 s (--max-dt): t is 0 to 0.2",
    ),
    "TUM no covariance in time": (
        text(P=P36.replace("\n0.", "\n9.").replace("0.0 1.0", "9.0 1.0", 1)),
        LINE,
        "has a covariance within",
    ),
    "TUM empty": (text(t="# nothing\n"), LINE, "t.txt: is empty"),
    "TUM covariance of 9": (
        text(P="0.0 1 0 0 0 1 0 0 0 1\n"),
        LINE,
        "P.txt, line 1: has 10 columns; should be t and 36 numbers",
    ),
    "TUM asymmetric": (
        text(P=P36.replace("0.1 1.0 0.0", "0.1 1.0 0.5")),
        LINE,
        "P.txt, line 2: the covariance is not symmetric",
    ),
    "TUM convention": (text(), (*LINE, "--error", "so2"), "--error so2: for a trajectory in space it is one of so3"),
    "TUM state": (text(), (*LINE, "--state", "x,y"), "--state: does not go with t.txt"),
    "empty folder": (
        lambda at: (at / "d").mkdir(),
        ("d", "--truth", "d"),
        "d: holds no .txt or .tum file, no table and no manifest.json",
    ),
    "folder of nothing": (lambda at: (at / "d").mkdir(), ("d",), "holds no results of"),
    "truth of another run": (
        lambda at: [(text()(at)), (at / "d").mkdir(), (at / "e").mkdir(), (at / "d/a.txt").write_text(TUM)],
        ("d", "--truth", "e", "--covariance", "e"),
        "or table, for d/a.txt; files of the two folders are paired by name",
    ),
    "one covariance of many runs": (
        lambda at: [(text()(at)), (at / "d").mkdir(), (at / "d/a.txt").write_text(TUM)],
        ("d", "--truth", "truth.txt", "--covariance", "P.txt"),
        "--covariance P.txt: must be a folder like d",
    ),
    "npz keys": (npz(errors=ERRORS), ("a.npz",), "a.npz: needs errors and covariances; or"),
    "npz unknown key": (npz(errors=ERRORS, covariances=MATRICES, noise=1), ("a.npz",), "key 'noise' does not go with"),
    "truth values with gaps": (
        csv(lambda table: table.assign(P_xx=[np.nan] * 3 + [False] * 12)),
        EST,
        "est.csv, line 5: column 'P_xx': a truth value or a date",
    ),
    "truth values of the truth": (csv(None, lambda table: table.assign(x=False)), EST, "truth.csv, line 2: column 'x'"),
    "name of two lines": (
        lambda at: poses()[0].assign(filter="a\n::error::b").to_parquet(at / "est.parquet"),
        ("est.parquet", "--truth", "est.parquet"),
        r"est.parquet: column 'filter': the name 'a\n::error::b' has a control character; rename it",
    ),
    "file of two lines": (
        lambda at: write(at)[0].rename(at / "est\x1b[2J.csv"),
        ("est\x1b[2J.csv", "--truth", "truth.csv"),
        r"file: the name 'est\x1b[2J.csv' has a control character",
    ),
    "dates": (
        lambda at: poses()[0].assign(x=pd.Timestamp("2024-01-01 00:00:07")).to_parquet(at / "est.parquet"),
        ("est.parquet", "--truth", "est.parquet"),
        "est.parquet, row 0: column 'x': a truth value or a date, which is to be written as a number (2024-01-01",
    ),
    "npz symmetry": (
        npz(errors=ERRORS, covariances=np.tile(ASYMMETRIC, (2, 3, 1, 1))),
        ("a.npz",),
        "a.npz, run 0, step 1: the covariance is not symmetric",
    ),
    "npz convention": (
        npz(errors=ERRORS, covariances=MATRICES),
        ("a.npz", "--error", "left"),
        "whose convention is settled",
    ),
    "npz objects": (
        npz(errors=np.array(["a"]), covariances=MATRICES),
        ("a.npz",),
        "key 'errors' holds <U1, not numbers",
    ),
    "npz truth": (
        npz(errors=ERRORS, covariances=MATRICES),
        ("a.npz", "--truth", "t.csv"),
        "--truth: does not go with a.npz, an archive; it has a key 'truth' in its place",
    ),
    "npz ragged": (
        npz(errors=np.array([ERRORS[0], ERRORS[1, :2]], dtype=object), covariances=MATRICES),
        ("a.npz",),
        "a.npz: key 'errors' holds Python objects, as of runs of different lengths; pad them with NaN",
    ),
    # options
    "false alarm and confidence": (csv(), (*EST, "--false-alarm", "0.01", "--confidence", "0.9"), "give one of them"),
    "detect of 1": (csv(), (*EST, "--detect", "1"), "detect must"),
    "fail on what": (csv(), (*EST, "--fail-on", "biased"), "--fail-on must be 'inconsistent', got 'biased'"),
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
    "a run twice": (doubled, RUNS, "are identical; remove the duplicate"),
    "a run in two files": (both_suffixes, RUNS, "est: holds the run '0' twice, as .txt and .tum"),
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
    "results and a convention": (
        lambda at: ((at / "out").mkdir(), (at / "out/manifest.json").write_text("{}")),
        ("out", "--error", "so2"),
        "consistency: --error: does not go with out, a folder of 'consistency run'\n",
    ),
    # OpenVINS and KITTI
    "states with a matrix": (
        lambda at: (write_states(at), text()(at)),
        (*STATES[:4], "P.txt"),
        "P.txt, line 1: has 37 columns",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_input_is_refused_in_one_line(case, tmp_path, monkeypatch, capsys):
    make, arguments, expected = WRONG[case]
    work = tmp_path / "work"
    work.mkdir()
    make(work)
    monkeypatch.chdir(work)
    before = sorted(path.name for path in work.iterdir())
    err = refused(capsys, "analyse", *arguments)
    assert expected in err
    assert len(err) < 700
    assert before == sorted(path.name for path in work.iterdir())  # nothing is half written
