"""Advice from a map: where a rig lies, what is said of it, and how sure; the map's results are made up."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import consistency as cs
from consistency.bench.scenario import data_folder, misbelief
from consistency.bench.scenario.scenario import with_changes
from consistency.bench.store.log import write_log
from consistency.bench.sweeps import recommend as advising
from consistency.bench.sweeps import regime as maps
from consistency.bench.sweeps import rig as rigs
from consistency.bench.sweeps.axes import QUANTITIES, Axis, equivalent_baseline
from consistency.bench.sweeps.cell import CellResult
from consistency.bench.sweeps.plan import load_sweep
from consistency.bench.sweeps.printing import advice_blocks, advice_json, notes_of, sentences_of
from consistency.bench.sweeps.recommend import recommend_for
from consistency.bench.sweeps.regime import Regime, read_regime
from consistency.bench.sweeps.rig import Request, differences, place_on, read_rig, told_otherwise
from consistency.referee.errors import InputError
from consistency.referee.show.terminal import show

BASE = "herath2007-stereo"
SENSOR = """
model = "uvd"
sigma_px = [1.34, 1.53, 0.65]
f = 150.0
B = 0.09
[motion]
sigma_v = 0.05
sigma_omega_deg = 5.0
"""


def result(status: str = "consistent", rmse: float = 0.1, cost: float = 1.0) -> CellResult:
    return CellResult(status, status, 48, 0, 3.0, 2.5, 3.5, 1.0, 0.9, 1.1, rmse, 0.01, cost, 20.0)


def made(says: Callable[[tuple[int, ...], str], CellResult]) -> Regime:
    """A regime map with the results that ``says`` gives for a cell's indices and a filter."""
    sweep = load_sweep("regime")
    return Regime(sweep, {(c.number, n): says(c.indices, n) for c in sweep.cells for n in sweep.filters}, {})


@pytest.fixture(scope="module")
def regime() -> Regime:
    """``ekf-uvd`` is consistent from 0.32 m on, ``parked-ekf-uvd`` everywhere and dearer, ``ukf-uvd`` nowhere."""

    def says(at: tuple[int, ...], name: str) -> CellResult:
        if name == "parked-ekf-uvd":
            return result(rmse=0.1, cost=2.5)
        good = name == "ekf-uvd" and at[0] >= 3
        return result("consistent" if good else "overconfident", rmse=0.1005)

    return made(says)


def advise(regime: Regime, rig: str = BASE, runs: int = 0, **said: Any) -> advising.Advice:
    return recommend_for(Request(rig, **said), regime, runs, jobs=1)


# --- where the rig lies -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "nearest", "around", "inside"),
    [(2.0, 0, (0,), True), (4.0, 2, (1, 2), True), (7.0, 2, (2, 3), True), (12.1, 3, (3,), True),
     (1.0, 0, (0,), False), (30.0, 3, (3,), False), (np.nan, 0, (0,), False), (3.02, 1, (1,), True)],
)  # fmt: skip
def test_places_on_an_axis(value: float, nearest: int, around: tuple[int, ...], inside: bool) -> None:
    """By the logarithm: 4 lies nearer to 5 (1.25) than to 3 (1.33), 7 nearer to 5 (1.40) than to 12 (1.71)."""
    place = place_on(Axis("range", (2.0, 3.0, 5.0, 12.0)), value)
    assert (place.nearest, place.around, place.inside) == (nearest, around, inside)


def test_places_that_are_no_numbers() -> None:
    axis = Axis("truth.path.shape", ("circle", "corridor"))
    assert (place_on(axis, "corridor").nearest, place_on(axis, "corridor").inside) == (1, True)
    assert not place_on(axis, "waypoints").inside
    assert "beyond the map's circle, corridor" in place_on(axis, "waypoints").text


def test_the_published_rig_lies_at_its_cells(regime: Regime) -> None:
    advice = advise(regime)
    assert advice.here.nearest.indices == (1, 2, 2, 1)
    assert [place.around for place in advice.here.places] == [(1,), (1, 2), (2,), (1,)]
    assert advice.inside
    assert advice.unlike == ()


