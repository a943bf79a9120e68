"""Log folders: what is simulated is read back to the bit, and damage is answered with file, column and row."""

import shutil
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import tomli_w

import consistency as cs
from consistency.bench.runs.montecarlo import run_log, simulate_log
from consistency.bench.store.recorded_log import read_log


@pytest.fixture(scope="module")
def written(uvd, tmp_path_factory):
    folder = tmp_path_factory.mktemp("log") / "log"
    simulate_log(uvd, runs=2, seed=1, out=folder)
    return folder


@pytest.fixture
def folder(written, tmp_path):
    """A copy to be damaged."""
    return Path(shutil.copytree(written, tmp_path / "copy"))


def change(folder, name, edit):
    path = folder / f"{name}.parquet"
    edit(pd.read_parquet(path)).to_parquet(path, index=False)


def change_sensor(folder, **values):
    """Set keys of sensor.toml; None drops the key."""
    path = folder / "sensor.toml"
    data = tomllib.loads(path.read_text()) | values
    path.write_text(tomli_w.dumps({key: value for key, value in data.items() if value is not None}))


def put(column, row, value):
    def edit(table):
        table[column] = table[column].astype(float)
        table.loc[row, column] = value
        return table

    return edit


def same_trial(a, b):
    """Equal to the bit; landmarks that were never seen are not in a log."""
    same = all(np.array_equal(getattr(a, f), getattr(b, f)) for f in ("start", "controls", "first", "z", "truth"))
    return same and len(a.landmark) == len(b.landmark)


# --- round trip ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["herath2007-stereo", "herath2007-xyz", "linear-gaussian"])
def test_read_gives_back_what_was_simulated(small, name, tmp_path):
    scenario = small(name)
    simulate_log(scenario, runs=3, seed=4, out=tmp_path / "log")
    log = read_log(tmp_path / "log")
    assert log.belief == scenario.belief
    assert [trial.run for trial in log.trials] == [0, 1, 2]
    for trial in log.trials:
        original = cs.simulate(scenario, trial.run, seed=4)
        assert same_trial(trial, original)
        assert np.array_equal(trial.landmarks[trial.landmark], original.landmarks[original.landmark])
        assert not same_trial(trial, cs.simulate(scenario, trial.run, seed=5))  # negative control


def test_belief_with_a_mount_and_other_sigma_points_comes_back(small, tilted, tmp_path):
    scenario = small(
        "herath2007-stereo",
        truth__sensor__mount=tilted,
        belief__sensor__mount=tilted,
        belief__sigma_points={"alpha": 0.5, "beta": 2.0, "kappa": 1.0},
    )
    simulate_log(scenario, runs=1, seed=0, out=tmp_path / "log")
    assert read_log(tmp_path / "log").belief == scenario.belief


def test_a_log_gives_the_estimates_of_the_scenario(uvd, written):
    direct = cs.run_trials(uvd, ["ekf-uvd"], runs=2, seed=1, jobs=1)
    logged = run_log(read_log(written), ["ekf-uvd"], jobs=1)
    pd.testing.assert_frame_equal(logged.estimates, direct.estimates, check_exact=True)
    pd.testing.assert_frame_equal(logged.truth, direct.truth, check_exact=True)


def test_order_of_rows_does_not_matter(written, folder):
    for name in ("controls", "observations", "truth"):
        change(folder, name, lambda table: table.sample(frac=1.0, random_state=3))
    for a, b in zip(read_log(written).trials, read_log(folder).trials, strict=True):
        assert np.array_equal(a.controls, b.controls)
        assert np.array_equal(a.truth, b.truth)
        for step in range(1, a.steps + 1):
            seen, shuffled = a.observation(step), b.observation(step)
            order = np.argsort(shuffled.landmarks)
            assert np.array_equal(seen.landmarks, shuffled.landmarks[order])
            assert np.array_equal(seen.z, shuffled.z[order])


def test_without_truth_there_is_no_nees_but_a_nis(folder):
    (folder / "truth.parquet").unlink()
    (folder / "landmarks.parquet").unlink()
    log = read_log(folder)
    assert log.trials[0].truth is None
    results = run_log(log, ["ekf-uvd"], jobs=1)
    assert results.truth is None
    assert results.scenario is None
    assert results.estimates["nees"].isna().all()
    assert results.estimates["nis"].notna().any()
    assert "no truth" in cs.analyse(results)["ekf-uvd"].reasons[0]


def test_start_is_taken_from_the_sensor_file_or_the_truth_or_is_zero(folder):
    change_sensor(folder, start={"x": 1.0, "y": 2.0, "heading_deg": 90.0})
    assert np.allclose(read_log(folder).trials[0].start, [1.0, 2.0, np.pi / 2])
    change_sensor(folder, start=None)
    log = read_log(folder)
    assert np.array_equal(log.trials[0].start, log.trials[0].truth[0])
    (folder / "truth.parquet").unlink()
    assert np.array_equal(read_log(folder).trials[0].start, np.zeros(3))


def test_runs_may_have_any_number_and_length(folder):
    for name in ("controls", "observations", "truth"):
        change(folder, name, lambda t: t[(t["run"] == 0) | (t["step"] <= 20)].replace({"run": {1: 41}}))
    log = read_log(folder)
    assert [(trial.run, trial.steps) for trial in log.trials] == [(0, 60), (41, 20)]
    results = run_log(log, ["ekf-uvd"], jobs=1)
    assert results.estimates.groupby("run")["step"].max().to_dict() == {0: 60, 41: 20}


