"""``consistency characterise`` from the command line: files, tables, refusals. What it estimates: tests/unit."""

import json
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import consistency as cs
from consistency.bench.runs.montecarlo import simulate_log
from consistency.bench.scenario import Belief, PicturedSensor, read_table
from consistency.bench.store.recorded_log import SensorFile, read_log
from consistency.commands.app import main
from consistency.stereo.characterising.characterise import Residuals, characterise
from consistency.stereo.characterising.sensor_text import believed_sensor, measured_sensor_toml


def run(*arguments):
    """Exit status of the command line."""
    with pytest.raises(SystemExit) as stop:
        main([str(argument) for argument in arguments])
    return int(stop.value.code or 0)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    folder = tmp_path_factory.mktemp("characterise") / "log"
    scenario = cs.load_scenario("herath2007-stereo").variant("short", truth__steps=150)
    simulate_log(scenario, runs=2, seed=3, out=folder)
    return folder


def without(log, tmp_path, *names):
    """A copy of the log that lacks some tables."""
    folder = Path(shutil.copytree(log, tmp_path / "copy"))
    for name in names:
        (folder / f"{name}.parquet").unlink()
    return folder


def test_a_log_becomes_a_sensor_and_a_report(log, tmp_path, capsys):
    out, report = tmp_path / "sensor.toml", tmp_path / "report"
    assert run("characterise", log, "--out", out, "--report", report) == 0
    text = capsys.readouterr().out
    assert "u: 1.3" in text
    assert "white" in text
    assert "99 %" in text
    assert {path.name for path in report.iterdir()} == {
        "report.html", "report.pdf", "characterisation.json", "manifest.json",
    }  # fmt: skip
    data = json.loads((report / "characterisation.json").read_text())
    for name, sigma in zip("uvd", (1.34, 1.53, 0.65), strict=True):
        estimate = data["coordinates"][name]["sigma"]
        assert estimate["low"] < estimate["value"] < estimate["high"]
        assert abs(np.log(estimate["value"] / sigma)) < 0.15
    assert run("characterise", log, "--out", out) == 2
    assert "add --overwrite" in capsys.readouterr().err
    assert run("characterise", log, "--out", out, "--report", report) == 2


def test_without_landmarks_json_has_all_estimates(log, tmp_path, capsys):
    folder, out = without(log, tmp_path, "landmarks"), tmp_path / "sensor.toml"
    out.write_text("")
    assert run("characterise", folder, "--out", out, "--overwrite", "--json") == 0
    data = json.loads(capsys.readouterr().out)
    assert data["confidence"] == 0.99
    assert data["coordinates"]["u"]["offset"] is None
    assert data["sensor"]["sigma"][0] == read_table(out, SensorFile).sigma[0]


def test_the_sensor_is_believed_by_a_log_and_a_scenario(log, tmp_path):
    folder = Path(shutil.copytree(log, tmp_path / "copy"))
    before = read_log(folder)
    assert run("characterise", folder, "--out", folder / "sensor.toml", "--overwrite") == 0
    after = read_log(folder)
    assert after.belief.motion == before.belief.motion
    assert np.array_equal(after.trials[0].start, before.trials[0].start)
    assert after.belief.sensor.f == before.belief.sensor.f
    assert after.belief.sensor.sigma != before.belief.sensor.sigma
    assert np.allclose(after.belief.sensor.sigma, before.belief.sensor.sigma, rtol=0.1)
    belief = Belief(motion=after.belief.motion, sensor=read_table(folder / "sensor.toml", SensorFile).belief())
    assert belief.sensor == after.belief.sensor


