"""Sweeps: the grid, the folder that goes on, the map; small linear worlds, a few runs of a Kalman filter."""

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import consistency as cs
from consistency.bench.runs.montecarlo import run_until_decided
from consistency.bench.scenario import data_folder
from consistency.bench.scenario.truth_and_belief import with_changes
from consistency.bench.sweeps import run_sweep as sweeping
from consistency.bench.sweeps.regime_map import Regime, ranked_by_cost, read_regime, regime_of, write_regime
from consistency.bench.sweeps.run_sweep import (
    CellResult,
    CellWork,
    SweepFolder,
    cost_of,
    describe,
    run_cell,
    run_sweep,
    sweep_from,
)
from consistency.bench.sweeps.sweep_file import QUANTITIES, load_sweep, number_of_points, sweep_names
from consistency.referee.errors import InputError

LINEAR = """
summary = "Two noises of the odometry in a linear world"
base = "small.toml"
filters = ["kf"]
seed = 3
[rule]
false_alarm = 0.01
max_runs = 12
[grid]
odometry = [1.0, 2.0]
density = [0.5, 1.0]
"""


@pytest.fixture
def at(tmp_path, monkeypatch):
    """A folder with ``small.toml``, a linear world of 30 steps, and ``grid.toml``, four cells of it."""
    text = (data_folder("scenarios") / "linear-gaussian.toml").read_text()
    (tmp_path / "small.toml").write_text(text.replace("steps = 500", "steps = 30"))
    (tmp_path / "grid.toml").write_text(LINEAR)
    monkeypatch.setattr(sweeping, "cost_of", lambda *_: (1.0, 5.0))
    return tmp_path


def edited(at, old, new):
    """The sweep with a part of its text replaced."""
    assert old in LINEAR
    (at / "other.toml").write_text(LINEAR.replace(old, new))
    return at / "other.toml"


# --- the grid -----------------------------------------------------------------------------------


def test_a_grid_changes_truth_and_belief_alike():
    sweep = load_sweep("regime")
    assert len(sweep.cells) == 150
    base, cell = sweep.base, next(c for c in sweep.cells if c.indices == (4, 2, 0, 0))
    truth, belief = cell.scenario.truth, cell.scenario.belief
    assert (truth.sensor.rig, belief.sensor.B) == ((150.0, 0.6), 0.6)
    assert truth.sensor.disparity == belief.sensor.disparity == pytest.approx((1.0, 32.0 * 0.6 / 0.09))
    assert truth.sensor.range == (0.5, 5.0)
    assert truth.landmarks.count == 30
    for key in ("sigma_v", "sigma_omega"):
        expected = 0.3 * getattr(base.truth.motion, key)
        assert getattr(truth.motion, key) == getattr(belief.motion, key) == pytest.approx(expected)
    assert cell.text.startswith("baseline 0.6 m, range of landmarks 5 m, density of landmarks ×0.25")


def test_filters_of_a_call_take_the_place_of_those_of_the_file():
    assert len(load_sweep("regime").filters) > 1
    assert load_sweep("regime", ["ukf-uvd"]).filters == ("ukf-uvd",)


def test_keys_of_the_scenario_are_axes_too(at):
    path = edited(at, "odometry = [1.0, 2.0]", 'truth.path.radius = [3.0, 4.0]\n"motion.sigma_v" = [0.1]')
    sweep = load_sweep(path)
    assert [axis.key for axis in sweep.axes] == ["truth.path.radius", "motion.sigma_v", "density"]
    scenario = sweep.cells[-1].scenario
    assert scenario.truth.motion.sigma_v == scenario.belief.motion.sigma_v == 0.1
    assert [c.scenario.truth.path.radius for c in sweep.cells] == [3.0, 3.0, 4.0, 4.0]
    with pytest.raises(InputError, match="both set"):
        load_sweep(edited(at, "density = [0.5, 1.0]", "motion.sigma_v = [0.1]"))


