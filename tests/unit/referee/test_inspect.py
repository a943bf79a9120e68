"""What a file holds, and the command line that judges it, for a file of every kind that is read."""

import json
import shlex
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from command import consistency, refused
from draws import autoregression
from drives import write_drive, write_states
from flight import Flight
from programs import write_tables
from scipy.io import savemat
from test_dataflash import flight
from test_fixes import PLACE, STEPS, solution

import consistency as cs
from consistency.referee.diagnostics.record import Errors, Record
from consistency.referee.errors import InputError
from consistency.referee.readers.formats.kitti_files import read_drive
from consistency.referee.readers.options import make_reading
from consistency.referee.verdicts.inspect_sources import _command, _is_of_rows

RUNS, ROWS = 6, 40


def poses(rng, rows=ROWS):
    """A winding true path at 10 Hz, and estimates that err by 0.1 m and 0.05 rad, (rows, 3) both."""
    k = np.arange(rows)
    truth = np.column_stack([0.2 * k, np.sin(0.3 * k), 0.5 * np.sin(0.1 * k)])
    return truth, truth - rng.normal(size=(rows, 3)) * [0.1, 0.1, 0.05]


def table(rng, truth=False, stated=True):
    """Rows of a table of runs; covariances grow a little from row to row."""
    frames = []
    for run in range(RUNS):
        true, own = poses(rng)
        frame = pd.DataFrame(own, columns=["x", "y", "heading"])
        frame.insert(0, "t", 0.1 * np.arange(ROWS))
        frame.insert(0, "run", run)
        if stated:
            grown = 1.0 + 1e-3 * np.arange(ROWS)
            frame = frame.assign(P_xx=0.01 * grown, P_xy=0.0, P_xh=0.0, P_yy=0.01, P_yh=0.0, P_hh=0.0025)
        if truth:
            frame[["true_x", "true_y", "true_heading"]] = true
        frames.append(frame)
    return pd.concat(frames, ignore_index=True)


def truth_table(rng):
    frame = table(rng, truth=True, stated=False)
    frame[["x", "y", "heading"]] = frame[["true_x", "true_y", "true_heading"]]
    return frame[["run", "t", "x", "y", "heading"]]


def tum(rng, stated=True):
    """Lines of a trajectory and of its truth, in the plane z = 0."""
    lines = []
    for at in poses(rng)[::-1]:
        half = 0.5 * at[:, 2]
        zero = np.zeros(ROWS)
        lines.append(np.column_stack([0.1 * np.arange(ROWS), at[:, :2], zero, zero, zero, np.sin(half), np.cos(half)]))
    own, true = lines
    if stated:
        P = np.diag([0.01, 0.01, 1e-4, 1e-4, 1e-4, 0.0025]).ravel()
        own = np.hstack([own, np.tile(P, (ROWS, 1))])
    return own, true


def csv_beside(folder, rng):
    table(rng).to_csv(folder / "est.csv", index=False)
    truth_table(rng).to_csv(folder / "est_groundtruth.csv", index=False)
    table(rng).to_csv(folder / "truth_of_another.csv", index=False)
    return folder / "est.csv"


def csv_with_truth(folder, rng):
    table(rng, truth=True).assign(n_matches=rng.integers(5, 50, RUNS * ROWS)).to_csv(folder / "est.csv", index=False)
    return folder / "est.csv"


def parquet(folder, rng):
    table(rng).to_parquet(folder / "est.parquet", index=False)
    truth_table(rng).to_parquet(folder / "truth.parquet", index=False)
    return folder / "est.parquet"


def json_lines(folder, rng):
    table(rng, truth=True).to_json(folder / "est.jsonl", orient="records", lines=True)
    return folder / "est.jsonl"


