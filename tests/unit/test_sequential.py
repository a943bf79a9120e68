"""Looks while the runs come."""

from __future__ import annotations

import numpy as np
import pytest

import consistency as cs
from consistency.diagnostics import gate_runs, judge, sequential_design
from consistency.montecarlo import Interrupted
from consistency.sequential import run_until_decided

SHORT = {"truth__steps": 60}


@pytest.mark.parametrize("detect", [1.2, 1.5, 2.0, 0.67])
@pytest.mark.parametrize("false_alarm", [0.05, 1e-3])
def test_a_design_spends_its_rate_once(detect: float, false_alarm: float) -> None:
    design = sequential_design(3, detect, false_alarm)
    assert design.look_false_alarm * len(design.looks) == pytest.approx(false_alarm)
    assert design.looks[-1] == design.needed == gate_runs(3, detect, design.look_false_alarm)
    assert design.looks[0] >= 12 or len(design.looks) == 1
    assert all(2 * a - 1 <= b <= 2 * a for a, b in zip(design.looks, design.looks[1:], strict=False))


def test_max_runs_cuts_the_looks_and_not_what_each_costs() -> None:
    whole, cut = sequential_design(3, 1.5), sequential_design(3, 1.5, max_runs=40)
    assert cut.looks == (*(n for n in whole.looks if n < 40), 40)
    assert cut.look_false_alarm == whole.look_false_alarm
    assert cut.needed == whole.needed
    assert sequential_design(3, 1.5, max_runs=1000).looks == whole.looks
    with pytest.raises(ValueError, match="max_runs"):
        sequential_design(3, 1.5, max_runs=0)


def test_nothing_found_too_early_is_undecided() -> None:
    design = sequential_design(3, 1.5)
    rng = np.random.default_rng()
    verdicts = [judge("f", nees=rng.chisquare(3, (runs, 20)), dof=3, false_alarm=1e-6) for runs in (20, design.needed)]
    early, late = (design.settle(v) for v in verdicts)
    assert early.status == "undecided"
    assert str(design.needed) in early.reasons[0]
    assert late.status == "consistent"
    bad = judge("f", nees=rng.chisquare(3, (20, 20)) * 9, dof=3)
    assert design.settle(bad) is bad


def test_stereo_points_stop_after_the_first_look() -> None:
    results, verdicts = run_until_decided(cs.load_scenario("herath2007-stereo"), ["ekf-xyz"], seed=11)
    assert verdicts["ekf-xyz"].status == "overconfident"
    assert results.manifest["runs"] == sequential_design(3).looks[0]


def test_runs_are_those_of_a_plain_run_and_the_plan_is_kept() -> None:
    scenario = cs.load_scenario("linear-gaussian").variant("short", **SHORT)
    results, verdicts = run_until_decided(scenario, ["kf"], false_alarm=1e-6, max_runs=20)
    assert verdicts["kf"].status == "undecided"
    plain = cs.run_trials(scenario, ["kf"], runs=20)
    assert results.estimates.equals(plain.estimates)
    again = cs.analyse(results)["kf"]
    assert again.status == "undecided"
    assert again.statistics["false_alarm"] == sequential_design(3, false_alarm=1e-6).look_false_alarm
    assert cs.analyse(results, confidence=1 - 1e-6)["kf"].status == "consistent"  # asked for another judgement


def test_an_interrupted_plan_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    from consistency import montecarlo

    scenario = cs.load_scenario("linear-gaussian").variant("short", **SHORT)
    one, calls = montecarlo._one, []

    def stop_late(*arguments: object) -> object:
        calls.append(1)
        if len(calls) > 25:
            raise KeyboardInterrupt
        return one(*arguments)

    options = {"false_alarm": 1e-6, "max_runs": 40, "jobs": 1}
    monkeypatch.setattr(montecarlo, "_one", stop_late)
    with pytest.raises(Interrupted) as stopped:
        run_until_decided(scenario, ["kf"], **options)
    monkeypatch.setattr(montecarlo, "_one", one)
    results, _ = run_until_decided(scenario, ["kf"], previous=stopped.value.results, **options)
    assert results.estimates.equals(cs.run_trials(scenario, ["kf"], runs=40).estimates)