def test_what_the_map_does_not_vary_is_named() -> None:
    sweep = load_sweep("regime")
    base = sweep.base
    assert differences(sweep.cells[77].scenario, sweep) == []
    other = base.variant("other", truth__path__speed=0.7, belief__sensor__sigma=(1.0, 1.0, 0.5))
    assert differences(other, sweep) == ["truth.path.speed", "belief.sensor.sigma"]
    hidden = base.variant("hidden", belief__motion__sigma_v=0.01, belief__sensor__disparity=None)
    assert set(differences(hidden, sweep)) == {"belief.motion.sigma_v", "belief.sensor.disparity"}


# --- what is recommended ------------------------------------------------------------------------


def test_the_cheaper_of_two_equally_good_filters_comes_first(regime: Regime, tmp_path: Path) -> None:
    wide = advise(regime, "herath2007-wide-baseline")
    assert [c.filter for c in wide.candidates] == ["ekf-uvd", "parked-ekf-uvd", "ukf-uvd"]
    near = advise(regime)
    assert [c.filter for c in near.candidates if c.trusted] == ["parked-ekf-uvd"]
    assert [(c.agreeing, c.around) for c in near.candidates] == [(7, 7), (0, 7), (0, 7)]


def test_cells_around_are_corners_and_neighbours_on_each_axis(regime: Regime) -> None:
    """Between two ranges, at a value of each other axis: the odometry of the map has a value on one side alone."""
    near = set(advising.around(advise(regime).here.places))
    assert near == {(1, 2, 2, 1), (1, 1, 2, 1), (0, 2, 2, 1), (2, 2, 2, 1), (1, 3, 2, 1), (1, 2, 1, 1), (1, 2, 2, 0)}


def test_a_filter_at_the_edge_of_its_region_comes_second(regime: Regime) -> None:
    """At 0.26 m the nearest cell (0.32 m) trusts the cheaper EKF, the other (0.17 m) does not."""
    scenario = cs.load_scenario(BASE)
    changes = {"truth__sensor__B": 0.26, "belief__sensor__B": 0.26}
    edge = scenario.variant("edge", **changes)
    places = tuple(place_on(axis, axis.of(edge, scenario)) for axis in regime.sweep.axes)
    cells = [regime.sweep.at([i, *(p.nearest for p in places[1:])]) for i in places[0].around]
    assert None not in cells
    found = advising.candidates_of(advising.MapPlace(regime, places, cells[1], tuple(cells), ()))
    assert [(c.filter, c.agreeing) for c in found] == [("parked-ekf-uvd", 2), ("ekf-uvd", 1), ("ukf-uvd", 0)]


def test_a_cell_that_is_missing_does_not_agree(regime: Regime) -> None:
    other = next(c.number for c in regime.sweep.cells if c.indices == (1, 1, 2, 1))
    rest = {key: found for key, found in regime.results.items() if key[0] != other}
    best = advise(replace(regime, results=rest)).candidates[0]
    assert (best.agreeing, best.around) == (6, 7)


def test_outside_the_map_nothing_is_sure(regime: Regime) -> None:
    advice = advise(regime, range=30.0)
    assert not advice.inside
    assert advice.best.sure == "unsure"
    assert "range of landmarks 30 m, beyond the map's 2 m to 12 m" in [place.text for place in advice.here.places]
    assert "outside the map" in sentences_of(advice)[0]


def test_no_filter_to_trust_names_the_nearest_cell_with_one() -> None:
    regime = made(lambda at, name: result("consistent" if at[0] == 2 and name == "ukf-uvd" else "biased"))
    advice = advise(regime)
    assert advice.best is None
    assert sentences_of(advice) == [
        "No filter of the map is consistent near this rig. Nearest cell where one is consistent: baseline 0.17 m, "
        "range of landmarks 5 m, density of landmarks ×1, noise of the odometry ×1: ukf-uvd."
    ]
    nowhere = advise(made(lambda *_: result("biased")))
    assert nowhere.lacking == ()
    assert sentences_of(nowhere) == ["No filter of the map is consistent near this rig."]


