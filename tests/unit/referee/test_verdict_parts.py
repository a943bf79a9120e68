"""Records: what settings refuse, and what a verdict's properties are made of."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from draws import identities, independent, verdict_on

from consistency.referee.diagnostics import Answer, Equivalence, Evidence, Interval, Settings, Verdict, judge
from consistency.referee.diagnostics.records.skipping import Skip, Skipped
from consistency.referee.diagnostics.verdict import parts
from consistency.referee.diagnostics.verdict.answers import ABOUT, JOINT, JOINT_DISTRIBUTION, MAIN, SHARES, answers
from consistency.referee.diagnostics.verdict.parts import Innovations
from consistency.referee.types import Array

# --- settings ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("option", "values"),
    [
        ("false_alarm", [0.0, 1.0, -0.1, 2.0, float("nan")]),
        ("power", [0.0, 1.0, 1.5, float("nan")]),
        ("detect", [0.0, 1.0, -2.0, float("inf"), float("nan")]),
        ("tolerance", [0.0, 1.0, -2.0, float("inf"), float("nan")]),
        ("allow", ["overconfident", "", "Conservative"]),
        ("method", ["sidak", "", "MAX"]),
    ],
)
def test_settings_out_of_range_are_refused_by_name(option: str, values: list[Any]) -> None:
    for value in values:
        with pytest.raises(ValueError, match=f"^{option} must"):
            Settings(**{option: value})


def test_settings_at_their_limits_are_taken() -> None:
    for options in (
        {"false_alarm": 1e-12},
        {"power": 0.999999},
        {"detect": 1.001},
        {"tolerance": 0.5},
        {"allow": None},
    ):
        assert Settings(**options)


def test_ratios_below_one_count_as_their_inverse() -> None:
    assert Settings(detect=0.5).factor == Settings(detect=2.0).factor == 2.0
    assert Settings(tolerance=0.8).tolerated == pytest.approx(1.25)
    assert Settings(tolerance=1.25).tolerated == 1.25
    assert Settings().tolerated == 1.0
    assert Settings().factor == 1.5


# --- intervals ------------------------------------------------------------------------------------------


def test_an_interval_holds_what_lies_inside() -> None:
    interval = Interval(2.0, 1.0, 3.0)
    assert [interval.holds(x) for x in (0.99, 1.0, 2.0, 3.0, 3.01)] == [False, True, True, True, False]
    assert not Interval(1.0, float("nan"), 3.0).holds(2.0)
    assert not Interval(1.0, 1.0, float("nan")).holds(2.0)


def test_equivalence_is_shown_at_its_level() -> None:
    assert Equivalence(1.5, 0.05, 0.05, None).shown
    assert not Equivalence(1.5, 0.0501, 0.05, None).shown
    assert not Equivalence(1.5, float("nan"), 0.05, None).shown


# --- the verdict ----------------------------------------------------------------------------------------


def of(*given: Answer, **more: Any) -> Verdict:
    return Verdict("f", "inconsistent", ("inconsistent: so",), 3, 4, Settings(), given, **more)


def test_faults_are_what_was_found_and_not_tolerated() -> None:
    verdict = of(
        Answer("scale", 1e-9, 0.5, 1e-9, True, tolerated=True),
        Answer("bias", 1e-9, 0.1, 1e-8, True),
        Answer("shape", 0.3, 0.4, 0.6, False),
    )
    assert verdict.faults == ("bias",)
    assert verdict.p_value == pytest.approx(1e-8)  # of the bias, over its share


def test_the_p_value_is_the_least_over_its_share() -> None:
    """The rate at which the first question would just be found; Holm has nothing to give it yet."""
    verdict = of(Answer("scale", 0.02, 0.5, 0.04, True), Answer("bias", 0.01, 0.05, 0.1, False))
    assert verdict.p_value == pytest.approx(0.04)
    assert of(Answer("scale", 0.9, 0.5, 1.0, False)).p_value == 1.0
    assert np.isnan(of().p_value)
    found = answers({"scale": 0.2, "bias": 0.004, "outliers": 0.5}, 0.05)
    whole = of(*found.values())
    assert whole.p_value == pytest.approx(min(a.adjusted for a in found.values()))


def test_without_truth_the_numbers_are_those_of_the_innovations() -> None:
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


def test_with_truth_they_are_those_of_the_errors() -> None:
    rng = np.random.default_rng(1)
    error = 1.5 * independent(rng, 40, 5, 2)
    nis = {"nis": rng.chisquare(2, (40, 5)), "nis_dof": np.full((40, 5), 2)}
    verdict = judge(Evidence("f", error, identities(error), **nis))
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


def test_scale_counts_the_steps_that_are_judged() -> None:
    error = independent(np.random.default_rng(2), 10, 6, 2)
    error[:, 4] = np.nan
    error[3:, 2] = np.nan
    verdict = verdict_on(error)
    assert verdict.scale.judged_steps == 5
    assert verdict.scale.alive.tolist() == [10, 10, 3, 10, 0, 10]
    assert np.isnan(verdict.scale.anees).tolist() == [False] * 4 + [True, False]


def test_every_status_has_a_meaning_and_every_question_a_share() -> None:
    assert list(parts.STATUSES) == [
        "consistent", "overconfident", "conservative", "biased", "heavy-tailed", "inconsistent", "undecided", "failed",
    ]  # fmt: skip
    assert set(SHARES) == set(ABOUT)
    two_sided = {q: s for q, s in SHARES.items() if q not in ("scale in some direction", JOINT, JOINT_DISTRIBUTION)}
    assert SHARES[MAIN] == 0.5
    assert sum(two_sided.values()) == pytest.approx(1.0)


# --- what is given ---------------------------------------------------------------------------------------


def arrays(*shapes: tuple[int, ...]) -> list[Array]:
    return [np.ones(shape) for shape in shapes]


@pytest.mark.parametrize(
    ("given", "message"),
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
def test_arrays_that_do_not_fit_are_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        judge(Evidence("f", **given))


@pytest.mark.parametrize("index", [[], [2], [-1], [0, 0]])
def test_subsets_that_do_not_fit_are_refused(index: list[int]) -> None:
    error = np.ones((3, 4, 2))
    with pytest.raises(ValueError, match="subset 'odd'"):
        judge(Evidence("f", error, identities(error)), Settings(subsets={"odd": index}))


def test_nothing_that_is_given_is_changed() -> None:
    rng = np.random.default_rng(3)
    error = independent(rng, 25, 4, 3)
    error[2, 1] = np.nan
    covariance, nees = identities(error).copy(), np.square(error).sum(axis=-1)
    before = [error.copy(), covariance.copy(), nees.copy()]
    judge(Evidence("f", error, covariance, nees=nees), Settings(subsets={"two": [0, 2]}))
    for old, new in zip(before, [error, covariance, nees], strict=True):
        np.testing.assert_array_equal(old, new)


# --- evidence ------------------------------------------------------------------------------------------


def test_steps_without_full_rank_are_counted_from_one(rng: np.random.Generator) -> None:
    error, nees = independent(rng, 3, 6, 2), np.ones((3, 6))
    nees[0, :2] = nees[1, 3] = nees[2, 5] = np.nan
    error[2, 5] = np.nan  # a run that has ended
    evidence = Evidence("f", error, nees=nees)
    assert evidence.left_out_steps == [1, 2, 4]
    assert replace(evidence, skipped=Skipped(Skip(1.0), 1)).left_out_steps == [2, 4]
    assert Evidence("f", nees=nees, dof=2).left_out_steps == []