def test_a_key_may_end_in_its_unit_and_hold_lists(at):
    keys = "truth.path.heading_deg = [0, 90]\ntruth.sensor.range = [[0.5, 3.0], [0.5, 4.0]]"
    path = edited(at, "density = [0.5, 1.0]", keys)
    sweep = load_sweep(path)
    assert len(sweep.cells) == 8
    assert sorted({c.scenario.truth.path.heading for c in sweep.cells}) == pytest.approx([0.0, np.pi / 2])
    assert {c.scenario.truth.sensor.range for c in sweep.cells} == {(0.5, 3.0), (0.5, 4.0)}
    assert len({c.name for c in sweep.cells}) == 8


def test_a_cell_depends_on_nothing_but_itself(at):
    """Neither the order of values, nor other cells, nor other filters change seed and place of a cell."""
    whole = load_sweep(at / "grid.toml")
    part = load_sweep(edited(at, "odometry = [1.0, 2.0]\ndensity = [0.5, 1.0]", "density = [1.0]\nodometry = [2.0]"))
    alone = part.cells[0]
    same = next(c for c in whole.cells if c.scenario.hash == alone.scenario.hash)
    assert whole.seed_of(same) == part.seed_of(alone)
    assert len({whole.seed_of(c) for c in whole.cells}) == 4
    assert replace(whole, seed=4).seed_of(same) != whole.seed_of(same)


def test_built_in_sweeps_are_fine():
    assert {"regime", "small"} <= set(sweep_names())
    assert all(load_sweep(name).cells for name in sweep_names())


# --- axes that vary alone -----------------------------------------------------------------------


