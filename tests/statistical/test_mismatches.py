"""Five of a hundred disparities are mismatches: what that does to a filter, with a guard and without."""

import pytest
from mismatch import WrongMatch

import consistency as cs
from consistency.bench.scenario.effects import EFFECTS
from consistency.diagnostics import Settings

pytestmark = pytest.mark.slow
RATE = 1e-6  # at which the referee may find a fault in a filter that has none
NAMES = ["parked-ekf-uvd", "parked-ekf-uvd+gate", "parked-ekf-uvd+joint", "parked-ekf-uvd+ransac"]


@pytest.fixture(scope="module")
def verdicts():
    EFFECTS["wrong-match"] = WrongMatch
    scenario = cs.load_scenario("herath2007-stereo").variant(
        "wrong", truth__sensor__effects=[{"kind": "wrong-match", "rate": 0.05}]
    )
    yield cs.analyse(cs.run_trials(scenario, NAMES, runs=24, seed=77), settings=Settings(false_alarm=RATE))
    del EFFECTS["wrong-match"]


def test_mismatches_break_a_consistent_filter(verdicts):
    assert verdicts["parked-ekf-uvd"].status == "overconfident"


@pytest.mark.parametrize("name", NAMES[1:])
def test_a_guard_keeps_it_honest(verdicts, name):
    guarded, open_ = verdicts[name], verdicts["parked-ekf-uvd"]
    assert guarded.status in ("consistent", "undecided")
    assert guarded.accuracy.rmse_position < 0.5 * open_.accuracy.rmse_position
    assert guarded.rejection.recall.low > 0.7