def test_a_map_that_is_not_finished_says_what_is_missing(regime: Regime) -> None:
    """The sweep was interrupted before the second filter was in the nearest cell: none is not known yet."""
    bad = made(lambda *_: result("biased"))
    *_, second = bad.sweep.filters
    here = advise(bad).here.nearest
    part = replace(bad, results={k: v for k, v in bad.results.items() if k != (here.number, second)})
    [answer] = sentences_of(advise(part))
    assert answer == (
        f"No answer yet: of {here.text} the map lacks {second}. Of those there "
        f"({', '.join(c.filter for c in advise(part).candidates)}) none is consistent. 1 of its {len(bad.results)} "
        "results are missing; finish the sweep: the same 'consistency sweep' goes on."
    )
    good = replace(regime, results={k: v for k, v in regime.results.items() if k != (here.number, "ukf-uvd")})
    advice = advise(good)
    lacking = "its sweep is not finished: the nearest cell lacks ukf-uvd"
    assert advice.best is not None
    assert lacking in notes_of(advice)


@pytest.fixture
def short(tmp_path: Path) -> str:
    """The published rig for 60 steps."""
    text = (data_folder("scenarios") / f"{BASE}.toml").read_text()
    path = tmp_path / "short.toml"
    path.write_text(text.replace("steps = 500", "steps = 60"))
    return str(path)


def test_runs_of_the_rig_confirm_or_contradict(short: str, capsys: pytest.CaptureFixture[str]) -> None:
    """The map claims both filters consistent; in a hundred runs of ekf-uvd its fault is found."""
    regime = made(lambda _, name: result(rmse=0.1 if name == "ekf-uvd" else 0.2 if name == "kf" else 0.3))
    regime = replace(regime, sweep=replace(regime.sweep, base=cs.load_scenario(short)))
    advice = recommend_for(Request(short), regime, runs=12, confirm=1, jobs=1)
    best = advice.candidates[0]
    assert (best.filter, best.verdict.runs, advice.runs) == ("ekf-uvd", 12, 12)
    direct = cs.analyse(cs.run_trials(advice.rig.scenario, ["ekf-uvd"], 12, jobs=1), confidence=0.99)["ekf-uvd"]
    assert best.verdict.reasons == direct.reasons
    assert all(candidate.verdict is None for candidate in advice.candidates[1:])
    said = " ".join(sentences_of(advice))
    assert f"a covariance too small by ×{best.detectable:.2f} would have been found with probability 0.95" in said
    assert "a right filter would fail in 1 %" in said
    show(*advice_blocks(advice))
    assert best.verdict.status == "undecided"  # 12 runs show nothing
    assert best.sure == "fairly sure"
    assert "12 runs of this rig find no fault, and do not decide" in capsys.readouterr().out
    data = advice_json(advice)
    assert (data["take"], data["sure"], data["filters"][0]["confirmed"]["status"]) == (
        "ekf-uvd", best.sure, best.verdict.status,
    )  # fmt: skip


@pytest.mark.parametrize(("inside", "alike", "status", "sure"), [
    (True, True, "undecided", "fairly sure"), (True, True, "consistent", "sure"), (True, False, "consistent", "unsure"),
    (False, True, "consistent", "unsure"), (True, True, "biased", "no"), (False, False, "failed", "no"),
    (True, True, None, ""),
])  # fmt: skip
def test_how_sure(inside: bool, alike: bool, status: str | None, sure: str) -> None:
    verdict: Any = None if status is None else type("Said", (), {"status": status})()
    candidate = advising.NearFilter("f", result(), 4, 4, verdict)
    assert advising.sureness(candidate, inside, alike) == sure
    split = replace(candidate, agreeing=3)
    assert advising.sureness(split, inside, alike) == ("fairly sure" if sure == "sure" else sure)
    assert advising.sureness(replace(candidate, nearest=result("biased")), inside, alike) == ""
    alone = replace(candidate, verdict=None)
    assert advising.sureness(alone, inside, alike, alone=True) == ("fairly sure" if inside and alike else "unsure")


