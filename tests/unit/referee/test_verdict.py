"""The referee on cases whose answer is known, what its settings refuse, and what the properties of a verdict are."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from draws import autoregression, identities, independent, verdict_on
from records import changed
from referee import judge
from scipy import stats

import consistency as cs
from consistency.diagnostics import (
    Answer,
    Equivalence,
    Interval,
    Settings,
    Verdict,
    anees_interval,
    make_record,
)
from consistency.diagnostics import judge as judge_evidence
from consistency.referee.diagnostics import verdict_parts as parts
from consistency.referee.diagnostics.record import Skip, Skipped
from consistency.referee.diagnostics.verdict_parts import (
    ABOUT,
    GROUP,
    JOINT,
    JOINT_DISTRIBUTION,
    MAIN,
    SHARES,
    Innovations,
    answers,
)
from consistency.referee.types import Array, Failure

RUNS, STEPS = 50, 40
# a calibrated case is found at fault with probability 1e-5 at most; the other cases are so far off that they are
# missed with less than 1e-5
FALSE_ALARM = 1e-5
BROKE = Failure("f", 3, 12, "LinAlgError: singular")


@dataclass(frozen=True)
class Case:
    error: Array
    covariance: Array
    nees: Array
    nis: Array
    nis_dof: Array

    def verdict(self, failures=(), false_alarm=FALSE_ALARM, **options):
        return judge(
            "f", self.error, self.covariance, nees=self.nees, nis=self.nis, nis_dof=self.nis_dof, failures=failures,
            false_alarm=false_alarm, **{"optimal_gain": True, **options},
        )  # fmt: skip


def make(scale=1.0):
    """Errors of covariance P that a filter calls P / scale.

    Steps of a run are as dependent as those of a filter: an autoregression with coefficient 0.9.
    """
    rng = np.random.default_rng(5)
    e = autoregression(rng, RUNS, STEPS, 3, 0.9)
    P = np.array([[0.04, 0.01, 0.001], [0.01, 0.09, -0.002], [0.001, -0.002, 0.003]])
    error = e @ np.linalg.cholesky(P).T
    covariance = np.broadcast_to(P / scale, (RUNS, STEPS, 3, 3)).copy()
    nis_dof = rng.integers(0, 4, (RUNS, STEPS)) * 3
    nis = np.where(nis_dof > 0, scale * rng.chisquare(np.maximum(nis_dof, 1)), np.nan)
    return Case(error, covariance, cs.nees(error, covariance), nis, nis_dof)


def broken():
    """A right case with nothing from where ``BROKE`` on."""
    arrays = {name: value.copy() for name, value in vars(make()).items()}
    for name, array in arrays.items():
        array[BROKE.run, BROKE.step - 1 :] = 0 if name == "nis_dof" else np.nan
    return Case(**arrays)


# --- with truth ----------------------------------------------------------------------------------


def test_statistics_of_a_calibrated_filter():
    case = make()
    s = case.verdict(false_alarm=0.05).statistics
    assert (s["runs"], s["steps"], s["dof"], s["judged_steps"], s["left_out_steps"]) == (RUNS, STEPS, 3, STEPS, [])
    assert np.allclose(s["anees"], case.nees.mean(axis=0))
    assert s["band"][0] == pytest.approx(anees_interval(3, RUNS))
    inside = (s["anees"] >= s["band"][:, 0]) & (s["anees"] <= s["band"][:, 1])
    assert s["share_inside"] == pytest.approx(inside.mean())
    assert s["rmse_position"] != s["rmse_position"]  # the axes have no names
    named = case.verdict(axes=("x", "y", "heading")).statistics
    assert named["rmse_position"] == pytest.approx(np.sqrt(np.mean(np.sum(case.error[..., :2] ** 2, axis=-1))))
    assert named["rmse_heading"] == pytest.approx(np.sqrt(np.mean(case.error[..., 2] ** 2)))
    assert s["nis_dof"] == case.nis_dof.sum()


def test_nees_is_worked_out_from_error_and_covariance():
    case = make(scale=2.0)
    alone = judge("f", case.error, case.covariance, false_alarm=FALSE_ALARM)
    lied = judge("f", case.error, case.covariance, nees=case.nees / 2, false_alarm=FALSE_ALARM)
    for verdict in (alone, lied):
        assert verdict.statistic == pytest.approx(case.nees.mean())
        assert verdict.status == "overconfident"


def test_bonferroni_band_over_all_steps():
    """Its share of the false-alarm rate, as Holm's first step gives it, over the steps and two sides."""
    s = make().verdict(false_alarm=0.1, method="bonferroni").statistics
    share = next(a["share"] for a in s["answers"] if a["question"] == "scale in some step")
    tail = stats.chi2.sf(s["simultaneous"][0, 1] * RUNS, 3 * RUNS)
    assert tail == pytest.approx(0.1 * share / STEPS / 2, rel=1e-6)
    assert np.all(s["simultaneous"][:, 0] < s["band"][:, 0])
    assert np.all(s["simultaneous"][:, 1] > s["band"][:, 1])