def another_state(folder, rng):
    true = rng.normal(size=(ROWS, 2))
    columns = {"depth": true[:, 0] + 0.1, "speed": true[:, 1], "sigma_depth": 0.2, "sigma_speed": 0.1}
    columns |= {"mode": 1.0, "true_mode": 1.0}  # without a covariance
    columns |= {"true_depth": true[:, 0], "true_speed": true[:, 1] + 0.05, "step": np.arange(1, ROWS + 1)}
    pd.DataFrame(columns).to_csv(folder / "my est.csv", index=False)
    return folder / "my est.csv"


def arrays(folder, rng):
    errors = 0.1 * rng.normal(size=(RUNS, ROWS, 2))
    np.savez(folder / "est.npz", errors=errors, covariances=np.tile(0.01 * np.eye(2), (RUNS, ROWS, 1, 1)))
    return folder / "est.npz"


def matlab(folder, rng):
    errors = 0.1 * rng.normal(size=(RUNS, ROWS, 2))
    savemat(folder / "est.mat", {"errors": errors, "covariances": np.tile(0.01 * np.eye(2), (RUNS, ROWS, 1, 1))})
    return folder / "est.mat"


def nees(folder, rng):
    np.savez(folder / "nees.npz", nees=rng.chisquare(3, (RUNS, ROWS)), dof=3)
    return folder / "nees.npz"


def trajectory(folder, rng):
    own, true = tum(rng)
    np.savetxt(folder / "est.tum", own)
    np.savetxt(folder / "gt.tum", true)
    return folder / "est.tum"


def trajectory_and_covariance(folder, rng):
    own, true = tum(rng)
    np.savetxt(folder / "est.txt", own[:, :8])
    np.savetxt(folder / "est_cov.txt", np.delete(own, range(1, 8), axis=1))
    np.savetxt(folder / "truth.txt", true)
    return folder / "est.txt"


def folder_of_trajectories(folder, rng):
    for name in ("est", "truth"):
        (folder / name).mkdir()
    for run in range(3):
        own, true = tum(rng)
        np.savetxt(folder / "est" / f"{run}.txt", own)
        np.savetxt(folder / "truth" / f"{run}.txt", true)
    return folder / "est"


def folder_of_tables(folder, rng):
    write_tables(folder, RUNS)
    return folder / "tables"


def states(folder, rng):
    write_states(folder)
    return folder / "state_estimate.txt"


def drive(folder, rng):
    lines = read_drive(write_drive(folder / "0001")).values
    lines[:, 1:4] += 0.01 * rng.normal(size=(len(lines), 3))
    np.savetxt(folder / "est.tum", np.column_stack([lines, np.tile(1e-4 * np.eye(6).ravel(), (len(lines), 1))]))
    return folder / "est.tum"


def satellites(folder, rng):
    place = PLACE + np.column_stack([np.linspace(0, 1e-3, STEPS), np.zeros(STEPS), np.zeros(STEPS)])
    P = np.tile(np.eye(3), (STEPS, 1, 1))
    solution(folder / "rover_truth.pos", place, 1e-4 * P)
    return solution(folder / "rover.pos", place + 1e-6 * rng.normal(size=(STEPS, 3)), P)


def px4(folder, rng):
    log = Flight()
    for k in range(60):
        log.both(10**6 + 10**4 * k, {"baro_vpos": (rng.normal(), 1.0), "gps_hpos": (rng.normal(size=2), np.ones(2))})
    log.write(folder / "flight.ulg")
    return folder / "flight.ulg"


def innovations(folder, rng):
    v = rng.normal(size=200)
    pd.DataFrame({"t": 0.1 * np.arange(200), "innovation": v, "innovation_variance": 1.0}).to_csv(
        folder / "log.csv", index=False
    )
    return folder / "log.csv"


def nis_of_runs(folder, rng):
    run, step = np.repeat([0, 1], ROWS), np.tile(np.arange(ROWS), 2)
    pd.DataFrame({"run": run, "step": step, "nis": rng.chisquare(2, 2 * ROWS), "nis_dof": 2}).to_csv(
        folder / "nis.csv", index=False
    )
    return folder / "nis.csv"