# --- damage --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["controls.parquet", "observations.parquet", "sensor.toml"])
def test_file_missing(folder, name):
    (folder / name).unlink()
    with pytest.raises(cs.InputError, match=rf"{name}: (missing|cannot be read)"):
        read_log(folder)


def test_folder_missing(tmp_path):
    with pytest.raises(cs.InputError, match=r"--log .*nowhere: no such folder"):
        read_log(tmp_path / "nowhere")


DAMAGE = {
    "NaN": ("observations", put("z1", 7, np.nan), r"column 'z1', row 7: not a finite number"),
    "infinite control": ("controls", put("v", 3, np.inf), r"column 'v', row 3: not a finite number"),
    "no column": ("observations", lambda t: t.drop(columns="z2"), r"column 'z2' is missing; needed: run, step"),
    "half a landmark": ("observations", put("landmark", 2, 0.5), r"column 'landmark', row 2: not a whole number"),
    "step left out": ("controls", lambda t: t.drop(index=10), r"column 'step' of run 0 must count 1, 2, …"),
    "step zero": ("controls", lambda t: t.assign(step=t["step"] - 1), r"column 'step' of run 0 must count"),
    "time stands": ("controls", put("dt", 5, 0.0), r"column 'dt', row 5: must be positive"),
    "no controls": ("controls", lambda t: t[:0], r"holds no control"),
    "no observations": ("observations", lambda t: t[:0], r"holds no observation"),
    "landmark twice": ("observations", lambda t: pd.concat([t, t[:1]]), r"row \d+: this landmark is duplicated"),
    "observation of step 0": ("observations", put("step", 4, 0), r"row 4: controls\.parquet has no such run and step"),
    "stray run": ("observations", put("run", 4, 9), r"row 4: controls\.parquet has no such run and step"),
    "no disparity": ("observations", put("z2", 6, 0.0), r"column 'z2', row 6: a disparity must be positive"),
    "truth too short": ("truth", lambda t: t[t["step"] < 60], r"run 0 must have the steps 0 to 60, each once"),
    "truth of another run": ("truth", lambda t: t[t["run"] == 0], r"run 1 must have the steps 0 to 60, each once"),
    "landmark unknown": ("landmarks", lambda t: t[:0], r"landmark \d+ of observations\.parquet is not there"),
    "position twice": (
        "landmarks",
        lambda t: pd.concat([t, t[:1]]),
        r"column 'landmark': every landmark may be listed once",
    ),
}


@pytest.mark.parametrize("case", DAMAGE)
def test_damage_is_answered_with_file_and_place(folder, case):
    name, edit, complaint = DAMAGE[case]
    change(folder, name, edit)
    with pytest.raises(cs.InputError, match=rf"{name}\.parquet: {complaint}") as error:
        read_log(folder)
    assert "\n" not in str(error.value)
    assert str(folder) in str(error.value)


def test_linear_world_needs_its_landmarks(linear, tmp_path):
    simulate_log(linear, runs=1, seed=0, out=tmp_path / "log")
    (tmp_path / "log" / "landmarks.parquet").unlink()
    with pytest.raises(cs.InputError, match=r"landmarks\.parquet: missing; a linear world needs"):
        read_log(tmp_path / "log")


SENSOR = {
    "unknown key": ({"colour": 1}, r"key 'colour': unknown key; allowed here: model, sigma"),
    "unknown model": ({"model": "lidar"}, r".*model.*'xyz', 'uvd', 'linear', 'relative-xy' or 'range-bearing'"),
    "no baseline": ({"B": None}, r".*needs f \(px\) and B \(m\)"),
    "no noise": ({"sigma_px": None}, r"key 'sigma': missing"),
    "negative noise": ({"sigma_px": [1.0, -1.0, 1.0]}, r"key 'sigma\.1'"),
    "no motion": ({"motion": None}, r"key 'motion': missing"),
    "bad motion": ({"motion": {"sigma_v": -1.0, "sigma_omega": 0.1}}, r"key 'motion\.sigma_v'"),
}


@pytest.mark.parametrize("case", SENSOR)
def test_bad_sensor_file(folder, case):
    values, complaint = SENSOR[case]
    change_sensor(folder, **values)
    with pytest.raises(cs.InputError, match=rf"sensor\.toml: {complaint}") as error:
        read_log(folder)
    assert "\n" not in str(error.value)
    assert "[type=" not in str(error.value)


# --- writing -------------------------------------------------------------------------------------


@pytest.mark.parametrize("runs, seed, complaint", [(0, 0, "runs must be at least 1"), (1, -1, "seed must not be")])
def test_counts_are_checked(uvd, tmp_path, runs, seed, complaint):
    with pytest.raises(cs.InputError, match=complaint):
        simulate_log(uvd, runs, seed, tmp_path / "log")
    assert list(tmp_path.iterdir()) == []


def test_raw_pixels_are_refused(folder):
    """Columns and rows of the image instead of pixels from the principal point."""
    path = folder / "observations.parquet"
    table = pd.read_parquet(path)
    table.assign(z0=table["z0"] + 160, z1=table["z1"] + 120).to_parquet(path)
    with pytest.raises(cs.InputError, match=r"observations\.parquet: column 'z0', row \d+: .* principal point"):
        read_log(folder)