# --- steps and runs left out -----------------------------------------------------------------------


def test_a_run_that_fails_midway_counts_only_before():
    s = broken().verdict((BROKE,)).statistics
    assert np.array_equal(s["alive"], [RUNS] * 11 + [RUNS - 1] * (STEPS - 11))
    assert s["left_out_steps"] == []
    # fewer runs, wider band
    assert s["band"][11, 1] > s["band"][10, 1]
    assert s["band"][11] == pytest.approx(anees_interval(3, RUNS - 1))


# --- without truth ---------------------------------------------------------------------------------


def blind(case, **options):
    arrays = {"nis": case.nis, "nis_dof": case.nis_dof}
    return judge("f", None, case.covariance, **arrays, **{"optimal_gain": True, "false_alarm": FALSE_ALARM, **options})


@pytest.mark.parametrize("scale, status", [(1.0, "consistent"), (1.3, "overconfident"), (0.7, "conservative")])
def test_without_truth_the_nis_is_judged(scale, status):
    verdict = blind(make(scale=scale))
    assert verdict.status == status
    assert "no truth" in verdict.reasons[0]
    assert "mean_anees" not in verdict.statistics
    assert verdict.statistics["nis_ratio"] == pytest.approx(scale, rel=0.06)
    assert verdict.statistic == verdict.statistics["nis_ratio"]


def test_without_truth_a_failed_run_counts_too():
    verdict = blind(broken(), failures=(BROKE,))
    assert verdict.status == "failed"
    assert verdict.reasons[0] == "failed: 1 of 50 runs failed, first run 3 in step 12: LinAlgError: singular"


def test_without_truth_and_innovations_there_is_no_verdict():
    case = make()
    verdict = blind(replace(case, nis=np.full_like(case.nis, np.nan)))
    assert verdict.status == "failed"
    assert "neither truth nor innovations" in verdict.reasons[0]


# --- settings ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "option, values",
    [
        ("false_alarm", [0.0, 1.0, -0.1, 2.0, float("nan")]),
        ("power", [0.0, 1.0, 1.5, float("nan")]),
        ("detect", [0.0, 1.0, -2.0, float("inf"), float("nan")]),
        ("tolerance", [0.0, 1.0, -2.0, float("inf"), float("nan")]),
        ("allow", ["overconfident", "", "Conservative"]),
        ("method", ["sidak", "", "MAX"]),
    ],
)
def test_settings_out_of_range_are_refused_by_name(option, values):
    for value in values:
        with pytest.raises(ValueError, match=f"^{option} must"):
            Settings(**{option: value})


def test_ratios_below_one_count_as_their_inverse():
    assert Settings(detect=0.5).factor == Settings(detect=2.0).factor == 2.0
    assert Settings(tolerance=0.8).tolerated == pytest.approx(1.25)
    assert Settings(tolerance=1.25).tolerated == 1.25
    assert Settings().tolerated == 1.0
    assert Settings().factor == 1.5


# --- intervals ------------------------------------------------------------------------------------------


def test_an_interval_holds_what_lies_inside():
    interval = Interval(2.0, 1.0, 3.0)
    assert [interval.holds(x) for x in (0.99, 1.0, 2.0, 3.0, 3.01)] == [False, True, True, True, False]
    assert not Interval(1.0, float("nan"), 3.0).holds(2.0)
    assert not Interval(1.0, 1.0, float("nan")).holds(2.0)


def test_equivalence_is_shown_at_its_level():
    assert Equivalence(1.5, 0.05, 0.05, None).shown
    assert not Equivalence(1.5, 0.0501, 0.05, None).shown
    assert not Equivalence(1.5, float("nan"), 0.05, None).shown


# --- the verdict ----------------------------------------------------------------------------------------


def of(*given, **more):
    return Verdict("f", "inconsistent", 3, 4, Settings(), given, reasons=("inconsistent: so",), **more)


def test_faults_are_what_was_found_and_not_tolerated():
    verdict = of(
        Answer("scale", 1e-9, 0.5, 1e-9, True, tolerated=True),
        Answer("bias", 1e-9, 0.1, 1e-8, True),
        Answer("shape", 0.3, 0.4, 0.6, False),
    )
    assert verdict.faults == ("bias",)
    assert verdict.p_value == pytest.approx(1e-8)  # of the bias, over its share


def test_the_p_value_is_the_least_over_its_share():
    """The rate at which the first question would just be found; Holm has nothing to give it yet."""
    verdict = of(Answer("scale", 0.02, 0.5, 0.04, True), Answer("bias", 0.01, 0.05, 0.1, False))
    assert verdict.p_value == pytest.approx(0.04)
    assert of(Answer("scale", 0.9, 0.5, 1.0, False)).p_value == 1.0
    assert np.isnan(of().p_value)
    found = answers({"scale": 0.2, "bias": 0.004, "outliers": 0.5}, 0.05)
    whole = of(*found.values())
    assert whole.p_value == pytest.approx(min(a.adjusted for a in found.values()))