class Said:
    """Verdicts by the name of the filter, in place of runs."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **statuses: str) -> None:
        self.asked: list[tuple[str, int]] = []
        real = cs.judge(np.random.default_rng(0).normal(size=(30, 4, 3)), np.broadcast_to(np.eye(3), (30, 4, 3, 3)))
        monkeypatch.setattr(advising, "run_trials", lambda _, names, runs, *__: self.asked.append((names[0], runs)))
        verdict = {name.replace("_", "-"): replace(real, status=status) for name, status in statuses.items()}
        monkeypatch.setattr(advising, "analyse", lambda _, names, **__: {names[0]: verdict[names[0]]})


def everywhere(regime: Regime) -> Regime:
    """The map has every filter as consistent; the EKF is the most accurate, then the UKF, then the parked one."""
    order = {"ekf-uvd": 0.1, "ukf-uvd": 0.2}
    return replace(regime, results={key: result(rmse=order.get(key[1], 0.3)) for key in regime.results})


def test_filters_are_confirmed_one_at_a_time(regime: Regime, monkeypatch: pytest.MonkeyPatch) -> None:
    """By as many runs as the map's rule needs; the first that is not contradicted ends it, and no other is taken."""
    said = Said(monkeypatch, ekf_uvd="biased", ukf_uvd="consistent")
    advice = recommend_for(Request(BASE), everywhere(regime), jobs=1)
    assert said.asked == [("ekf-uvd", 78), ("ukf-uvd", 78)]
    assert [(c.filter, c.sure) for c in advice.candidates] == [
        ("ukf-uvd", "sure"), ("ekf-uvd", "no"), ("parked-ekf-uvd", "")
    ]  # fmt: skip
    assert advice.best is advice.candidates[0]
    assert "78 runs of this rig show it consistent" in " ".join(sentences_of(advice))