KINDS = (
    csv_beside, csv_with_truth, parquet, json_lines, another_state, arrays, matlab, nees, trajectory,
    trajectory_and_covariance, folder_of_trajectories, folder_of_tables, states, drive, satellites, px4, innovations,
    nis_of_runs,
)  # fmt: skip


def run_printed(capsys, path, *options):
    """What an inspection prints, and what the command line prints that it ends with."""
    out, _ = consistency(capsys, "inspect", path, *options)
    program, *words = shlex.split(out.splitlines()[-1])
    assert program == "consistency"
    assert words[1] == str(path)
    return out, consistency(capsys, *words)[0]


@pytest.mark.parametrize("write", KINDS)
def test_the_printed_command_line_judges_a_file_of_every_kind(write, tmp_path, capsys):
    """Whatever the verdict; the draws of each call are others."""
    out, judged = run_printed(capsys, write(tmp_path, np.random.default_rng()))
    assert "rows  " in out or "innovations  " in out
    assert "verdict" in judged or "alarm" in judged


@pytest.mark.parametrize("write, options", [
    (csv_beside, {"truth"}), (csv_with_truth, set()), (another_state, {"state"}), (trajectory, {"truth"}),
    (trajectory_and_covariance, {"truth", "covariance"}), (folder_of_tables, set()), (drive, {"truth"}),
])  # fmt: skip
def test_the_options_that_were_found_read_the_file_in_python(write, options, tmp_path):
    path = write(tmp_path, np.random.default_rng(1))
    found = cs.inspect(path)
    assert set(found.arguments) == options
    assert {name for name, _ in found.options} == {f"--{name}" for name in options}
    record = cs.read(path, **found.arguments)
    assert record.errors.error is not None
    assert found.command in str(found)


def test_options_that_are_known_are_kept(tmp_path, capsys):
    path = csv_beside(tmp_path, np.random.default_rng(1))
    other = tmp_path / "truth_of_another.csv"
    out, _ = run_printed(capsys, path, "--truth", other, "--max-dt", "0.02")
    assert out.splitlines()[-1].endswith(f"--truth {other} --max-dt 0.02")
    assert "--truth  called" not in out
    with pytest.raises(InputError, match="thruth"):
        cs.inspect(path, thruth=other)


def test_the_truth_of_the_most_similar_name_is_taken(tmp_path):
    path = csv_beside(tmp_path, np.random.default_rng(1))
    assert cs.inspect(path).arguments == {"truth": tmp_path / "est_groundtruth.csv"}


def test_a_truth_beside_is_preferred_to_innovations(tmp_path):
    rng = np.random.default_rng(1)
    table(rng).assign(nis=1.0, nis_dof=1).to_csv(tmp_path / "est.csv", index=False)
    assert "without which" in str(cs.inspect(tmp_path / "est.csv"))
    truth_table(rng).to_csv(tmp_path / "truth.csv", index=False)
    assert cs.inspect(tmp_path / "est.csv").arguments == {"truth": tmp_path / "truth.csv"}


def test_clocks_that_differ_are_found_and_added(tmp_path):
    rng = np.random.default_rng(3)
    t = 0.05 * np.arange(400)
    for name, late in (("est", 0.2), ("truth", 0.0)):
        x = np.column_stack([np.sin(0.7 * (t + late)), np.cos(0.4 * (t + late)), 0.5 * np.sin(t + late)])
        own = pd.DataFrame(x + (name == "est") * rng.normal(size=x.shape) * 0.02, columns=["x", "y", "heading"])
        own.assign(t=t, P_xx=4e-4, P_xy=0.0, P_xh=0.0, P_yy=4e-4, P_yh=0.0, P_hh=4e-4).to_csv(
            tmp_path / f"{name}.csv", index=False
        )
    found = cs.inspect(tmp_path / "est.csv")
    assert found.arguments["time_offset"] == pytest.approx(0.2, abs=0.01)
    assert "clocks" in dict(found.options)["--time-offset"]


