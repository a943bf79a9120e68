"""A sensor's file in the world of a scenario."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import consistency as cs
from consistency.bench.scenario import misbelief
from consistency.bench.store.log import write_log
from consistency.bench.sweeps import regime as maps
from consistency.bench.sweeps.regime import read_regime
from consistency.bench.sweeps.rig import read_rig
from consistency.referee.errors import InputError

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


@pytest.fixture
def world() -> cs.Scenario:
    return cs.load_scenario(BASE)


def test_a_sensor_is_put_into_the_world(tmp_path: Path, world: cs.Scenario) -> None:
    path = tmp_path / "sensor.toml"
    path.write_text(SENSOR.replace("150.0", "300.0").replace("0.09", "0.12").replace("5.0", "1.5"))
    rig = read_rig(path, world)
    truth, belief = rig.truth, rig.belief
    assert (truth.sensor.rig, belief.sensor.f, belief.sensor.B) == ((300.0, 0.12), 300.0, 0.12)
    assert truth.sensor.image == (640, 480), "the same field of view"
    assert belief.sensor.disparity == truth.sensor.disparity == pytest.approx((1.0, 32 * 300 * 0.12 / (150 * 0.09)))
    assert truth.motion.sigma_omega == belief.motion.sigma_omega == pytest.approx(np.deg2rad(1.5))
    assert truth.path == world.truth.path


def test_the_sensor_of_a_simulated_log_is_read(tmp_path: Path, world: cs.Scenario) -> None:
    scenario = world.variant("short", truth__steps=5)
    log = tmp_path / "log"
    write_log(log, [cs.simulate(scenario)], scenario.belief, None, {"kind": "log"}, view=((320, 240), (160.0, 120.0)))
    rig = read_rig(log / "sensor.toml", world)
    assert rig.truth.sensor.principal_point == (160.0, 120.0)
    assert rig.truth.sensor.sigma == world.truth.sensor.sigma


def test_a_sensor_that_was_characterised_is_put_into_the_world(tmp_path: Path, world: cs.Scenario) -> None:
    """Growth and biases of its file are the truth, and believed."""
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
    scenario = read_rig(path, world)
    assert misbelief(scenario) == ""
    assert scenario.belief.sensor.bias is not None
    assert scenario.truth.sensor.disparity_growth == scenario.belief.sensor.disparity_growth is not None
    assert [effect.kind for effect in scenario.truth.sensor.effects] == ["local-bias"]


def test_bad_sensors(tmp_path: Path, world: cs.Scenario) -> None:
    path = tmp_path / "sensor.toml"
    path.write_text(SENSOR.replace("B = 0.09", "B = 0.0"))
    with pytest.raises(InputError, match=r"sensor.toml: key 'B'"):
        read_rig(path, world)
    path.write_text(SENSOR.replace('"uvd"', '"xyz"').replace("sigma_px", "sigma_m"))
    with pytest.raises(InputError, match="key 'model' is 'xyz', the world's sensor is 'uvd'"):
        read_rig(path, world)
    path.unlink()
    with pytest.raises(InputError, match=r"sensor\.toml"):
        read_rig(path, world)


def test_without_a_map_it_is_said_how_to_make_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(maps, "SHIPPED", "none.json")
    with pytest.raises(InputError, match="make one with 'consistency sweep regime --out regime'"):
        read_regime()


def test_the_table_of_docs_is_the_shipped_map() -> None:
    """docs/regime.md names the cheapest filter that is consistent in all cells of a baseline and a range."""
    table = read_regime().table
    rows = table.assign(right=table["status"] == "consistent").groupby(["baseline", "range", "filter"])
    cells = rows.agg(right=("right", "all"), cost=("cost", "median")).reset_index()
    cheapest = cells[cells["right"]].sort_values("cost").groupby(["baseline", "range"])["filter"].first().unstack()
    page = (Path(__file__).parents[3] / "docs" / "regime.md").read_text(encoding="utf-8")
    for baseline, row in cheapest.iterrows():
        names = (f"`{name}`" if isinstance(name, str) else "none" for name in row)
        assert f"| {baseline:g} m | {' | '.join(names)} |" in page
