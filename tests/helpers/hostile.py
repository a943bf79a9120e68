"""Valid files of every kind that the bench reads, and what reads each: what the fuzzer damages."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mutations as m
import numpy as np
import pandas as pd
import tomli_w
from drives import write_drive, write_states
from edited import accept_changes
from flight import Flight
from scipy.io import savemat

import consistency as cs
from consistency.bench.store.parquet import Rejected, noted_table
from consistency.bench.store.recorded_log import read_log
from consistency.commands import main
from consistency.referee.readers.formats.kitti_files import read_drive
from consistency.referee.system import manifest_of
from consistency.referee.types import Failure

RUNS, STEPS, LANDMARKS = 9, 12, 5
FILTERS = ("one", "two")
NUMBERED = ("P11", "P12", "P13", "P22", "P23", "P33")
COLUMNS = ("run", "step", "t", "x", "y", "heading", "P_xx", "P_xy", "P_xh", "P_yy", "P_yh", "P_hh")
EUROC = """T_BS:
  cols: 4
  rows: 4
  data: [1.0, 0.0, 0.0, {x}, 0.0, 1.0, 0.0, 0.2, 0.0, 0.0, 1.0, 0.3, 0.0, 0.0, 0.0, 1.0]
resolution: [480, 320]
intrinsics: [320.0, 320.0, 240.0, 160.0]
distortion_model: radial-tangential
distortion_coefficients: [0.0, 0.0, 0.0, 0.0]
"""
OPENCV = """%YAML:1.0
---
K1: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 700., 0., 600., 0., 700., 180., 0., 0., 1. ]
K2: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 700., 0., 600., 0., 700., 180., 0., 0., 1. ]
T: !!opencv-matrix
   rows: 3
   cols: 1
   dt: d
   data: [ -0.5, 0., 0. ]