def test_without_truth_the_numbers_are_those_of_the_innovations():
    shown = Equivalence(1.5, 0.01, 0.05, None)
    verdict = of(innovations=Innovations(1.2, (0.9, 1.1), 400, True, np.zeros(2), 0.1, shown))
    assert verdict.statistic == 1.2
    assert verdict.threshold == (0.9, 1.1)
    assert verdict.equivalence is shown
    assert np.isnan([verdict.inflation, *verdict.inflation_interval]).all()
    assert (verdict.first_step, verdict.subset) == (None, None)
    nothing = of()
    assert np.isnan([nothing.statistic, *nothing.threshold, nothing.inflation]).all()
    assert nothing.equivalence is None


def test_with_truth_they_are_those_of_the_errors():
    rng = np.random.default_rng(1)
    error = 1.5 * independent(rng, 40, 5, 2)
    nis = {"nis": rng.chisquare(2, (40, 5)), "nis_dof": np.full((40, 5), 2)}
    verdict = judge_evidence(make_record("f", error, identities(error), **nis))
    nees = np.square(error).sum(axis=-1)
    assert verdict.statistic == pytest.approx(nees.mean())
    assert verdict.threshold == verdict.scale.accepted
    assert verdict.inflation == pytest.approx(nees.mean() / 2)
    assert verdict.inflation_interval == tuple(verdict.scale.inflation[1:])
    assert verdict.inflation_interval[0] < verdict.inflation < verdict.inflation_interval[1]
    assert verdict.equivalence is verdict.scale.equivalence
    assert verdict.first_step == verdict.location.first_step
    assert not verdict.consistent
    assert replace(verdict, status="consistent").consistent


def test_scale_counts_the_steps_that_are_judged():
    error = independent(np.random.default_rng(2), 10, 6, 2)
    error[:, 4] = np.nan
    error[3:, 2] = np.nan
    verdict = verdict_on(error)
    assert verdict.scale.judged_steps == 5
    assert verdict.scale.alive.tolist() == [10, 10, 3, 10, 0, 10]
    assert np.isnan(verdict.scale.anees).tolist() == [False] * 4 + [True, False]


def test_every_status_has_a_meaning_and_every_question_a_share():
    assert list(parts.STATUSES) == [
        "consistent", "overconfident", "conservative", "biased", "heavy-tailed", "inconsistent", "undecided", "failed",
    ]  # fmt: skip
    assert set(SHARES) == set(ABOUT)
    two_sided = {
        q: s for q, s in SHARES.items() if q not in ("scale in some direction", JOINT, JOINT_DISTRIBUTION, GROUP)
    }
    assert SHARES[MAIN] == 0.5
    assert sum(two_sided.values()) == pytest.approx(1.0)


# --- what is given ---------------------------------------------------------------------------------------


def arrays(*shapes):
    return [np.ones(shape) for shape in shapes]


@pytest.mark.parametrize(
    "given, message",
    [
        ({}, "nothing to judge"),
        ({"covariance": np.ones((3, 4, 2, 2))}, "nothing to judge"),
        ({"nees": np.ones(3), "dof": 1}, r"nees must be \(runs, steps\)"),
        ({"error": np.ones((3, 4)), "covariance": np.ones((3, 4, 2, 2))}, r"error must be \(runs, steps, n\)"),
        ({"error": np.ones((3, 4, 2)), "covariance": np.ones((3, 4, 3, 3))}, "do not fit"),
        ({"error": np.ones((3, 4, 2)), "covariance": np.ones((3, 5, 2, 2))}, "runs and steps differ"),
        ({"nees": np.ones((3, 4))}, "nees needs dof"),
        ({"error": np.ones((3, 4, 2)), "covariance": np.ones((3, 4, 2, 2)), "axes": ["x"]}, "1 names of axes for 2"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        judge_evidence(make_record("f", **given))


@pytest.mark.parametrize("index", [[], [2], [-1], [0, 0]])
def test_subsets_that_do_not_fit_are_refused(index):
    error = np.ones((3, 4, 2))
    with pytest.raises(ValueError, match="subset 'odd'"):
        judge_evidence(make_record("f", error, identities(error)), Settings(subsets={"odd": index}))


# --- evidence ------------------------------------------------------------------------------------------


def test_steps_without_full_rank_are_counted_from_one(rng):
    error, nees = independent(rng, 3, 6, 2), np.ones((3, 6))
    nees[0, :2] = nees[1, 3] = nees[2, 5] = np.nan
    error[2, 5] = np.nan  # a run that has ended
    evidence = make_record("f", error, nees=nees)
    assert evidence.left_out_steps == [1, 2, 4]
    assert changed(evidence, skipped=Skipped(Skip(1.0), 1)).left_out_steps == [2, 4]
    assert make_record("f", nees=nees, dof=2).left_out_steps == []