def test_growth_and_bias_are_read_back_as_they_were_found(tmp_path, rng):
    n = 6_000
    ideal = rng.uniform((-160, -120, 4), (160, 120, 28), (n, 3))
    r = rng.standard_normal((n, 3)) * np.column_stack([np.ones(n), np.ones(n), ideal[:, 2] / 20.0])
    r[:, 2] += 1.0 + 0.005 * ideal[:, 0]
    sensor = PicturedSensor(model="uvd", sigma=(1.0, 1.0, 1.0), f=150.0, B=0.09, image=(320, 240))
    data = Residuals(r, ideal, np.arange(n) // 20, np.arange(n) % 20, np.zeros(n, bool))
    of = characterise(data, sensor, "here", miss=1e-6)
    path = tmp_path / "sensor.toml"
    path.write_text(measured_sensor_toml(of))
    read = read_table(path, SensorFile)
    assert read.belief() == believed_sensor(of).belief()
    assert read.motion is None
    at = read.sigma[2] * read.disparity_growth.ratio_at(of.growth.nodes)
    assert np.allclose(at, [s.value for s in of.growth.sigma], rtol=1e-3)
    assert np.allclose(at, of.growth.nodes / 20.0, rtol=0.15)
    u, v = np.array([-80.0, 80.0]), np.array([10.0, -30.0])
    assert np.allclose(read.bias.at(u, v)[:, 2], 1.0 + 0.005 * u, atol=0.35)
    rows = [line.split() for line in path.read_text().splitlines() if "±" in line]
    assert [len(row) - 1 for row in rows] == [len(of.bias.grid.u)] * len(of.bias.grid.v), "a line for each row of nodes"
    assert rows[0][1] == f"±{of.bias.half[2, 0]:.2g}"
    tomllib.loads(path.read_text())


def test_without_landmarks_the_noise_alone_is_told(log, tmp_path, capsys):
    folder = without(log, tmp_path, "landmarks")
    assert run("characterise", folder, "--out", tmp_path / "sensor.toml") == 0
    assert "Landmarks are not known" in capsys.readouterr().out
    sigma = read_table(tmp_path / "sensor.toml", SensorFile).sigma
    assert np.allclose(sigma, (1.34, 1.53, 0.65), rtol=0.15)


def test_without_truth_a_moving_robot_is_refused_and_one_at_rest_is_not(log, tmp_path, capsys):
    folder = without(log, tmp_path, "landmarks", "truth")
    out = tmp_path / "sensor.toml"
    assert run("characterise", folder, "--out", out) == 2
    assert "noise cannot be told from motion" in capsys.readouterr().err
    assert not out.exists()
    controls = pd.read_parquet(folder / "controls.parquet")
    controls[["v", "omega"]] = 0.0
    controls.to_parquet(folder / "controls.parquet", index=False)
    seen = pd.read_parquet(folder / "observations.parquet")
    rng = np.random.default_rng(0)
    place = seen.groupby("landmark")[["z0", "z1", "z2"]].transform("mean")
    place["z2"] = place["z2"] + 3.0
    seen[["z0", "z1", "z2"]] = place * 0.5 + rng.standard_normal((len(seen), 3)) * [0.3, 0.4, 0.1]
    seen.to_parquet(folder / "observations.parquet", index=False)
    assert run("characterise", folder, "--out", out) == 0
    assert np.allclose(read_table(out, SensorFile).sigma, (0.3, 0.4, 0.1), rtol=0.15)


def images(folder, left, right, sizes=((64, 48),)):
    """Grey images left1.png ..., right1.png ..., of sizes (width, height) in turns."""
    cv2 = pytest.importorskip("cv2")
    folder.mkdir()
    for side, count in (("left", left), ("right", right)):
        for number in range(1, count + 1):
            width, height = sizes[number % len(sizes)]
            cv2.imwrite(str(folder / f"{side}{number}.png"), np.full((height, width), 128, np.uint8))
    return folder


BOARD = ("--board", "9x6", "--square", "0.024")
BAD = {
    "no folder": (None, (), "no such folder"),
    "empty": ((0, 0), BOARD, "holds no images leftN and rightN"),
    "one pair": ((1, 1), BOARD, "holds 1 stereo pairs"),
    "no partner": ((6, 5), BOARD, "left6.png: has no partner"),
    "no board": ((6, 6), BOARD, "is in 0 of 6 pairs"),
    "depth of the plane": ((6, 6), ("--board", "9x6"), "--board and --square go together"),
    "board": ((6, 6), ("--board", "nine", "--square", "0.02"), "--board nine: must be two numbers"),
    "square": ((6, 6), ("--board", "9x6", "--square", "-1"), "--square -1: must be a positive"),
    "distortion": ((6, 6), (*BOARD, "--distortion", "fisheye"), "--distortion fisheye: must be one of"),
    "at rest": ((6, 6), (*BOARD, "--at-rest"), "goes neither with"),
    "no calibration": ((6, 6), ("--at-rest",), "plain images need --calibration"),
    "no truth": ((6, 6), ("--calibration", "CALIB"), "noise cannot be told from motion"),
    "one pair at rest": ((1, 1), ("--at-rest", "--calibration", "CALIB"), "holds 1 stereo pairs"),
    "grid": ((6, 6), (*BOARD, "--grid", "1x4"), "--grid 1x4: must be two numbers of at least 2"),
    "grid without a board": ((6, 6), ("--at-rest", "--grid", "5x4"), "--grid: goes with a log or with --board"),
    "seed of a board": ((6, 6), (*BOARD, "--seed", "1"), "--seed: goes with images without a board"),
}


@pytest.mark.parametrize("case", BAD)
def test_unusable_input_is_one_sentence_and_nothing_is_written(case, tmp_path, capsys):
    counts, options, message = BAD[case]
    folder = tmp_path / "images" if counts is None else images(tmp_path / "images", *counts)
    calibration = tmp_path / "calib.txt"
    calibration.write_text("P0: 50 0 32 0 0 50 24 0 0 0 1 0\nP1: 50 0 32 -5 0 50 24 0 0 0 1 0\n")
    given = [str(calibration) if option == "CALIB" else option for option in options]
    out = tmp_path / "sensor.toml"
    assert run("characterise", folder, "--out", out, *given) == 2
    error = capsys.readouterr().err
    assert message in error
    assert len(error.splitlines()) == 1
    assert not out.exists()


def test_images_of_several_sizes_are_refused(tmp_path, capsys):
    folder = images(tmp_path / "images", 6, 6, ((64, 48), (80, 60)))
    assert run("characterise", folder, "--out", tmp_path / "sensor.toml", *BOARD) == 2
    assert "all must have one size" in capsys.readouterr().err


def test_another_sensor_and_options_of_images_are_refused(log, tmp_path, capsys):
    assert run("characterise", log, "--out", tmp_path / "sensor.toml", *BOARD) == 2
    assert "goes with images" in capsys.readouterr().err
    assert run("characterise", log, "--out", tmp_path / "sensor.txt") == 2
    assert "must end in .toml" in capsys.readouterr().err
    other = tmp_path / "xyz"
    simulate_log(cs.load_scenario("herath2007-xyz").variant("short", truth__steps=20), runs=1, seed=0, out=other)
    assert run("characterise", other, "--out", tmp_path / "sensor.toml") == 2
    assert "only a sensor 'uvd' is characterised" in capsys.readouterr().err
    assert not (tmp_path / "sensor.toml").exists()