"""


@dataclass(frozen=True)
class Target:
    """A kind of input.

    Parameters
    ----------
    name : of a folder of valid files
    files : those that are damaged
    read : prints what the folder holds, or ends as the command line does
    kinds : damages that may be refused, or change what is read
    refused : damages that must be refused, by file where they are not of all
    seldom : whether a case takes so long that each kind of damage is tried once where others are three times
    """

    name: str
    files: tuple[str, ...]
    read: Callable[[Path], object]
    kinds: dict[str, m.Mutation]
    refused: dict[str, m.Mutation]
    seldom: bool = False


def _matrices(rng, *shape):
    root = 0.05 * np.eye(3) + 0.01 * rng.standard_normal((*shape, 3, 3))
    return root @ np.swapaxes(root, -1, -2)


def _world():
    changes = {"truth__steps": STEPS, "truth__landmarks__count": 60}
    return cs.load_scenario("herath2007-xyz").variant("tiny", **changes)


def write_results(folder, rng):
    """A results folder as 'consistency run' wrote it before there were digests, one run of the second filter failed."""
    P = _matrices(rng, 2, RUNS, STEPS)
    truth = np.cumsum(rng.standard_normal((RUNS, STEPS + 1, 3)) * 0.1, axis=1)
    error = (np.linalg.cholesky(P) @ rng.standard_normal((2, RUNS, STEPS, 3, 1)))[..., 0]
    nees = np.einsum("...i,...ij,...j->...", error, np.linalg.inv(P), error)
    run, step = (grid.ravel() for grid in np.meshgrid(range(RUNS), range(1, STEPS + 1), indexing="ij"))
    rows = []
    for k, name in enumerate(FILTERS):
        pose = (truth[:, 1:] - error[k]).reshape(-1, 3)
        flat = P[k].reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
        table = pd.DataFrame(np.column_stack([run, step, 0.1 * step, pose, flat, nees[k].ravel()]))
        table.columns = [*COLUMNS, "nees"]
        rows.append(table.assign(filter=name, nis=rng.chisquare(4, len(table)), nis_dof=4))
    estimates = pd.concat(rows, ignore_index=True).astype({"run": int, "step": int})
    estimates = estimates[(estimates["filter"] != "two") | (estimates["run"] != 3) | (estimates["step"] < 8)]
    places = rng.standard_normal((LANDMARKS, 3))
    landmarks = pd.DataFrame(places, columns=list("xyz")).assign(landmark=range(LANDMARKS))
    map_ = pd.concat(
        [
            landmarks.assign(filter=name, run=r, P_xx=0.01, P_xy=0.0, P_xz=0.0, P_yy=0.01, P_yz=0.0, P_zz=0.01)
            .assign(nees=rng.chisquare(3, LANDMARKS), joint_nees=rng.chisquare(3, LANDMARKS))
            for name in FILTERS for r in range(RUNS) if (name, r) != ("two", 3)
        ]
    )  # fmt: skip
    path = np.column_stack([np.repeat(range(RUNS), STEPS + 1), np.tile(range(STEPS + 1), RUNS)])
    true = pd.DataFrame(np.column_stack([path, 0.1 * path[:, 1], truth.reshape(-1, 3)]))
    true.columns = ["run", "step", "t", "x", "y", "heading"]
    failures = noted_table("failures", [Failure("two", 3, 8, "the pose covariance is not positive definite")])
    rejections = noted_table("rejections", [Rejected("two", r, 40, 4, 3, 2) for r in range(RUNS)])
    scenario = _world()
    manifest = manifest_of(
        filters=list(FILTERS), wall=0.1, complete=True, seed=0, runs=RUNS, optimal_gain=["one"], failures=1,
        scenario=scenario.model_dump(mode="json"), scenario_hash=scenario.hash,
    )  # fmt: skip
    cs.Results(estimates, failures, true, landmarks, manifest, map_, rejections).write(folder)
    accept_changes(folder)  # what is damaged is to be found by what is in the rows


def _columns(rng):
    """Estimates of two runs with their covariance and NIS."""
    rows = 2 * STEPS
    P = _matrices(rng, rows).reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
    step = np.tile(np.arange(1, STEPS + 1), 2)
    table = pd.DataFrame(
        np.column_stack([np.repeat([0, 1], STEPS), step, 0.1 * step, rng.standard_normal((rows, 3)), P])
    )
    table.columns = list(COLUMNS)
    table = table.astype({"run": int, "step": int})
    return table.assign(nis=rng.chisquare(3, rows), nis_dof=3)


def _poses(rng):
    turn = rng.standard_normal((STEPS, 4)) * 0.01 + [0, 0, 0, 1]
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    return np.column_stack([0.1 * np.arange(STEPS), rng.standard_normal((STEPS, 3)), turn])


def _images(folder, names):
    """Three grey pairs without an image library: PGM."""
    for name in names:
        (folder / name).mkdir(parents=True, exist_ok=True)
        for k in range(3):
            (folder / name / f"{k:06d}.pgm").write_bytes(b"P5 480 320 255\n" + bytes(480 * 320))


def write_all(folder, seed=1):
    """One folder for each target."""
    rng = np.random.default_rng(seed)
    write_results(folder / "results", rng)
    for name in ("table", "archive", "tum", "scenario", "sweep", "baseline", "findings", "kitti", "euroc", "opencv"):
        (folder / name).mkdir(parents=True)
    table = _columns(rng)
    truth = table[["run", "step", "t", "x", "y", "heading"]].copy()
    truth[["x", "y", "heading"]] += 0.05 * rng.standard_normal((len(truth), 3))
    for name, each in (("est", table), ("truth", truth)):
        each.to_csv(folder / "table" / f"{name}.csv", index=False)
        each.to_parquet(folder / "table" / f"{name}.parquet", index=False)
    table[table["run"] == 0][["step", "nis", "nis_dof"]].to_csv(folder / "table" / "nis.csv", index=False)
    error = 0.05 * rng.standard_normal((4, STEPS, 3))
    extra = {"nis": rng.chisquare(3, (4, STEPS)), "nis_dof": np.array(3), "t": np.arange(STEPS) * 0.1}
    np.savez(folder / "archive" / "est.npz", errors=error, covariances=_matrices(rng, 4, STEPS), **extra)
    pose = rng.standard_normal((4, STEPS, 3))
    both = {"estimates": pose, "truth": pose + error, "covariances": _matrices(rng, 4, STEPS)}
    np.savez(folder / "archive" / "pair.npz", **both, lengths=np.full(4, STEPS))
    np.savez(folder / "archive" / "members.npz", members=rng.normal(size=(4, STEPS, 5, 3)), truth=both["truth"])
    np.savez(folder / "archive" / "nees.npz", nees=rng.chisquare(3, (4, STEPS)), dof=3)
    savemat(folder / "archive" / "est.mat", {"errors": error, "covariances": _matrices(rng, 4, STEPS), **extra})
    entries = dict(zip(("P_xx", "P_xy", "P_xh", "P_yy", "P_yh", "P_hh"), NUMBERED, strict=True))
    other = table.rename(columns={"t": "time"} | entries)
    other.to_json(folder / "table" / "est.jsonl", orient="records", lines=True)
    beside = truth[["x", "y", "heading"]].add_prefix("true_")
    other.join(beside).to_csv(folder / "table" / "one.csv", index=False)
    poses = _poses(rng)
    np.savetxt(folder / "tum" / "truth.tum", poses, fmt="%.12f")
    poses[:, 1:4] += 0.01 * rng.standard_normal((STEPS, 3))
    np.savetxt(folder / "tum" / "est.tum", poses, fmt="%.12f")
    P = np.tile(np.diag(np.full(6, 1e-4)).ravel(), (STEPS, 1))
    np.savetxt(folder / "tum" / "cov.txt", np.column_stack([poses[:, 0], P]), fmt="%.12g")
    scenario = _world().model_dump(mode="json", exclude_none=True)
    scenario.pop("name")
    (folder / "scenario" / "world.toml").write_text(tomli_w.dumps(scenario), encoding="utf-8")
    (folder / "sweep" / "world.toml").write_text(tomli_w.dumps(scenario), encoding="utf-8")
    grid = {"truth.path.speed": [0.1, 0.2], "odometry": [0.5, 1.0, 2.0]}
    sweep = {"summary": "s", "base": "world.toml", "filters": ["ekf-xyz"], "rule": {"max_runs": 96}, "grid": grid}
    (folder / "sweep" / "sweep.toml").write_text(tomli_w.dumps(sweep), encoding="utf-8")
    quietly(["simulate", str(folder / "scenario" / "world.toml"), "--runs", "2", "--out", str(folder / "log")])
    quietly(
        [
            "simulate",
            str(folder / "scenario/world.toml"),
            "--runs",
            "2",
            "--format",
            "csv",
            "--out",
            str(folder / "texts"),
        ]
    )
    _write_recorded(folder)
    quietly(["baseline", str(folder / "results"), "--out", str(folder / "baseline" / "base.json")])
    entry = dict.fromkeys(("id", "source", "claim", "statistic", "published", "measured", "accept"), "x")
    entry |= {"verdict": "reproduced", "runs": 5, "seed": 0, "scenario": "s"}
    (folder / "findings" / "findings.json").write_text(json.dumps([entry]), encoding="utf-8")
    _write_cameras(folder)


def _write_recorded(folder):
    """A drive with an estimate beside it, states of a simulation, and a flight."""
    for name in ("drive", "states", "flight"):
        (folder / name).mkdir()
    lines = read_drive(write_drive(folder / "drive" / "one")).values
    P = np.tile(np.diag(np.full(6, 1e-4)).ravel(), (len(lines), 1))
    np.savetxt(folder / "drive" / "est.tum", np.column_stack([lines, P]), fmt="%.9g")
    write_states(folder / "states")
    log, rng = Flight(), np.random.default_rng(len(lines))
    for k in range(4 * STEPS):
        log.both(10**6 + 10**4 * k, {"baro_vpos": (rng.standard_normal(), 1.0)})
    log.write(folder / "flight" / "one.ulg")


def quietly(arguments):
    """Exit status of a command whose output nobody reads."""
    with contextlib.redirect_stdout(io.StringIO()):
        try:
            main(arguments)
        except SystemExit as stop:
            return int(stop.code or 0)
    return 0


def _write_cameras(folder):
    _images(folder / "kitti", ("image_0", "image_1"))
    row = "700 0 240 {x} 0 700 160 0 0 0 1 0"
    text = f"P0: {row.format(x=0)}\nP1: {row.format(x=-350)}\n"
    (folder / "kitti" / "calib.txt").write_text(text, encoding="utf-8")
    (folder / "kitti" / "times.txt").write_text("0.0\n0.1\n0.2\n", encoding="utf-8")
    poses = "".join(f"1 0 0 {k} 0 1 0 0 0 0 1 0\n" for k in range(3))
    (folder / "kitti" / "poses.txt").write_text(poses, encoding="utf-8")
    _images(folder / "opencv", ("left", "right"))
    (folder / "opencv" / "stereo.yaml").write_text(OPENCV, encoding="utf-8")
    for camera, x in (("cam0", 0.0), ("cam1", 0.11)):
        at = folder / "euroc" / "mav0" / camera
        _images(at, ("data", "data"))
        (at / "sensor.yaml").write_text(EUROC.format(x=x), encoding="utf-8")
        rows = [f"{10**18 + k * 50_000_000},{k:06d}.pgm" for k in range(3)]
        (at / "data.csv").write_text("#timestamp [ns],filename\n" + "\n".join(rows) + "\n", encoding="utf-8")
    at = folder / "euroc" / "mav0" / "state_groundtruth_estimate0"
    at.mkdir()
    rows = [f"{10**18 + k * 50_000_000},{k},0,0,1,0,0,0" for k in range(3)]
    (at / "data.csv").write_text("#t,p,p,p,qw,qx,qy,qz\n" + "\n".join(rows) + "\n", encoding="utf-8")


# --- what reads them -------------------------------------------------------------------------------


def command(*arguments):
    """The command line, with {} in the place of the folder."""
    return lambda folder: main([each.replace("{}", str(folder)) for each in arguments])


def _digest(*values):
    return hashlib.sha256(
        repr([np.asarray(v).tolist() if isinstance(v, np.ndarray) else v for v in values]).encode()
    ).hexdigest()


def _log(folder):
    log = read_log(folder)
    for trial in log.trials:
        print(trial.run, _digest(trial.start, trial.controls, trial.z, trial.landmark, trial.truth), log.belief)


def _scenario(folder):
    from consistency.bench.simulation import require_landmarks_in_view

    scenario = cs.load_scenario(folder / "world.toml")
    print(scenario.hash)
    if scenario.truth.steps * getattr(scenario.truth.landmarks, "count", 1) < 100_000:
        print(_digest(require_landmarks_in_view(scenario).trial(0, 0).z))


def _sweep(folder):
    from consistency.bench.sweeps.sweep_file import load_sweep

    print([cell.scenario.hash for cell in load_sweep(folder / "sweep.toml").cells])


def _findings(folder):
    from consistency.bench.runs.reproduce_findings import read_findings

    print(read_findings(folder))


def _cameras(calibration=None):
    def read(folder):
        from consistency.stereo.frontend.camera_truth import find_truth, read_truth
        from consistency.stereo.visual_odometry.sequence import read_sequence

        sequence = read_sequence(folder, None if calibration is None else folder / calibration)
        rig = sequence.rectification.rig
        print(sequence.t.tolist(), rig)
        if (path := find_truth(sequence)) is not None:
            print(_digest(*read_truth(path, sequence)))

    return read


RESULTS = tuple(f"{name}.parquet" for name in ("estimates", "truth", "map", "rejections", "failures", "landmarks"))
TREE, TWICE = {"tree": m.json_tree}, {"twice": m.json_twice}
TOML, LINE_TWICE = m.ANY | {"tree": m.toml_tree}, {"twice": m.toml_line_twice}
OPTIMAL = ("--innovations", "optimal")
TARGETS = (
    Target("results", ("manifest.json",), command("analyse", "{}"), m.ANY | TREE, TWICE),
    Target("results", RESULTS, command("analyse", "{}"), m.ANY | m.COLUMNS, {}),
    Target("results", RESULTS[:2], command("analyse", "{}"), {}, m.ROWS),
    Target("results", RESULTS[2:5], command("analyse", "{}"), {}, {"row_twice": m.row_twice}),
    Target("results", RESULTS[3:5], command("analyse", "{}"), {}, {"row_gone": m.row_gone, "cut_short": m.cut_short}),
    Target("results", RESULTS[:1], command("monitor", "{}", "--filter", "one", "--run", "2", *OPTIMAL),
           m.COLUMNS, m.ROWS),
    Target("results", RESULTS[:2], command("compare", "{}"), m.ANY | m.COLUMNS, m.ROWS),
    Target("log", ("controls.parquet", "observations.parquet", "truth.parquet", "landmarks.parquet"), _log,
           m.ANY | m.COLUMNS, {"row_twice": m.row_twice}),
    Target("texts", ("controls.csv", "observations.csv", "truth.csv", "landmarks.csv"), _log, m.ANY | m.TEXT, {}),
    Target("log", ("sensor.toml",), _log, TOML, LINE_TWICE),
    Target("table", ("est.csv", "truth.csv"),
           command("analyse", "{}/est.csv", "--truth", "{}/truth.csv"), m.ANY | m.TEXT, {}),
    Target("table", ("est.parquet", "truth.parquet"),
           command("analyse", "{}/est.parquet", "--truth", "{}/truth.parquet"),
           m.ANY | m.COLUMNS, {"row_twice": m.row_twice}),
    Target("table", ("one.csv",), command("analyse", "{}/one.csv"), m.ANY | m.TEXT, {}),
    Target("table", ("est.jsonl",), command("analyse", "{}/est.jsonl", "--truth", "{}/truth.csv"), m.ANY | m.TEXT, {}),
    Target("table", ("nis.csv",), command("monitor", "{}/nis.csv", *OPTIMAL), m.ANY | m.TEXT, {}),
    Target("archive", ("est.npz",), command("analyse", "{}/est.npz"), m.ANY | m.ARCHIVE, {}),
    Target("archive", ("pair.npz",), command("analyse", "{}/pair.npz"), m.ANY | m.ARCHIVE, {}),
    Target("archive", ("est.mat",), command("analyse", "{}/est.mat"), m.ANY, {}),
    Target("archive", ("nees.npz",), command("analyse", "{}/nees.npz"), m.ANY | m.ARCHIVE, {}),
    Target("archive", ("members.npz",), command("analyse", "{}/members.npz"), m.ANY | m.ARCHIVE, {}),
    Target("archive", ("est.npz",), command("analyse", "{}/est.npz", "--ensemble", "9"), m.ANY | m.ARCHIVE, {}),
    Target("table", ("est.csv",), command("analyse", "{}/est.csv", "--truth", "repeats"), m.ANY | m.TEXT, {}),
    Target("archive", ("est.npz",), command("monitor", "{}/est.npz", "--run", "1", *OPTIMAL),
           m.ANY | m.ARCHIVE, {}),
    Target("tum", ("est.tum", "truth.tum", "cov.txt"),
           command("analyse", "{}/est.tum", "--truth", "{}/truth.tum", "--covariance", "{}/cov.txt"),
           m.ANY | m.TEXT, {}),
    Target("drive", ("one/oxts/timestamps.txt", "one/oxts/data/0000000007.txt", "calib_imu_to_velo.txt"),
           command("analyse", "{}/est.tum", "--truth", "{}/one", "--body", "velodyne"), m.ANY | m.TEXT, {}),
    Target("states", ("state_estimate.txt", "state_deviation.txt"),
           command("analyse", "{}/state_estimate.txt", "--truth", "{}/state_groundtruth.txt", "--covariance",
                   "{}/state_deviation.txt", "--axes", "x,yaw"), m.ANY | m.TEXT, {}),
    Target("flight", ("one.ulg",), command("monitor", "{}/one.ulg", *OPTIMAL), m.ANY, {}),
    Target("scenario", ("world.toml",), _scenario, TOML, LINE_TWICE),
    Target("sweep", ("sweep.toml", "world.toml"), _sweep, TOML, LINE_TWICE),
    Target("baseline", ("base.json",), command("compare", "{}/base.json"), m.ANY | TREE,
           TWICE),
    Target("findings", ("findings.json",), _findings, m.ANY | TREE, TWICE),
    Target("kitti", ("calib.txt", "times.txt", "poses.txt"), _cameras(), m.ANY | m.TEXT, {}),
    Target("euroc", ("mav0/cam0/sensor.yaml", "mav0/cam1/data.csv", "mav0/state_groundtruth_estimate0/data.csv"),
           _cameras(), m.ANY | m.TEXT, {}),
    Target("opencv", ("stereo.yaml",), _cameras("stereo.yaml"), m.ANY | m.TEXT, {}),
)  # fmt: skip


def clean(folder):
    shutil.rmtree(folder, ignore_errors=True)
