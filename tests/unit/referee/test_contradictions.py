"""Numbers and words of one verdict that do not contradict each other."""

import re

import numpy as np
import pytest
from draws import autoregression, identities, independent, verdict_on

import consistency as cs
from consistency.diagnostics import Settings, judge, make_record
from consistency.referee.diagnostics.number_words import short

SURE = 1e-5


@pytest.mark.parametrize("begin", [20, 40, 70])
def test_a_ratio_says_the_steps_that_it_is_of(begin, rng):
    error = independent(rng, 100, 80, 3)
    error[:, begin:] *= np.sqrt(2.0)
    verdict = cs.judge(error, np.array(identities(error)), false_alarm=SURE)
    since = verdict.location.since
    assert since is not None
    assert f"true / stated since step {since}" in str(verdict)
    assert "shown inside" in str(verdict)
    assert ", in all steps" in str(verdict)
    assert not any("worst axis:" in reason for reason in verdict.reasons)
    even = str(cs.judge(np.sqrt(2.0) * independent(rng, 100, 80, 3), np.array(identities(error)), false_alarm=SURE))
    assert "since" not in even
    assert "in all steps" not in even


@pytest.mark.parametrize("start", [1.7e9, 1.25e9 + 0.5, 4e8])
def test_times_of_a_clock_are_told_from_the_start(start, rng):
    error = independent(rng, 60, 40, 3)
    error[:, 20:] *= 3.0
    record = make_record("f", error, np.array(identities(error)), t=start + 0.1 * np.arange(40), files={0: "a.csv"})
    (sentence, *_) = judge(record, Settings(SURE)).reasons
    assert "since step 21 (2 s after the start)" in sentence
    error[:, 30:] /= 3.0
    (sentence, *_) = judge(record, Settings(SURE)).reasons
    assert "in steps 21 to 30 (2 to 2.9 s after the start)" in sentence
    record = make_record("f", error, np.array(identities(error)), t=100.0 + 0.1 * np.arange(40), files={0: "a.csv"})
    assert "in steps 21 to 30 (102 to 102.9 s)" in judge(record, Settings(SURE)).reasons[0]


@pytest.mark.parametrize("sigma", [1e3, 1e5, 400.0])
def test_a_small_mean_error_has_digits(sigma, rng):
    """Errors of 1 with a mean of -2, under a sigma so large that it is 0.00 of it."""
    error = 0.1 * independent(rng, 60, 20, 3) - 2.0
    (sentence, *_) = verdict_on(error, sigma**2 * np.array(identities(error))).reasons
    assert "mean error -" in sentence or "biased" not in sentence
    assert not re.search(r"-0\.00\b", sentence)
    assert f"{-2.0 / sigma:+.1g}"[:3] in sentence


@pytest.mark.parametrize("runs", [3, 5, 8])
def test_a_part_of_one_axis_has_one_ratio(runs):
    """Runs so unlike that only a lower end is said."""
    size = np.geomspace(1.0, 60.0, runs)[:, None, None] * np.array([10.0, 1.0])
    verdict = cs.judge(np.broadcast_to(size, (runs, 30, 2)), deviations=np.ones((runs, 30, 2)))
    axis, ratio = verdict.worst_axis
    low = short(ratio.low)
    (line,) = (reason for reason in verdict.reasons if "of the worst axis" in reason)
    assert f"{axis}, at least {low};" in line or f"[{low}, " in line
    assert f"at least x{low}" in verdict.reasons[0] or f"[{low}, " in verdict.reasons[0]


def test_a_log_that_is_decided_needs_no_pieces(rng):
    """The number of pieces stands in undecided verdicts alone."""
    log = autoregression(rng, 1, 4000, 3, 0.5)
    open_log = verdict_on(log)
    assert open_log.status == "undecided"
    assert any("would then probably decide" in reason for reason in open_log.reasons)
    for scale in (40.0, 1e-3):
        decided = verdict_on(scale * log)
        assert decided.faults
        assert not any("decide" in reason for reason in decided.reasons)
    short_log = verdict_on(40.0 * log[:, :6])
    assert short_log.status == "undecided" or not any("would decide" in reason for reason in short_log.reasons)


@pytest.mark.parametrize("runs, n", [(40, 3), (30, 6), (100, 2)])
def test_two_levels_of_one_interval_are_told(runs, n, rng):
    """The interval of the tests is wider than that of the ratio at the higher level, or lies inside it."""
    verdict = cs.judge(independent(rng, runs, 20, n), stated := np.tile(np.eye(n), (runs, 20, 1, 1)))
    assert stated.shape == (runs, 20, n, n)
    low, high = verdict.inflation_interval
    tests = verdict.equivalence.interval
    told = [reason for reason in verdict.reasons if reason.startswith("95 % interval ")]
    wider = tests[0] < low or tests[1] > high
    assert len(told) == (wider and not verdict.faults)
    if told:
        assert f"95 % interval {short(low)} to {short(high)} by" in told[0]