@pytest.mark.parametrize("drifts, line", [(False, "correct {} --independent"), (True, "fit-covariance {} --span 1m")])
def test_poses_without_covariances_get_the_command_that_fits_them(tmp_path, capsys, drifts, line):
    rng = np.random.default_rng(1)
    k = np.arange(300)
    (tmp_path / "est").mkdir()
    (tmp_path / "true").mkdir()
    for run in range(4):
        steps = rng.normal(size=(300, 3)) * [0.02, 0.02, 0.004]
        e = steps.cumsum(axis=0) if drifts else steps
        heading = 0.02 * k + run
        at = np.column_stack([np.cumsum(0.3 * np.cos(heading)), np.cumsum(0.3 * np.sin(heading)), heading])
        for folder, pose in (("true", at), ("est", at - e)):
            half = 0.5 * pose[:, 2:]
            lines = [0.1 * k[:, None], pose[:, :2], np.zeros((300, 3)), np.sin(half), np.cos(half)]
            np.savetxt(tmp_path / folder / f"{run}.txt", np.hstack(lines))
    words = (tmp_path / "est", "--truth", tmp_path / "true")
    out, _ = consistency(capsys, "inspect", *words)
    assert out.splitlines()[-1] == "  consistency " + line.format(" ".join(map(str, words)))
    assert "none is stated" in out
    if not drifts:
        consistency(capsys, *shlex.split(out.splitlines()[-1])[1:])  # runs as it stands
        assert "consistency fit-covariance" in out  # what drives take is named, too


