"""Valid inputs of commands that work on them, for the fuzzer: results to resume, journals, maps, images, lines."""

import shutil
from unittest import mock

import hostile
import mutations as m
import numpy as np
import tomli_w
from hostile import LINE_TWICE, OPENCV, OPTIMAL, RESULTS, TOML, TREE, TWICE, Target, command, quietly

import consistency as cs
from consistency.bench.runs.results_to_records import record_of
from consistency.bench.simulation import World
from consistency.bench.store.results import open_results
from consistency.bench.sweeps.regime_map import read_regime, regime_of, write_regime
from consistency.bench.sweeps.run_sweep import CellOutcome, CellResult, CellWork, SweepFolder, runs_table
from consistency.bench.sweeps.sweep_file import load_sweep

STUDY, RUNS = ("--filter", "kf", "--jobs", "1", "--seed", "4"), 4
SIZE = (160, 120)  # px
TABLES = ("estimates", "truth", "map", "failures", "landmarks")


class Killed(BaseException):
    """What ends a process in the middle of its work; no command takes it for an error of its own."""


# --- results and journals to go on with ------------------------------------------------------------


def _write_studies(folder):
    """Two runs of four: as partial results, and in the journal of a process that was killed; and all four."""
    world = cs.load_scenario("linear-gaussian").variant("tiny", truth__steps=10)
    table = world.model_dump(mode="json", exclude_none=True)
    table.pop("name")
    for name in ("resume", "journal"):
        (folder / name).mkdir()
        (folder / name / "world.toml").write_text(tomli_w.dumps(table), encoding="utf-8")
    quietly(_run(folder / "resume", "whole", RUNS))
    quietly(_run(folder / "resume", "out", RUNS // 2))
    shutil.copytree(folder / "resume" / "whole", folder / "journal" / "whole")
    trial = World.trial

    def until_killed(self, run, seed):
        if run == RUNS // 2:
            raise Killed
        return trial(self, run, seed)

    with mock.patch.object(World, "trial", until_killed):
        try:
            quietly(_run(folder / "journal", "out", RUNS))
        except Killed:
            return
    raise AssertionError("nothing was interrupted")


def _run(folder, out, runs, *options):
    place = ["--runs", str(runs), "--out", str(folder / out)]
    return ["run", str(folder / "world.toml"), *STUDY, *place, *options]


def _resume(folder):
    """Go on; the tables must then be those of one go, whatever was damaged."""
    status = quietly(_run(folder, "out", RUNS, "--resume"))
    if status:
        raise SystemExit(status)
    for path in (folder / "whole").glob("*.parquet"):
        assert (folder / "out" / path.name).read_bytes() == path.read_bytes(), path.name


# --- maps of a sweep -------------------------------------------------------------------------------


def _write_maps(folder):
    folder.mkdir()
    grid = {"range": [2.0, 4.0], "odometry": [0.5, 1.0]}
    table = {"summary": "s", "base": "herath2007-stereo", "filters": ["ekf-uvd", "ukf-uvd"], "grid": grid}
    (folder / "sweep.toml").write_text(tomli_w.dumps(table), encoding="utf-8")
    sweep = SweepFolder(load_sweep(folder / "sweep.toml"), folder / "map")
    sweep.begin()
    numbers = (48, 0, 3.0, 2.5, 3.5, 1.0, 0.9, 1.1, 0.1, 0.01, 1.0, 20.0)
    runs = runs_table(record_of(open_results(folder.parent / "results"), "one"))
    for cell in sweep.sweep.cells:
        for name, status in zip(sweep.sweep.filters, ("consistent", "overconfident"), strict=True):
            sweep.write(CellWork(cell, name), CellOutcome(CellResult(status, status, *numbers), runs), wall=1.0)
    write_regime(regime_of(sweep), sweep.path)


def _read_map(at):
    return lambda folder: read_regime(folder / at)


# --- images ----------------------------------------------------------------------------------------


def _write_images(folder, rng):
    """Three pairs of a textured wall, seen while driving along it, and three at rest."""
    import cv2

    width, height = SIZE
    wall = cv2.GaussianBlur(rng.normal(size=(height, width + 60)), (0, 0), 1.5)
    wall = cv2.normalize(wall, None, 30, 220, cv2.NORM_MINMAX)
    calibration = OPENCV.replace("700.", "200.").replace("600.", "80.").replace("180.", "60.")
    for name, speed in (("moving", 4), ("resting", 0)):
        for side, disparity in (("left", 0), ("right", 12)):
            (folder / name / side).mkdir(parents=True)
            for k in range(3):
                view = wall[:, 20 + speed * k + disparity :][:, :width]
                noisy = view + rng.normal(size=view.shape)
                cv2.imwrite(str(folder / name / side / f"{k:06d}.png"), noisy.round().astype(np.uint8))
        (folder / name / "stereo.yaml").write_text(calibration, encoding="utf-8")


# --- what reads them -------------------------------------------------------------------------------


def _piped(folder):
    """``monitor -`` with the file as its standard input."""
    if not (folder / "nis.csv").is_file():
        raise cs.InputError("a shell would not begin")
    with (folder / "nis.csv").open(encoding="utf-8") as lines, mock.patch("sys.stdin", lines):
        command("monitor", "-", *OPTIMAL)(folder)


def write_all(folder, seed=1):
    """One folder for each target, those of ``hostile`` among them."""
    hostile.write_all(folder, seed)
    rng = np.random.default_rng(seed + 1)
    _write_studies(folder)
    _write_maps(folder / "maps")
    _write_images(folder, rng)
    scenario = cs.load_scenario("herath2007-stereo").variant("tiny", truth__steps=40)
    table = scenario.model_dump(mode="json", exclude_none=True)
    table.pop("name")
    (folder / "tracks").mkdir()
    (folder / "tracks" / "world.toml").write_text(tomli_w.dumps(table), encoding="utf-8")
    quietly(["simulate", str(folder / "tracks" / "world.toml"), "--runs", "2", "--out", str(folder / "tracks" / "log")])


PAIRS = ("left/000001.png", "right/000002.png")
KEPT = tuple(f"out/{name}.parquet" for name in TABLES[:2])
CALIBRATED = ("--calibration", "{}/stereo.yaml", "--out")
TARGETS = (
    *hostile.TARGETS,
    Target("resume", KEPT, _resume, m.ANY | m.COLUMNS, m.ROWS, seldom=True),
    Target("resume", ("out/manifest.json",), _resume, m.ANY | TREE, TWICE, seldom=True),
    Target("resume", ("world.toml",), _resume, TOML, LINE_TWICE, seldom=True),
    Target("journal", (".out.unfinished/runs.sqlite",), _resume, m.ANY, {}),
    Target("results", ("manifest.json",), command("report", "{}", "--html", "{}/r.html"), m.ANY | TREE, TWICE,
           seldom=True),
    Target("results", RESULTS, command("report", "{}", "--html", "{}/r.html"), m.ANY | m.COLUMNS, {}, seldom=True),
    Target("results", RESULTS[:1], command("baseline", "{}", "--out", "{}/base.json"), m.ANY | m.COLUMNS, m.ROWS),
    Target("table", ("nis.csv",), _piped, m.ANY | m.TEXT, {}),
    Target("maps", ("map/map.json",), _read_map("map/map.json"), m.ANY | TREE, TWICE),
    Target("maps", ("map/manifest.json",), _read_map("map"), m.ANY | TREE, TWICE),
    Target("moving", PAIRS, command("frontend", "{}", *CALIBRATED, "{}/log"), m.ANY, {}, seldom=True),
    Target("moving", ("stereo.yaml",), command("frontend", "{}", *CALIBRATED, "{}/log"), m.ANY | m.TEXT, {},
           seldom=True),
    Target("resting", PAIRS, command("characterise", "{}", "--at-rest", *CALIBRATED, "{}/s.toml"), m.ANY, {},
           seldom=True),
    Target("tracks", ("log/observations.parquet", "log/sensor.toml"),
           command("characterise", "{}/log", "--out", "{}/s.toml"), m.ANY, {}, seldom=True),
)  # fmt: skip