def test_nobody_is_taken_where_all_that_were_run_are_contradicted(
    regime: Regime, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = Said(monkeypatch, ekf_uvd="biased", ukf_uvd="overconfident")
    advice = recommend_for(Request(BASE), everywhere(regime), confirm=2, jobs=1)
    assert len(said.asked) == 2
    assert advice.best is None
    assert sentences_of(advice) == [
        "No filter to trust: the map has one, but 78 runs of this rig find: ekf-uvd (biased), ukf-uvd (overconfident). "
        "Not run: parked-ekf-uvd (--confirm)."
    ]


def test_the_map_alone_is_said_to_be_that(regime: Regime, monkeypatch: pytest.MonkeyPatch) -> None:
    said = Said(monkeypatch)
    advice = advise(regime)
    assert said.asked == []
    assert (advice.best.filter, advice.best.sure) == ("parked-ekf-uvd", "fairly sure")
    assert "By the map alone: the filter was not run on this rig." in sentences_of(advice)[0]
    assert advice.untried == ()


def test_a_rig_unlike_the_map_is_unsure(regime: Regime, monkeypatch: pytest.MonkeyPatch) -> None:
    Said(monkeypatch, parked_ekf_uvd="consistent")
    advice = recommend_for(Request(BASE, speed=1.0), regime, jobs=1)
    assert (advice.inside, advice.unlike, advice.best.sure) == (True, ("truth.path.speed",), "unsure")
    assert "no cell is as the rig is" in sentences_of(advice)[0]


# --- the second map -----------------------------------------------------------------------------


def beyond(status: Callable[[tuple[int, ...]], str] = lambda _: "consistent") -> Regime:
    """A map of axes that vary alone; ``parked-ekf-uvd`` is as ``status`` says for the indices of a cell."""
    sweep = load_sweep("beyond")
    found = {
        (c.number, n): result(status(c.indices) if n == "parked-ekf-uvd" else "biased")
        for c in sweep.cells for n in sweep.filters
    }  # fmt: skip
    return Regime(sweep, found, {})


def varied(**changes: Any) -> Any:
    """The published rig otherwise; keys of the second map's axes."""
    base = cs.load_scenario(BASE)
    for key, value in changes.items():
        base = with_changes(base, "varied", "", QUANTITIES[key].changes(base, value))
    return base


def advised(regime: Regime, alone: Regime | None, monkeypatch: pytest.MonkeyPatch, **changes: Any) -> advising.Advice:
    Said(monkeypatch, parked_ekf_uvd="consistent", robocentric_ekf_uvd="consistent", ukf_uvd="consistent")
    monkeypatch.setattr(rigs, "load_scenario", lambda _: varied(**changes))
    return recommend_for(Request("varied"), regime, jobs=1, alone=alone)


@pytest.mark.parametrize(("changes", "sure", "around"), [
    ({"tilt": 20.0}, "sure", 5), ({"tilt": 10.0}, "sure", 5), ({"dt": 0.2}, "sure", 5), ({"speed": 0.8}, "sure", 4),
    ({"height": 1.0}, "sure", 4), ({"loops": 3.0}, "sure", 5), ({"odometry": 2.0}, "sure", 4),
    ({"tilt": 60.0}, "unsure", 4), ({"dt": 0.5, "tilt": 20.0}, "unsure", 0),
    ({"odometry": 2.0, "tilt": 20.0}, "unsure", 0), ({"dt": 0.12, "tilt": 5.0}, "unsure", 0),
    ({"odometry": 0.3, "tilt": 20.0}, "sure", 5),
])  # fmt: skip
def test_a_rig_that_differs_in_one_thing_is_looked_up(
    regime: Regime, monkeypatch: pytest.MonkeyPatch, changes: dict[str, float], sure: str, around: int
) -> None:
    """Sure inside the second map and where the rig differs on one of its axes; in two no cell is like it."""
    advice = advised(regime, beyond(), monkeypatch, **changes)
    first = len(advice.here.around)
    assert first in (6, 7)
    assert (advice.best.filter, advice.best.sure) == ("parked-ekf-uvd", sure)
    assert (advice.best.agreeing, advice.best.around) == (first + around, first + around)
    without = advised(regime, None, monkeypatch, **changes).best
    assert without.sure == "unsure"


def test_cells_around_in_the_second_map(regime: Regime, monkeypatch: pytest.MonkeyPatch) -> None:
    """The neighbours on the tilt and on the baseline; those on another axis would be two steps from its base."""
    advice = advised(regime, beyond(), monkeypatch, tilt=20.0)
    assert advice.beyond.nearest.text == "baseline 0.09 m, tilt 20 deg"
    assert {cell.text for cell in advice.beyond.around} == {
        "baseline 0.05 m, tilt 20 deg", "baseline 0.09 m, tilt 20 deg", "baseline 0.3 m, tilt 20 deg",
        "baseline 0.09 m", "baseline 0.09 m, tilt 40 deg",
    }  # fmt: skip
    data = advice_json(advice)
    assert data["beyond"]["axes"]["tilt"] == {"value": pytest.approx(20.0), "inside": True}
    assert data["inside"]
    assert "The rig lies inside the maps; the filter is consistent in all 12 cells" in sentences_of(advice)[0]


@pytest.mark.parametrize(("bad", "sure"), [
    (lambda at: "biased" if at[3] == 3 else "consistent", "fairly sure"),  # a neighbour
    (lambda at: "biased" if at[3] == 0 else "consistent", "sure"),  # the other way
    (lambda at: "biased" if at[3] == 2 and at[0] == 1 else "consistent", None),  # the cell itself
])  # fmt: skip
def test_cells_of_the_second_map_count(
    regime: Regime, monkeypatch: pytest.MonkeyPatch, bad: Callable[[tuple[int, ...]], str], sure: str | None
) -> None:
    best = advised(regime, beyond(bad), monkeypatch, tilt=20.0).best
    assert (None if best is None else best.sure) == sure


def test_a_filter_that_the_second_map_lacks_is_unsure(regime: Regime, monkeypatch: pytest.MonkeyPatch) -> None:
    found = {(cell, "ukf-uvd" if n == "parked-ekf-uvd" else n): r for (cell, n), r in regime.results.items()}
    advice = advised(replace(regime, results=found), beyond(), monkeypatch, tilt=20.0)
    assert (advice.best.filter, advice.best.sure) == ("ukf-uvd", "unsure")


def test_a_rig_that_the_first_map_holds_needs_no_second(regime: Regime, monkeypatch: pytest.MonkeyPatch) -> None:
    advice = advised(regime, beyond(lambda _: "biased"), monkeypatch)
    assert advice.beyond is None
    assert advice.best.sure == "sure"


def test_a_camera_off_centre_is_unlike_both_maps(regime: Regime, monkeypatch: pytest.MonkeyPatch) -> None:
    mount = {"position": (0.3, 0.0, 0.5), "rotation": (0.0, 0.0, 0.0)}
    scenario = varied().variant("off", truth__sensor__mount=mount, belief__sensor__mount=mount, truth__path__speed=1.0)
    Said(monkeypatch, parked_ekf_uvd="consistent")
    monkeypatch.setattr(rigs, "load_scenario", lambda _: scenario)
    advice = recommend_for(Request("off"), regime, jobs=1, alone=beyond())
    assert advice.unlike == ("truth.sensor.mount.position", "belief.sensor.mount.position")
    assert advice.best.sure == "unsure"


def test_maps_that_are_given(tmp_path: Path) -> None:
    """The shipped ones, one of a grid, or that and one of axes that vary alone."""
    first, second = maps.read_maps()
    assert first.sweep.name == "regime"
    assert second.missing == 0
    assert second.sweep.axes == load_sweep("beyond").axes
    (tmp_path / "map.json").write_text(maps.dumped(first))
    (tmp_path / "alone.json").write_text(maps.dumped(second))
    one, two = tmp_path / "map.json", tmp_path / "alone.json"
    assert maps.read_maps([one])[1] is None
    both = maps.read_maps([one, two])[1]
    assert both.results.keys() == second.results.keys()
    with pytest.raises(InputError, match=r"map.json: the second map must be of a sweep with a table 'alone'"):
        maps.read_maps([two, one])
    with pytest.raises(InputError, match="at most two"):
        maps.read_maps([one, two, two])


def test_a_contradicted_filter_is_not_taken(regime: Regime) -> None:
    wrong, right, plain = (advising.NearFilter(name, result(), 1, 1, sure=sure) for name, sure in (
        ("wrong", "no"), ("right", "sure"), ("plain", "")))  # fmt: skip
    assert [c.filter for c in advising._sorted([plain, wrong, right])] == ["right", "wrong", "plain"]
    advice = replace(advise(regime), candidates=(wrong, plain), runs=24)
    assert advice.best is None
    assert "No filter to trust" in sentences_of(advice)[0]


# --- the rig ------------------------------------------------------------------------------------


def test_a_sensor_is_put_into_the_map_s_world(tmp_path: Path, regime: Regime) -> None:
    path = tmp_path / "sensor.toml"
    path.write_text(SENSOR.replace("150.0", "300.0").replace("0.09", "0.12").replace("5.0", "1.5"))
    rig = read_rig(Request(str(path), range=6.0), regime.sweep.base)
    truth, belief = rig.scenario.truth, rig.scenario.belief
    assert (truth.sensor.rig, belief.sensor.f, belief.sensor.B) == ((300.0, 0.12), 300.0, 0.12)
    assert truth.sensor.image == (640, 480)  # the same field of view
    assert truth.sensor.range == (0.5, 6.0)
    assert belief.sensor.disparity == truth.sensor.disparity == pytest.approx((1.0, 32 * 300 * 0.12 / (150 * 0.09)))
    assert truth.motion.sigma_omega == belief.motion.sigma_omega == pytest.approx(np.deg2rad(1.5))
    assert truth.path == regime.sweep.base.truth.path
    assert any("speed 0.5 m/s (--speed)" in text for text in rig.assumed)
    assert not any("--range" in text for text in rig.assumed)
    advice = advise(regime, str(path), range=6.0)
    assert advice.equivalent == (0.12, pytest.approx(0.24))
    assert any("counts as 0.24 m" in note for note in notes_of(advice))


def test_the_sensor_of_a_simulated_log_is_read(tmp_path: Path, regime: Regime) -> None:
    scenario = cs.load_scenario(BASE).variant("short", truth__steps=5)
    log = tmp_path / "log"
    write_log(log, [cs.simulate(scenario)], scenario.belief, None, {"kind": "log"}, view=((320, 240), (160.0, 120.0)))
    advice = advise(regime, str(log / "sensor.toml"))
    assert advice.here.nearest.indices == (1, 2, 2, 1)
    assert advice.unlike == ("truth.sensor.principal_point",)


def test_a_sensor_that_was_characterised_is_put_into_the_world(tmp_path: Path, regime: Regime) -> None:
    """Growth and biases of its file are the case, and believed; no cell of the map is so."""
    path = tmp_path / "sensor.toml"
    tables = """
[disparity_growth]
disparity_px = [2.0, 20.0]
ratio = [1.0, 3.0]
[bias]
u_px = [-100.0, 100.0]
v_px = [0.0]
bias_d_px = [[0.5, -0.5]]
"""
    path.write_text(SENSOR + tables)
    scenario = read_rig(Request(str(path)), regime.sweep.base).scenario
    assert misbelief(scenario) == ""
    assert scenario.belief.sensor.bias is not None
    assert scenario.truth.sensor.disparity_growth == scenario.belief.sensor.disparity_growth is not None
    assert [effect.kind for effect in scenario.truth.sensor.effects] == ["local-bias"]
    d = 150.0 * 0.09 / np.mean(scenario.truth.sensor.range)
    counted = 0.09 / np.interp(d, [2.0, 20.0], [1.0, 3.0])
    assert equivalent_baseline(scenario, regime.sweep.base) == pytest.approx(counted)
    assert "truth.sensor.disparity_growth.ratio" in differences(scenario, regime.sweep)
    unbelieved = scenario.variant("unbelieved", belief__sensor__disparity_growth=None)
    assert "belief.sensor.disparity_growth.ratio" in told_otherwise(unbelieved)


def test_options_change_the_rig(regime: Regime) -> None:
    rig = read_rig(Request(BASE, range=7.0, speed=1.0, density=0.25), regime.sweep.base).scenario
    assert (rig.truth.sensor.range[1], rig.truth.path.speed, rig.truth.landmarks.count) == (7.0, 1.0, 64)
    assert advise(regime, speed=1.0).unlike == ("truth.path.speed",)
    slow = read_rig(Request(BASE, dt=0.2), regime.sweep.base).scenario.truth
    assert (slow.dt, slow.steps) == (0.2, 250)


@pytest.mark.parametrize(("rig", "said", "expected"), [
    ("herath2007-xyz", {}, "measures 'xyz', the map is of sensors 'uvd'"),
    ("nonsense", {}, "unknown scenario 'nonsense'"),
    (BASE, {"range": 0.1}, "--range 0.1: key 'truth.sensor'"),
    (BASE, {"speed": -1.0}, "--speed -1: must be a positive number"),
    (BASE, {"dt": 0.0}, "--dt 0: must be a positive number"),
    (BASE, {"density": float("nan")}, "--density nan: must be"),
])  # fmt: skip
def test_bad_rigs(regime: Regime, rig: str, said: dict[str, float], expected: str) -> None:
    with pytest.raises(InputError) as refusal:
        advise(regime, rig, **said)
    assert expected in str(refusal.value)


def test_bad_sensors_and_options(regime: Regime, tmp_path: Path) -> None:
    path = tmp_path / "sensor.toml"
    path.write_text(SENSOR.replace("B = 0.09", "B = 0.0"))
    with pytest.raises(InputError, match=r"sensor.toml: key 'B'"):
        advise(regime, str(path))
    path.write_text(SENSOR.replace('"uvd"', '"xyz"').replace("sigma_px", "sigma_m"))
    with pytest.raises(InputError, match="key 'model' is 'xyz', the map is of sensors 'uvd'"):
        advise(regime, str(path))
    with pytest.raises(InputError, match=r"--confirm 0: must be at least 1; for the map alone, .* --runs 0"):
        recommend_for(Request(BASE), regime, confirm=0)
    with pytest.raises(InputError, match="--runs 1"):
        recommend_for(Request(BASE), regime, runs=1)


def test_a_map_with_a_hole_is_refused_there(regime: Regime) -> None:
    here = advise(regime).here.nearest.number
    hole = replace(regime, results={key: found for key, found in regime.results.items() if key[0] != here})
    with pytest.raises(InputError, match=r"the map has nothing of baseline 0\.09 m"):
        advise(hole)


def test_without_a_map_it_is_said_how_to_make_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(maps, "SHIPPED", "none.json")
    with pytest.raises(InputError, match="make one with 'consistency sweep regime --out regime'"):
        read_regime()
