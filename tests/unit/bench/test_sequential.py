"""Looks while the runs come."""

import consistency as cs
from consistency.bench.runs.montecarlo import run_until_decided

FAULTY, OPEN = "ekf-xyz", "ekf-uvd"  # points from stereo as Gaussian: a gross fault; pixels: none that few runs show
PLAN = {"false_alarm": 1e-6, "max_runs": 40, "seed": 11}


def test_an_early_decision_is_kept_while_another_filter_is_open():
    """The verdict is that of the runs at which the filter was decided, as if it had been alone.

    Which runs are drawn does not depend on the filters or looks, so there is no chance in the comparison.
    """
    scenario = cs.load_scenario("herath2007-stereo").variant("short", truth__steps=60)
    alone, verdicts_alone = run_until_decided(scenario, [FAULTY], **PLAN)
    both, verdicts = run_until_decided(scenario, [FAULTY, OPEN], **PLAN)
    early, kept = verdicts_alone[FAULTY], verdicts[FAULTY]
    assert early.status not in ("consistent", "undecided")
    assert verdicts[OPEN].status in ("consistent", "undecided")
    assert both.manifest["runs"] > alone.manifest["runs"]  # it went on for the other one
    assert (kept.status, kept.inflation, kept.reasons) == (early.status, early.inflation, early.reasons)
    later = cs.analyse(both, [FAULTY], confidence=0.95)[FAULTY]  # negative control: all runs say it in other numbers
    assert later.inflation != early.inflation