@pytest.mark.parametrize("rows", [30, 200, 1000])
@pytest.mark.parametrize("components", [1, 6])
def test_independent_rows_are_told_at_a_stated_rate(rows, components):
    """Of 200 files of independent rows 1 % may be missed, and 13 are by chance with 1e-7; drives are not told so."""
    rng = np.random.default_rng([rows, components])
    sizes = np.exp(np.arange(rows) // (rows // 3))[None, :, None]  # near tags, then far ones

    def told(phi, sizes=1.0, rows=rows):
        """How many of 200 runs whose neighbours are correlated by ``phi``; 1 is a constant."""
        errors = sizes * autoregression(rng, 200, rows, components, phi)
        return sum(_is_of_rows(Record("e", Errors(run[None]))) for run in errors)

    assert told(0.0) >= 188
    assert told(0.0, sizes) >= 188
    assert told(1.0) == 0
    most = 40 if rows == 30 else 0  # of 30 rows with one component 7 % are not told: 40 by chance with 1e-7
    assert told(0.9) <= most
    assert told(0.99) <= most
    assert told(0.0, rows=29) == 0


def test_rows_of_several_runs_and_unknown_ones_are_told():
    rng = np.random.default_rng(3)
    e = rng.standard_normal((40, 5, 2)) + 9.0 * rng.standard_normal((40, 1, 2))
    e[::7, 2] = np.nan
    assert _is_of_rows(Record("e", Errors(e)))
    e[..., 1] = e[:, :1, 1] + np.arange(5)
    assert not _is_of_rows(Record("e", Errors(e)))


def test_covariances_that_are_no_filters_are_named(tmp_path):
    own, true = tum(np.random.default_rng(1))
    own[:, 8::7] = [0.01, 0.01, 1e3, 1e-4, 1e-4, 0.0025]
    true[:, 4:] = [0.0, 0.0, 0.0, 1.0]
    np.savetxt(tmp_path / "est.tum", own)
    np.savetxt(tmp_path / "truth.tum", true)
    text = str(cs.inspect(tmp_path / "est.tum"))
    assert "constant: x, y, z, roll, pitch, yaw" in text
    assert "the same in every row: a number that was set once" in text
    assert "deviation of z is 316 times that of " in text
    assert "orientation of the truth is the same in every row" in text
    own[0, 8::7] = [0.0, 0.01, 1e7, 1e-4, 1e-4, 0.0025]
    own[:, 8] = 0.0
    own[:, 8 + 14] = 1e7
    own[5, 9] = own[5, 14] = 0.5
    np.savetxt(tmp_path / "est.tum", own)
    facts = dict(cs.inspect(tmp_path / "est.tum").facts)
    assert "0 throughout: x" in facts["covariance"]
    assert "huge, so not known: z" in facts["covariance"]


def test_columns_that_make_groups_are_named(tmp_path, capsys):
    path = csv_with_truth(tmp_path, np.random.default_rng(1))
    out, _ = consistency(capsys, "inspect", path)
    assert "--by n_matches says where" in out
    out, _ = consistency(capsys, "analyse", path, "--by", "n_matches")
    assert "n_matches" in out


def test_test_ratios_of_a_flight(tmp_path, capsys):
    flight(tmp_path / "flight.bin", {"SH": [0.3] * 40, "SP": [0.1] * 40})
    out, shown = run_printed(capsys, tmp_path / "flight.bin")
    assert "nothing is judged" in out
    assert "no verdict" in shown


def broken(folder):
    """Paths that nothing judges, and what is said of each."""
    (folder / "alone").mkdir()
    (folder / "empty").mkdir()
    own, _ = tum(np.random.default_rng(1))
    np.savetxt(folder / "alone" / "est.tum", own)
    np.savetxt(folder / "alone" / "truth.tum", own[:, :5])
    (folder / "empty.csv").write_text("")
    (folder / "words.csv").write_text("a,b\nhello,world\n")
    (folder / "notes.docx").write_text("notes")
    (folder / "junk.npz").write_bytes(b"\0" * 100)
    (folder / "flight.ulg").write_bytes(b"\0" * 100)
    (folder / "base.json").write_text("{}")
    table(np.random.default_rng(1), stated=False).to_csv(folder / "odometry.csv", index=False)
    return (
        ("alone/est.tum", "needs --truth"), ("alone/truth.tum", "has 5 columns"), ("empty", "holds no"),
        ("empty.csv", "is empty"), ("words.csv", "--state A,B"), ("notes.docx", "unknown kind"),
        ("junk.npz", "archive"), ("flight.ulg", "damaged"), ("base.json", "compare NEW"),
        ("odometry.csv", "needs --truth"), ("gone.csv", "no such file"),
    )  # fmt: skip


@pytest.mark.parametrize("which", range(11))
def test_what_is_missing_is_said(which, tmp_path, capsys):
    name, expected = broken(tmp_path)[which]
    out, err = consistency(capsys, "inspect", tmp_path / name, status=2)
    assert expected in err
    assert err.count("\n") == 1
    assert "consistency analyse" not in out


STORED = (
    ("results", "results of 'consistency run'", "consistency analyse {}"),
    ("findings", "findings of 'consistency reproduce'", "consistency report {} --html report.html"),
    ("sweep", "sweep over a grid of worlds", "consistency sweep {}"),
    ("cell", "one world of a sweep", "consistency sweep {}/../.."),
    ("correction", "correction of 'consistency correct'", "consistency inspect {}/held-out"),
)


@pytest.mark.parametrize("kind, what, line", STORED)
def test_a_folder_of_the_bench_names_the_command_that_reads_it(kind, what, line, tmp_path, capsys):
    manifest = {"schema_version": 1, "kind": kind, "command": "consistency it", "filters": ["a", "b"], "runs": 7}
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    found = cs.inspect(tmp_path)
    assert (found.kind, found.command) == (what, line.format(tmp_path))
    assert dict(found.facts) == {"written by": "consistency it", "filters": "a, b", "runs": "7"}
    out, _ = consistency(capsys, "inspect", tmp_path, status=0)
    assert ("To judge it:" if kind == "results" else "To read it:") in out


@pytest.mark.parametrize(
    "kind, said",
    [("verdict", "holds no estimates; "), ("log", "consistency run --log "), ("new", "holds no estimates")],
)
def test_a_folder_that_no_command_judges_says_what_to_do(kind, said, tmp_path, capsys):
    (tmp_path / "manifest.json").write_text(json.dumps({"schema_version": 1, "kind": kind}))
    out, err = consistency(capsys, "inspect", tmp_path, status=2)
    assert said in err
    assert "To " not in out


def test_a_folder_of_a_page_alone(tmp_path, capsys):
    (tmp_path / "report.html").write_text("")
    assert "holds no estimates" in consistency(capsys, "inspect", tmp_path, status=2)[1]
    (tmp_path / "report.html").unlink()
    assert "no trajectories" in consistency(capsys, "inspect", tmp_path, status=2)[1]


def test_a_run_of_a_study_names_its_study(tmp_path):
    run = tmp_path / "study" / "runs" / "0003"
    run.mkdir(parents=True)
    frame = table(np.random.default_rng(1), truth=True)
    frame[frame["run"] == 0].drop(columns="run").to_csv(run / "est.csv", index=False)
    data = {"kind": "run of a program", "run": 3, "values": {}, "failure": None, "seconds": 1.0}
    (run / "run.json").write_text(json.dumps(data))
    assert any(f"consistency analyse {tmp_path / 'study'} judges all" in each for each in cs.inspect(run).findings)


def test_facts_are_shown_where_the_truth_is_missing(tmp_path):
    own, _ = tum(np.random.default_rng(1))
    np.savetxt(tmp_path / "est.tum", own)
    found = cs.inspect(tmp_path / "est.tum")
    assert found.command == ""
    assert "Missing: " in str(found)
    assert {"rows", "covariance"} <= dict(found.facts).keys()
    assert "truth" not in dict(found.facts)


def test_a_truth_is_known_by_its_name(tmp_path):
    path = csv_beside(tmp_path, np.random.default_rng(1))
    found = cs.inspect(path.with_name("est_groundtruth.csv"))
    assert found.command == ""
    assert "by its name it is the truth" in str(found)


def test_a_refusal_names_an_inspection_that_would_say_more(tmp_path, capsys):
    path = trajectory_and_covariance(tmp_path, np.random.default_rng(1))
    assert refused(capsys, "analyse", path).endswith(f"; see: consistency inspect {path}\n")
    assert "inspect" not in refused(
        capsys, "analyse", path, "--truth", tmp_path / "gone.txt", "--covariance", tmp_path / "est_cov.txt"
    )
    (tmp_path / "only").mkdir()
    shutil.move(path, tmp_path / "only")
    assert "inspect" not in refused(capsys, "analyse", tmp_path / "only" / "est.txt")


def test_a_command_line_has_every_kind_of_option():
    reading = make_reading(axes=["x", "y"], relative="2", motions=True, columns={"x": "px", "y": "py"})
    assert shlex.split(_command("analyse", Path("my est"), reading, ("--bins", "3"))) == [
        "consistency", "analyse", "my est", "--axes", "x,y", "--relative", "2", "--motions", "--columns", "x=px,y=py",
        "--bins", "3",
    ]  # fmt: skip


def test_json_is_for_programs(tmp_path, capsys):
    path = csv_beside(tmp_path, np.random.default_rng(1))
    data = json.loads(consistency(capsys, "inspect", path, "--json")[0])
    assert data["kind"] == "table"
    assert data["command"].startswith("consistency analyse ")


class TestBags:
    """Bags of both kinds, and folders of them; topics are told by their types and names."""

    @pytest.mark.parametrize("ros", [1, 2])
    def test_topics_are_chosen_and_described(self, ros, tmp_path, capsys):
        pytest.importorskip("rosbags")
        from bag import write
        from test_bags import Drive

        bag = write(tmp_path / ("drive.bag" if ros == 1 else "drive"), ros, "pose", Drive())
        out, judged = run_printed(capsys, bag)
        assert "/vicon  geometry_msgs/msg/PoseStamped" in out
        assert out.splitlines()[-1].endswith("--topic /pose --truth-topic /vicon")
        assert "--by" not in out  # poses have no twist
        assert "verdict" in judged

    def test_a_folder_of_bags_with_a_twist(self, tmp_path, capsys):
        pytest.importorskip("rosbags")
        from bag import write
        from test_bags import Drive

        (tmp_path / "bags").mkdir()
        for run in range(2):
            drive = Drive(run)
            drive.twist = np.abs(np.random.default_rng(run).normal(size=(len(drive.t), 6)))
            write(tmp_path / "bags" / str(run), 2, "odometry", drive)
        out, err = consistency(capsys, "inspect", tmp_path / "bags", status=2)
        assert "/odom  nav_msgs/msg/Odometry, 150 messages, 9.88 Hz" in out
        assert "--truth-topic" in err
        assert "/tf" in err
        out, judged = run_printed(capsys, tmp_path / "bags", "--truth-topic", "map:body")
        assert "--by turn_rate says where" in out
        assert "2 runs of 150 rows" in out
        assert "verdict" in judged


# --- a state of one's own ------------------------------------------------------------------------------


def navigation(folder, rng, run="drive", restarts=False):
    """A table of four drives with variances, components that nobody estimates, and its truth beside it."""
    names = ["px", "py", "yaw", "roll", "pitch"]
    est = [",".join([run, "time", *names, *(f"var_{name}" for name in names)])]
    true = [",".join([run, "time", *names])]
    for drive in range(4):
        for k in range(12):
            t = 0.5 * k + (0.0 if restarts else 1000.0 * drive)
            state = np.array([k, 2.0 * k, 0.1 * k, 0.0, 0.0])
            error = np.append(0.1 * rng.standard_normal(3), [0.0, 0.0])
            true.append(",".join(map(str, [drive, t, *state.tolist()])))
            est.append(",".join(map(str, [drive, t, *(state - error).tolist(), 0.01, 0.01, 0.01, 1e-9, 1e-9])))
    (folder / "nav.csv").write_text("\n".join(est), encoding="utf-8")
    (folder / "reference.csv").write_text("\n".join(true), encoding="utf-8")
    return folder / "nav.csv"


@pytest.mark.parametrize("run", ["drive", "Trial", "run_id"])
@pytest.mark.parametrize("restarts", [True, False])
def test_runs_and_variances_of_other_names_are_found(run, restarts, rng, tmp_path):
    path = navigation(tmp_path, rng, run, restarts)
    found = cs.inspect(path)
    truth = tmp_path / "reference.csv"
    expected = f"consistency analyse {path} --truth {truth} --state px,py,yaw --columns run={run}"
    assert found.command == expected
    why = dict(found.options)
    assert f"'{run}' numbers the runs" in why["--columns"]
    assert "without roll, pitch, whose errors are 0 in every row" in why["--state"]
    assert len(cs.read(path, **found.arguments).run_numbers) == 4


def test_a_run_of_another_name_is_named_where_times_restart(rng, tmp_path):
    path = navigation(tmp_path, rng, restarts=True)
    with pytest.raises(cs.InputError, match=r"line 14: t 0 .* 'run'; 'drive' may be it"):
        cs.read(path, truth=tmp_path / "reference.csv", state=["px", "py", "yaw"])


def test_a_text_does_not_number_runs(rng, tmp_path):
    path = navigation(tmp_path, rng)
    for file in (path, tmp_path / "reference.csv"):
        head, *rows = file.read_text(encoding="utf-8").splitlines()
        file.write_text("\n".join([head, *(f"d{row}" for row in rows)]), encoding="utf-8")
    assert "--columns" not in cs.inspect(path).command


def test_without_a_truth_the_command_that_says_more_is_named(rng, tmp_path):
    path = navigation(tmp_path, rng)
    (tmp_path / "reference.csv").unlink()
    found = cs.inspect(path)
    assert not found.command
    assert f"consistency inspect {path} --truth FILE" in found.missing
