"""Looks while the runs come."""

from itertools import islice

import numpy as np
import pytest
from scipy import stats

import consistency as cs
from consistency.bench.runs.run_until_decided import run_until_decided
from consistency.diagnostics import Record, follow, look, sequential_design

SHORT = {"truth__steps": 60}


def first(design, count):
    return list(islice(design.inspections(), count))


def test_a_design_spends_its_rate_once():
    """1/2 + 1/6 + 1/12 + ... adds to 1; looks double, and the scale is looked at four times on the way."""
    inspections = first(sequential_design(3), 41)
    looks = [(runs, spent) for runs, spent in inspections if spent is not None]
    assert [runs for runs, _ in looks] == [12 * 2**j for j in range(11)]
    assert [spent for _, spent in looks] == pytest.approx([1 / ((j + 1) * (j + 2)) for j in range(11)])
    assert sum(spent for _, spent in looks) == pytest.approx(1.0 - 1 / 12)
    assert [runs for runs, _ in inspections[:9]] == [12, 15, 18, 21, 24, 30, 36, 42, 48]


@pytest.mark.parametrize("last", [1, 12, 13, 24, 40, 42])
def test_max_runs_is_the_last_look_and_asks_everything(last):
    cut = list(sequential_design(3, max_runs=last).inspections())
    whole = [(runs, spent) for runs, spent in first(sequential_design(3), 20) if runs < last]
    assert cut[:-1] == whole
    assert cut[-1][0] == last
    assert cut[-1][1] is not None
    assert sum(spent for _, spent in cut if spent) <= 1.0


@pytest.mark.parametrize("options", [{"max_runs": 0}, {"dof": 0}, {"detect": 1.0}, {"false_alarm": 2.0}])
def test_a_design_that_cannot_be_is_refused(options):
    with pytest.raises(ValueError, match="must"):
        sequential_design(**{"dof": 3, **options})


def nees(values):
    return lambda runs: Record("f", nees=values[:runs], dof=3)


def test_consistent_is_said_at_a_look_and_a_fault_at_once():
    """Run means as chi-square(60) / 60 has them, at its quantiles; a false alarm at 1e-6, or a miss, has no chance."""
    quantiles = stats.chi2.ppf((np.random.default_rng(3).permutation(200) + 0.5) / 200, 60) / 20
    values = np.repeat(quantiles[:, None], 20, axis=1)
    design = sequential_design(3, false_alarm=1e-6)
    verdict, runs = follow(design, nees(values))
    assert verdict.status == "consistent"
    assert runs in (24, 48, 96)
    early = look(design, nees(values)(42), None)
    assert early.status == "undecided"
    assert early.faults == ()
    bad, used = follow(sequential_design(3), nees(values * 3.0))
    assert (bad.status, "scale" in bad.faults) == ("overconfident", True)
    assert used < 48
    small, used = follow(sequential_design(3), nees(values * 0.3))
    assert (small.status, "scale" in small.faults) == ("conservative", True)
    assert used < 96
    stopped, used = follow(design, nees(values), limit=15)
    assert (stopped.status, used) == ("undecided", 15)


def test_an_early_decision_stands():
    """What later runs would say does not matter: the last of these would take the fault back."""
    values = np.full((96, 20), 3.0)
    values[:12] = 9.0
    values[12:] = 0.5
    verdict, used = follow(sequential_design(3), nees(values))
    assert (verdict.status, used) == ("overconfident", 12)
    assert follow(sequential_design(3), nees(values), limit=96)[0].status == "overconfident"


def test_other_questions_are_asked_at_looks_only():
    rng = np.random.default_rng()
    error = rng.standard_normal((18, 5, 3)) + np.array(
        [9.0, 0.0, 0.0]
    )  # and no scale at fault: the covariance holds the bias
    evidence = Record("f", error, np.broadcast_to(np.diag([82.0, 1.0, 1.0]), (18, 5, 3, 3)))
    assert "bias" in look(sequential_design(3), evidence, 0.5).faults
    assert look(sequential_design(3), evidence, None).faults == ()


def test_runs_are_those_of_a_plain_run_and_the_plan_is_kept():
    scenario = cs.load_scenario("linear-gaussian").variant("short", **SHORT)
    results, verdicts = run_until_decided(scenario, ["kf"], detect=1.05, false_alarm=1e-6, max_runs=20)
    assert verdicts["kf"].status == "undecided"
    plain = cs.run_trials(scenario, ["kf"], runs=20)
    assert results.estimates.equals(plain.estimates)
    again = cs.analyse(results)["kf"]
    assert again.reasons == verdicts["kf"].reasons
    other = cs.analyse(results, confidence=1 - 1e-6)["kf"]  # asked for another judgement
    assert [a.p_value for a in other.answers] != [a.p_value for a in again.answers]


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