def test_axes_that_vary_alone_are_no_product(at):
    """At each point of the grid its own cell, and one for each other value of each axis; the base's value is added."""
    path = edited(at, "density = [0.5, 1.0]", "[alone]\ntruth.dt = [0.2, 0.4]\ndensity = [1.0, 0.5]")
    sweep = load_sweep(path)
    assert [axis.home for axis in sweep.axes] == [None, 0, 1]
    assert [axis.values for axis in sweep.axes] == [(1.0, 2.0), (0.1, 0.2, 0.4), (0.5, 1.0)]
    noisy = [cell.indices for cell in sweep.cells][4:]
    assert noisy == [(1, 0, 1), (1, 1, 1), (1, 2, 1), (1, 0, 0)]
    texts = [cell.text for cell in sweep.cells[:4]]
    assert texts == [f"noise of the odometry ×1{more}" for more in (
        "", ", truth.dt 0.2", ", truth.dt 0.4", ", density of landmarks ×0.5")]  # fmt: skip
    truths = [cell.scenario.truth for cell in sweep.cells]
    plain = sweep.base.truth
    assert [truth.dt for truth in truths] == [0.1, 0.2, 0.4, 0.1] * 2
    assert [truth.landmarks.count for truth in truths] == [*[plain.landmarks.count] * 3, plain.landmarks.count // 2] * 2
    assert [round(truth.motion.sigma_v / plain.motion.sigma_v) for truth in truths] == [1] * 4 + [2] * 4
    assert [cell.number for cell in sweep.cells] == list(range(8))
    assert len(sweep.cells) == number_of_points(sweep.axes)
    assert sweep_from({"sweep": json.loads(json.dumps(describe(sweep)))}, at) == sweep


DAMAGED = [
    {"grid": {}, "alone": {}},
    {"grid": {"odometry": []}},
    {"grid": {"odometry": ["loud"]}},
    {"grid": {"odometry": list(range(1, 151)), "density": list(range(1, 151))}},
    {"filters": "kf"},
    {"seed": "a"},
    {"rule": 5},
    {"base": "herath2007-stereo"},
]


@pytest.mark.parametrize("damage", DAMAGED, ids=lambda damage: str(damage)[:40])
def test_a_sweep_that_was_damaged_in_its_folder_is_refused(at, damage):
    content = describe(load_sweep("small")) | damage
    with pytest.raises(cs.InputError, match="key 'sweep' is damaged; write it again"):
        sweep_from({"sweep": content}, at)


def test_a_sweep_without_a_grid_starts_from_its_base(at):
    path = edited(at, "[grid]\nodometry = [1.0, 2.0]\ndensity", "[alone]\ndensity")
    sweep = load_sweep(path)
    assert [cell.name for cell in sweep.cells] == ["base", "density-0.5"]
    assert sweep.cells[0].scenario.hash == sweep.base.hash
    folder = run_sweep(sweep, at / "out", jobs=1)
    write_regime(regime_of(folder), at / "out")
    back = read_regime(at / "out" / "map.json")
    assert (back.sweep, len(back.results)) == (sweep, 2)


@pytest.mark.parametrize("name", QUANTITIES)
def test_the_own_value_of_a_base_changes_nothing(name):
    base = cs.load_scenario("herath2007-stereo")
    quantity = QUANTITIES[name]
    assert with_changes(base, "same", "", quantity.changes(base, quantity.own(base))).hash == base.hash


def test_worlds_of_the_axes():
    """A slower rate is the same drive in fewer steps; loops are shorter laps of the same drive, as dense."""
    base = cs.load_scenario("herath2007-stereo")

    def made(name, value):
        return with_changes(base, "made", "", QUANTITIES[name].changes(base, value))

    slow = made("dt", 0.5).truth
    assert (slow.dt, slow.steps, slow.path) == (0.5, 100, base.truth.path)
    tilted, high = made("tilt", -20.0), made("height", 0.5)
    for half in (tilted.truth, tilted.belief):
        assert half.sensor.mount.rotation == pytest.approx((0.0, -np.pi / 9, 0.0))
    for half in (high.truth, high.belief):
        assert half.sensor.mount.position == (0.0, 0.0, 0.5)
    loops = made("loops", 4.0).truth
    assert (loops.path.radius, loops.path.shape, loops.steps) == (1.0, "circle", 500)
    assert loops.path.speed == base.truth.path.speed
    assert loops.landmarks.x == pytest.approx((-5.0, 5.0), abs=0.1)  # 4 m beyond the path, as before
    assert loops.landmarks.count / 10.0**2 == pytest.approx(base.truth.landmarks.count / 16.0**2, rel=0.02)


BAD = {
    "alone without a value": (
        "density = [0.5, 1.0]", "[alone]\nbaseline = [0.1]", "'alone.baseline': small has no value there"),
    "alone and in the grid": ("seed = 3", "seed = 3\nalone.density = [0.1]", "'alone.density': stands in 'grid', too"),
    "alone of the same key": (
        "density = [0.5, 1.0]", "[alone]\nmotion.sigma_v = [0.3]",
        "'grid.odometry' and 'alone.motion.sigma_v' both set truth.motion.sigma_v"),
    "alone no list": ("density = [0.5, 1.0]", "[alone]\ntilt = 3", "'alone.tilt': must be a list"),
    "alone text": ("density = [0.5, 1.0]", '[alone]\ntilt = ["up"]', "'alone.tilt': values must be numbers"),
    "alone unknown": ("density = [0.5, 1.0]", "[alone]\ncolour = [1]", "'alone.colour': unknown; allowed: baseline"),
    "tilt of no camera": ("density = [0.5, 1.0]", "tilt = [20]", "'grid.tilt', value 20: a sensor 'linear' has no"),
    "filter that does not fit": ('"kf"', '"ekf-uvd"', "works on a sensor uvd, not 'linear'"),
    "unknown filter": ('"kf"', '"kff"', "did you mean 'kf'"),
    "baseline without a baseline": ("density = [0.5, 1.0]", "baseline = [0.1]", "'grid.baseline', value 0.1: a sensor"),
    "zero": ("odometry = [1.0, 2.0]", "odometry = [0.0, 1.0]", "'grid.odometry': values must be positive numbers, got"),
    "text": ("odometry = [1.0, 2.0]", 'odometry = ["much"]', "'grid.odometry': values must be positive"),
    "no list": ("odometry = [1.0, 2.0]", "odometry = 1.0", "'grid.odometry': must be a list"),
    "empty list": ("odometry = [1.0, 2.0]", "odometry = []", "'grid.odometry': must be a list of one value or more"),
    "a value twice": ("odometry = [1.0, 2.0]", "odometry = [1.0, 1]", "'grid.odometry': a value is given twice"),
    "unknown key": ("density =", "truth.sensor.colour =", "'grid.truth.sensor.colour': unknown; allowed: baseline"),
    "unknown quantity": ("density =", "colour =", "'grid.colour': unknown; allowed: baseline, range"),
    "bad value": ("density = [0.5, 1.0]", "truth.dt = [-1.0]", "'grid.truth.dt', value -1.0: key 'truth.dt'"),
    "range below its start": ("density = [0.5, 1.0]", "range = [0.1]", "'grid.range', value 0.1: key 'truth.sensor'"),
    "unknown key of the file": ("seed = 3", "sed = 3", "key 'sed': unknown key; allowed here: summary, base"),
    "unknown base": ('"small.toml"', '"small"', "unknown scenario 'small'"),
    "missing base": ('"small.toml"', '"none.toml"', "none.toml: cannot be read"),
    "no such rule": ("max_runs = 12", "max_runs = 0", "key 'rule.max_runs'"),
    "detect 1": ("max_runs = 12", "detect = 1.0", "detect must be"),
    "no grid": ("[grid]\nodometry = [1.0, 2.0]\ndensity = [0.5, 1.0]", "[grid]", "key 'grid'"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_sweeps(at, case):
    """One sentence that names the file and the key; nothing is run or written."""
    old, new, expected = BAD[case]
    path = edited(at, old, new)
    with pytest.raises(InputError) as refusal:
        load_sweep(path)
    assert expected in str(refusal.value)
    assert str(refusal.value).startswith(f"{path}: ") or "none.toml" in str(refusal.value)


# --- the folder ---------------------------------------------------------------------------------


def test_a_cell_has_the_verdict_of_a_run_until_decided(at):
    sweep = load_sweep(at / "grid.toml")
    folder = run_sweep(sweep, at / "out", jobs=1)
    cell = sweep.cells[2]
    results, verdicts = run_until_decided(
        cell.scenario, ["kf"], **sweep.rule.model_dump(), seed=sweep.seed_of(cell), jobs=1
    )
    verdict, found = verdicts["kf"], folder.results()[2, "kf"]
    assert (found.status, found.runs) == (verdict.status, verdict.runs)
    assert found.ratio == pytest.approx(verdict.inflation, rel=1e-4)
    assert found.rmse_position == pytest.approx(verdict.accuracy.rmse_position, rel=1e-4)
    runs = pd.read_csv(folder.place(CellWork(cell, "kf")) / "runs.csv")
    assert list(runs["run"]) == list(range(verdict.runs))
    nees = results.estimates.groupby("run")["nees"].mean().to_numpy()
    np.testing.assert_allclose(runs["nees"], nees, rtol=1e-4)
    assert np.sqrt((runs["rmse_position"] ** 2).mean()) == pytest.approx(found.rmse_position, rel=1e-3)
    assert runs["reason"].isna().all()


def test_more_values_and_filters_go_into_the_same_folder(at, monkeypatch):
    run_sweep(load_sweep(at / "grid.toml"), at / "out", jobs=1)
    done = []
    monkeypatch.setattr(sweeping, "run_cell", lambda *a, **o: (done.append(a[2]), run_cell(*a, **o))[1])
    more = load_sweep(edited(at, "odometry = [1.0, 2.0]", "odometry = [1.0, 1.5, 2.0]"))
    folder = run_sweep(more, at / "out", jobs=1)
    assert (len(done), len(folder.results())) == (2, 6)


@pytest.mark.parametrize(
    "name, old, new, what",
    [
        ("grid.toml", "max_runs = 12", "max_runs = 13", "max_runs"),
        ("grid.toml", "seed = 3", "seed = 4", "seed"),
        ("small.toml", "steps = 30", "steps = 31", "scenario"),
        ("grid.toml", "seed", "seed", "source code"),
    ],
)
def test_changed_inputs_are_refused_or_run_again(at, monkeypatch, name, old, new, what):
    run_sweep(load_sweep(at / "grid.toml"), at / "out", jobs=1)
    before = {path: path.read_bytes() for path in (at / "out").rglob("*.*") if path.is_file()}
    if what == "source code":
        monkeypatch.setattr(sweeping, "code_digest", lambda: "another")
    (at / name).write_text((at / name).read_text().replace(old, new))
    sweep = load_sweep(at / "grid.toml")
    with pytest.raises(InputError, match=rf"made with another {what} .*\(and 3 more\); add --overwrite"):
        run_sweep(sweep, at / "out", jobs=1)
    assert {path: path.read_bytes() for path in before} == before
    assert SweepFolder(sweep, at / "out").results() == {}  # nothing is mixed into a map
    folder = run_sweep(sweep, at / "out", jobs=1, overwrite=True)
    assert len(folder.results()) == 4


def test_a_folder_of_something_else_is_refused(at):
    (at / "mine").mkdir()
    (at / "mine" / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="is not a folder of 'consistency sweep'"):
        run_sweep(load_sweep(at / "grid.toml"), at / "mine", overwrite=True)
    assert [path.name for path in (at / "mine").iterdir()] == ["notes.txt"]
    cs.run_trials(cs.load_scenario(at / "small.toml"), ["kf"], runs=2, out=at / "results")
    with pytest.raises(InputError, match="holds results, not a sweep"):
        run_sweep(load_sweep(at / "grid.toml"), at / "results")


def test_any_exception_is_a_result(at, monkeypatch):
    def breaks(*_, **__):
        raise ZeroDivisionError("by nothing")

    monkeypatch.setattr(sweeping, "run_until_decided", breaks)
    found = run_sweep(load_sweep(at / "grid.toml"), at / "out", jobs=1).results().values()
    assert {(r.status, r.diagnosis, r.runs) for r in found} == {("failed", "failed: ZeroDivisionError: by nothing", 0)}
    assert np.isnan([r.rmse_position for r in found]).all()


def test_a_damaged_cell_is_named(at):
    folder = run_sweep(load_sweep(at / "grid.toml"), at / "out", jobs=1)
    path = next((at / "out").rglob("kf")) / "manifest.json"
    data = json.loads(path.read_text())
    del data["result"]["anees"]
    path.write_text(json.dumps(data))
    with pytest.raises(InputError, match="key 'result' is damaged"):
        folder.results()


def test_the_cost_is_the_least_of_three_by_turns(uvd, monkeypatch):
    """In CPU time of the thread in which a trial runs, whatever other threads do."""
    seconds = {"ekf-uvd": iter([0.03, 0.01, 0.02]), "ukf-uvd": iter([0.04, 0.06, 0.05])}
    clock, order = [0.0], list[str]()

    def run_filter(filter_, *_):
        order.append(filter_.name)
        clock[0] += next(seconds[filter_.name])
        return SimpleNamespace(failure=None)

    monkeypatch.setattr(sweeping, "run_filter", run_filter)
    monkeypatch.setattr(sweeping.time, "thread_time", lambda: clock[0])
    monkeypatch.setattr(sweeping, "compile_all", lambda wanted: None)
    cost, microseconds = cost_of("ukf-uvd", "ekf-uvd", uvd, 0)
    assert order == ["ukf-uvd", "ekf-uvd"] * 3
    assert cost == pytest.approx(4.0)
    assert microseconds == pytest.approx(1e6 * 0.04 / uvd.truth.steps)


# --- the map ------------------------------------------------------------------------------------


def result(status="consistent", rmse=0.1, cost=1.0):
    return CellResult(status, status, 48, 0, 3.0, 2.5, 3.5, 1.0, 0.9, 1.1, rmse, 0.01, cost, 20.0)


def test_a_map_is_the_same_from_its_files(at):
    sweep = load_sweep(at / "grid.toml")
    folder = run_sweep(sweep, at / "out", jobs=1)
    regime = regime_of(folder)
    paths = write_regime(regime, at / "out")
    assert [path.name for path in paths] == ["map.json", "map.csv", "map.parquet"]
    for source in (at / "out", at / "out" / "map.json"):
        again = read_regime(source)
        assert repr(again.results) == repr(regime.results)
        assert again.sweep == sweep
    table = pd.read_csv(at / "out" / "map.csv")
    assert list(table.columns[:3]) == ["odometry", "density", "filter"]
    assert sorted(map(tuple, table[["odometry", "density"]].to_numpy())) == [(1, 0.5), (1, 1), (2, 0.5), (2, 1)]
    shutil.copy(at / "out" / "map.json", at / "cut.json")
    (at / "cut.json").write_text((at / "cut.json").read_text()[:-40])
    (at / "list.json").write_text("[]")
    for bad, match in (("cut", "not valid JSON"), ("none", "cannot be read"), ("list", "is not a map")):
        with pytest.raises(InputError, match=match):
            read_regime(at / f"{bad}.json")


def test_filters_are_ranked_by_rmse_and_then_cost():
    found = {"slow": result(rmse=0.1000, cost=3.0), "fast": result(rmse=0.1005), "worse": result(rmse=0.2, cost=0.5)}
    assert [name for name, _ in ranked_by_cost(found)] == ["fast", "slow", "worse"]


def test_only_consistent_filters_are_trusted():
    sweep = replace(load_sweep("small"), filters=("ekf-uvd", "ukf-uvd", "ckf-uvd"))
    pairs = (("ekf-uvd", result("overconfident")), ("ukf-uvd", result()), ("ckf-uvd", result("undecided")))
    regime = Regime(sweep, {(0, name): r for name, r in pairs}, {})
    assert [name for name, _ in regime.trusted(sweep.cells[0])] == ["ukf-uvd"]
    assert regime.missing == 9


def test_a_report_shows_every_filter_and_cell(at):
    from consistency.bench.pages.sweep_report import LOOKS, WORDS, compose_regime
    from consistency.referee.show.as_html import render
    from consistency.referee.show.pdf import render_pdf

    sweep = load_sweep("small")
    statuses = list(LOOKS)
    results = {
        (cell.number, name): result(statuses[(2 * cell.number + i) % len(statuses)], rmse=np.nan if i else 0.1)
        for cell in sweep.cells for i, name in enumerate(sweep.filters)
    }  # fmt: skip
    document = compose_regime(Regime(sweep, results, {"kind": "map"}))
    assert "Of 4 cells, consistent are ekf-uvd in 1 and parked-ekf-uvd in 0" in document.answer
    assert [figure.title for figure in document.figures] == [*sweep.filters]
    page = render(document)
    assert {status for status in statuses if f">{WORDS[status]}</text>" in page} == set(statuses)
    assert page.count("<title>overconfident, covariance ratio") == 1
    assert "ekf-uvd: 0.100 m, ×1" in page
    assert page.count(">0.5 m</td>") == 2
    looks = {(look.colour, look.marker, look.edge) for look in LOOKS.values()}
    assert len({marker for _, marker, _ in looks}) == len(LOOKS) - 1  # only undecided shares a shape, hollow
    assert render_pdf(document).startswith(b"%PDF")
    unfinished = compose_regime(Regime(sweep, dict(list(results.items())[:3]), {"kind": "map"}))
    assert "not finished: 5 of 8" in unfinished.answer


def test_a_sweep_of_one_axis_has_one_figure_of_all_filters(at):
    from painted import panels

    from consistency.bench.pages.sweep_report import LOOKS, compose_regime

    sweep = load_sweep(edited(at, "odometry = [1.0, 2.0]\ndensity = [0.5, 1.0]", "odometry = [1.0, 2.0]"))
    found = {(0, "kf"): result(rmse=0.1), (1, "kf"): result("overconfident", rmse=0.3)}
    document = compose_regime(Regime(sweep, found, {}))
    along, _ = document.figures
    ratios, errors = panels(along)
    assert along.title == "Along odometry"
    line, *markers = errors.get_lines()
    assert line.get_xydata().tolist() == [[1.0, 0.1], [2.0, 0.3]]
    assert [marker.get_marker() for marker in markers] == [LOOKS[s].marker for s in ("consistent", "overconfident")]
    assert ratios.get_ylabel() == "true / stated covariance"


def test_a_map_without_numbers_on_its_axes_has_heat_maps_alone(at):
    from consistency.bench.pages.sweep_report import compose_regime
    from consistency.referee.show.as_html import render

    path = edited(at, "odometry = [1.0, 2.0]\ndensity = [0.5, 1.0]", "truth.sensor.range = [[0.5, 3.0], [0.5, 4.0]]")
    sweep = load_sweep(path)
    document = compose_regime(Regime(sweep, {(0, "kf"): result(), (1, "kf"): result()}, {}))
    assert [figure.title for figure in document.figures] == ["kf"]
    assert "range [0.5, 3.0]" in render(document)
