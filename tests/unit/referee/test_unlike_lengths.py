"""Runs that end, or have gaps, by what was measured: tests by runs and by steps, which hold together.

Worlds are those of the calibration. Each random assertion on a right filter fails by chance once in 10,000 at most, and
those on what breaks without weights by far less.
"""

from __future__ import annotations

from dataclasses import astuple, replace

import calibration_lengths as lengths
import numpy as np
import pytest
from scipy import integrate, stats

from consistency.diagnostics import (
    Settings,
    follow,
    judge,
    look,
    make_record,
    sequential_design,
    speaks,
    spread_steps,
)
from consistency.referee.diagnostics.bias_and_shape import mean_shape, products_test
from consistency.referee.diagnostics.distributions import combined_p_value
from consistency.referee.diagnostics.error_parts import run_tests
from consistency.referee.diagnostics.nees import EarlyMeans, e_process, e_processes, ever
from consistency.referee.diagnostics.record_findings import InterimLook, findings_of
from consistency.referee.diagnostics.sample import sample_of
from consistency.referee.diagnostics.scale import RunMeans, equivalence_by_betting, ratio_interval, scale_test
from consistency.referee.diagnostics.status import _robust
from consistency.referee.diagnostics.verdict_parts import MAIN, answers, named_p_values

SURE = 1e-4


def sample_in(world, runs, seed=91):
    record = lengths.measured(np.random.default_rng(seed), lengths.WORLDS[world], runs)
    return sample_of(record, Settings())


def diverging(runs=100, steps=60, end=5, every=10, factor=9.0):
    """Errors that are right but in every tenth run, which is aborted early."""
    rng = np.random.default_rng(92)
    error = np.repeat(rng.standard_normal((runs, 1, 3)), steps, axis=1)
    error[::every] *= np.sqrt(factor)
    error[::every, end:] = np.nan
    return make_record("aborted", error, np.broadcast_to(np.eye(3), (runs, steps, 3, 3)), dof=3)


# --- the tests together --------------------------------------------------------------------------------------


def test_runs_of_equal_length_have_one_test():
    means = np.random.default_rng(93).chisquare(12, 50) / 12
    both = RunMeans(means, np.full(50, 7), 2)
    assert both.find() == both.named == scale_test(means, 2, 7)
    assert both.interval(0.9) == ratio_interval(means, 2, 0.9)
    sample = sample_of(make_record("equal", nees=np.random.default_rng(94).chisquare(2, (30, 5)), dof=2), Settings())
    assert sample.early_means is None
    assert sample.run_means().early is None
    assert run_tests(sample, Settings(), {}).named == {}


@pytest.mark.parametrize("gaussian", [True, False])
def test_tests_of_the_means_over_a_number(gaussian):
    """As if each of the means had been divided by it: of runs alike, of unlike ones, and beyond the reach of chance."""
    rng = np.random.default_rng(97)
    means, counts, first = rng.chisquare(9, 60) / 8, rng.integers(3, 30, 60), rng.chisquare(9, 60) / 7
    for steps, early in ((np.full(60, 7), None), (counts, None), (counts, RunMeans(first, counts.clip(0, 4), 3))):
        over = RunMeans(means, steps, 3, early).tests(gaussian)
        for size in (0.3, 0.9, 1.1, 4.0):
            early_over = None if early is None else RunMeans(first / size, early.counts, 3)
            divided = RunMeans(means / size, steps, 3, early_over).tests(gaussian)(1.0)
            np.testing.assert_allclose(astuple(over(size)), astuple(divided), rtol=1e-9)


def test_the_larger_p_value_finds_a_fault_and_equal_weights_name_it():
    rng = np.random.default_rng(95)
    means, counts = rng.chisquare(9, 60) / 8, rng.integers(3, 30, 60)
    early = RunMeans(rng.chisquare(9, 60) / 7, rng.integers(2, 4, 60), 3)
    runs = scale_test(means, 3, int(counts.max()))
    steps = scale_test(means, 3, int(counts.max()), weights=counts)
    first = scale_test(early.values, 3, 3, weights=early.counts)
    both = RunMeans(means, counts, 3)
    assert both.named == runs
    assert both.find().above == max(runs.above, steps.above)
    assert both.find().below == max(runs.below, steps.below)
    assert both.find().ratio == runs.ratio
    found = replace(both, early=early).find()
    assert found.above == max(runs.above, combined_p_value((steps.above, first.above), (0.25, 0.75)))
    assert found.below == max(runs.below, combined_p_value((steps.below, first.below), (0.25, 0.75)))
    ends = [ratio_interval(means, 3), ratio_interval(means, 3, weights=counts)]
    assert both.interval() == (runs.ratio, min(e.low for e in ends), max(e.high for e in ends))


def test_tests_that_find_opposite_faults_find_none():
    means = np.where(np.arange(200) % 2, 4.0, 0.1)
    counts = np.where(np.arange(200) % 2, 1, 100)
    both = RunMeans(means, counts, 1)
    assert both.named.above < SURE
    assert scale_test(means, 1, 100, weights=counts).below < SURE
    assert both.find().p_value > 0.5


def test_p_values_are_combined_by_cauchys_distribution():
    assert combined_p_value((0.03, 0.03), (0.25, 0.75)) == pytest.approx(0.03)
    assert combined_p_value((0.6, 1e-9), (0.25, 0.75)) == pytest.approx(1e-9 / 0.75, rel=1e-6)
    assert combined_p_value((1.0, 1e-30), (0.25, 0.75)) == pytest.approx(1e-30 / 0.75, rel=1e-6)
    assert combined_p_value((0.0, 0.5), (0.5, 0.5)) < 1e-290
    t = 0.2 / np.tan(np.pi * 0.01) + 0.8 / np.tan(np.pi * 0.3)
    assert combined_p_value((0.01, 0.3), (0.2, 0.8)) == pytest.approx(stats.cauchy.sf(t))


def test_first_steps_are_those_that_nearly_all_runs_have():
    nees = np.ones((100, 30))
    nees[np.arange(30) >= np.arange(10, 110)[:, None]] = np.nan
    nees[:, 4] = np.nan
    nees[50, :8] = np.nan
    sample = sample_of(make_record("ragged", nees=nees, dof=1), Settings())
    assert sample.first == slice(0, 11)  # the second run of 100 to end has 11 steps
    assert sample.run_means().early.counts.tolist() == [9, *[10] * 49, 3, *[10] * 49]


# --- right filters -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("world", ["aligned", "gives up", "left out"])
def test_the_scale_of_a_right_filter_is_not_found_wrong_by_how_its_runs_end(world):
    means = sample_in(world, 6000).run_means()
    assert means.named.p_value < SURE  # what is to be mended
    assert means.find().p_value > SURE
    by_steps = means.interval(1.0 - SURE)
    assert by_steps.holds(1.0)


def test_a_right_filter_is_not_biased_by_where_its_runs_end():
    sample = sample_in("goal", 1000)
    of_runs = np.nanmean(sample.whitened, axis=1)
    assert np.abs(of_runs.mean(axis=0)).max() > 5.0 * of_runs.std() / np.sqrt(1000)
    assert run_tests(sample, Settings(), {}).p_values["bias"] > SURE


def test_axes_are_found_by_both_weights_and_named_by_equal_ones():
    sample = sample_in("goal", 200)
    tests = run_tests(sample, Settings(), {})
    axes = [sample.run_means([i]) for i in range(2)]
    assert list(tests.axes.values()) == [axis.named for axis in axes]
    assert tests.named["scale of an axis"] == 2 * min(axis.named.p_value for axis in axes)
    assert tests.p_values["scale of an axis"] == min(1.0, 2 * min(axis.find().p_value for axis in axes))


def test_products_are_weighted_by_steps_too():
    rng = np.random.default_rng(96)
    whitened = rng.standard_normal((40, 12, 2))
    whitened[np.arange(12) >= rng.integers(2, 13, 40)[:, None]] = np.nan
    products = whitened[..., 0] * whitened[..., 1]
    p = [products_test(each[:, None]) for each in (np.nanmean(products, axis=1), np.nansum(products, axis=1))]
    assert p[0] != p[1]
    assert mean_shape(whitened)[1] == pytest.approx(max(p))


def test_one_step_of_a_run_does_not_depend_on_its_end():
    present = np.ones((50, 100), bool)
    full = spread_steps(present)
    present[::2, 60:] = False
    present[1, full[1]] = False
    chosen = spread_steps(present)
    assert chosen[1] == full[1] + 1
    assert (chosen[::2] == np.where(full[::2] < 60, full[::2], -1)).all()
    assert (chosen[3::2] == full[3::2]).all()


# --- wrong filters -------------------------------------------------------------------------------------------


def test_a_fault_is_named_by_equal_weights_once_it_is_found():
    """Every tenth run diverges and is aborted: the mean of runs is 1.8, that of steps 1.07."""
    verdict = judge(diverging())
    assert verdict.status == "overconfident"
    assert MAIN in verdict.faults
    assert verdict.scale.inflation.value == verdict.scale.mean_anees / 3
    ratio = np.square(diverging().errors.error).sum(axis=2)
    assert verdict.scale.mean_anees == pytest.approx(np.nanmean(ratio, axis=1).mean())


def test_named_p_values_are_no_smaller_than_the_evidence_for_any_fault():
    found = {MAIN: 0.4, "bias": 0.3, "outliers": 1e-4}
    share = {MAIN: 0.5, "bias": 1.0 / 3.0, "outliers": 1.0 / 6.0}
    named = named_p_values(found, {MAIN: 1e-9, "scale of an axis": 1e-9})
    assert named == {**found, MAIN: pytest.approx(share[MAIN] * 1e-4 / share["outliers"])}
    assert named_p_values(found, {MAIN: 0.02})[MAIN] == 0.02
    assert named_p_values(found, {}) == found
    least = [min(p[question] / share[question] for question in p) for p in (found, named)]
    assert least[0] == pytest.approx(least[1])
    nothing = named_p_values({MAIN: 0.4, "bias": 0.3}, {MAIN: 1e-9})
    assert not any(answer.found for answer in answers(nothing, 0.05).values())


def test_what_is_accepted_holds_a_mean_that_is_no_fault():
    sample_record = lengths.measured(np.random.default_rng(97), lengths.WORLDS["aligned"], 2000)
    verdict = judge(sample_record, Settings(SURE))
    assert not verdict.faults
    low, high = verdict.scale.accepted
    assert low <= verdict.scale.mean_anees <= high
    assert verdict.scale.inflation.holds(1.0)
    (low, high) = verdict.scale.equivalence.interval
    assert low < verdict.scale.inflation.value < high


# --- growing numbers of runs -----------------------------------------------------------------------------------


def test_early_steps_weigh_more_in_bets():
    nees = 2.0 * np.array([[np.nan, 1.0, 2.0, 4.0], [np.nan, 3.0, np.nan, np.nan], [np.nan, np.nan, 5.0, np.nan]])
    early = sample_of(make_record("early", nees=nees, dof=2), Settings()).early_means
    total = 1.0 + 1.0 / 2.0 + 1.0 / 3.0
    assert early.shares == pytest.approx([1.0, 1.0 / total, 0.5 / total])
    assert early.means == pytest.approx([(1.0 + 2.0 / 2.0 + 4.0 / 3.0) / total, 3.0, 5.0])


def test_bets_are_on_the_share_that_a_run_has():
    means, early = np.array([1.4, 0.2, 3.0]), EarlyMeans(np.array([1.4, 0.4, 2.0]), np.array([1.0, 0.5, 0.1]))
    first, second = e_processes(means, 2, early, 2.0)
    assert first.up.tolist() == e_process(means / 2.0, 2).up.tolist()
    assert second.up == pytest.approx(e_process(np.array([0.7, 0.6, 1.0]), 2).up)
    assert len(e_processes(means, 2)) == 1
    settings = Settings()
    found = equivalence_by_betting(means, 2, settings, early)
    worst = max(ever(each.down) for each in e_processes(means, 2, early, settings.factor))
    above = max(ever(each.up) for each in e_processes(means, 2, early, 1.0 / settings.factor))
    assert found.p_value == max(worst, above)


@pytest.mark.parametrize("share", [0.0, 0.05, 0.3, 1.0])
def test_a_bet_has_the_mean_1_where_a_share_of_the_steps_is_there(share):
    """One step of the run, or none: its factor has the mean 1 exactly if the share is that of a whole run.

    With a part of the steps, all of them equal, it has a mean of at most 1.
    """
    y = stats.chi2.ppf((np.arange(1000) + 0.5) / 1000, 3) / 3.0
    down = np.array([e_process(np.array([mean]), 3, np.array([share])).down[0] for mean in y])
    assert down.mean() < 1.0 + 1e-3
    if share in (0.0, 1.0):
        assert down.mean() == pytest.approx(1.0, abs=1e-3)
    whole, absent = (e_process(np.array([2.0]), 3, np.array([part])).down[0] for part in (1.0, 0.0))
    assert whole < absent == pytest.approx(1.0)


def test_the_e_process_of_a_right_filter_does_not_grow_by_how_its_runs_end():
    sample = sample_in("gives up", 6000)
    first, second = e_processes(sample.means(), 1, sample.early_means)
    assert ever(first.both) < SURE
    assert ever(second.both) > SURE


def test_a_right_filter_with_few_long_runs_is_soon_called_consistent():
    rng = np.random.default_rng(138)
    record = lengths._of_lengths(rng, lengths.LENGTHS["10 % ten times"], 400, 1.0)
    verdict, runs = follow(sequential_design(3, max_runs=400), record.first_runs)
    assert verdict.consistent
    assert runs <= 200


def test_no_look_finds_a_scale_wrong_by_how_runs_end():
    record = lengths.measured(np.random.default_rng(91), lengths.WORLDS["gives up"], 6000)
    design = sequential_design(1, false_alarm=SURE)
    assert not speaks(design, record, None)
    assert not look(design, record, 1.0).faults


def test_a_look_names_a_fault_that_the_e_process_of_equal_weights_has():
    record = diverging()
    found = findings_of(record, Settings(), InterimLook(1.0, 0.4, 1e-9))
    assert MAIN in found.faults
    assert MAIN not in findings_of(record, Settings(), InterimLook(1.0, 0.4)).faults


# --- weights that differ much ------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [1.5, 2.0, 3.0])
def test_one_long_run_has_the_tail_of_the_weighted_sum(value):
    """Two degrees of freedom: the long run is exponential, the sum of m others a gamma variable."""
    m, long = 12, 8.0
    weights = np.array([long, *[1.0] * m])
    share = weights / weights.sum()

    def beyond(x):
        return stats.gamma.pdf(x, m, scale=share[1]) * stats.expon.sf(value - x, scale=share[0])

    exact = integrate.quad(beyond, 0.0, 6.0, points=[m * share[1]])[0]
    means = np.full(m + 1, value)
    assert scale_test(means, 2, 9, weights=weights).above == pytest.approx(exact, rel=0.1)


def test_the_skewness_of_long_runs_is_the_largest_that_gaussian_errors_have():
    rng = np.random.default_rng(98)
    means, weights = 1.1 * rng.chisquare(40, 200) / 40, rng.choice([1.0, 1.0, 1.0, 9.0], 200)
    test = scale_test(means, 3, 1000, weights=weights)
    w = weights / weights.mean()
    variance = 2.0 / (200 * test.effective_dof)
    third = 4.0 / 3.0 * variance * (w**3).mean() / (w**2).mean() / 200
    k = 8.0 * variance**3 / third**2
    upper = stats.chi2.sf(k + (test.ratio - 1.0) * np.sqrt(2.0 * k / variance), k)
    assert test.above == pytest.approx(stats.t.sf(stats.norm.isf(upper), test.spread), rel=1e-6)
    assert test.above > stats.chi2.sf(200 * test.effective_dof * test.ratio, 200 * test.effective_dof)


# --- the calibration ---------------------------------------------------------------------------------------------


def test_the_p_value_counted_is_that_of_the_verdict():
    record = lengths.measured(np.random.default_rng(99), lengths.WORLDS["aligned"], 60)
    assert min(lengths.p_value(record), 1.0) == pytest.approx(judge(record).p_value)
    assert lengths.p_value(diverging()) == pytest.approx(judge(diverging()).p_value)


@pytest.mark.parametrize("world", lengths.WORLDS)
def test_worlds_have_the_mean_of_their_covariance_by_steps_alone(world):
    """Sums of NEES over the steps that count, less their dof: six standard errors."""
    sample = sample_in(world, 1500)
    excess = np.nansum(sample.nees - sample.dof, axis=1)
    assert abs(excess.mean()) < 6.0 * excess.std() / np.sqrt(len(excess))
    assert sample.early_means is not None


def test_a_group_counts_runs_by_their_steps():
    """Runs that have one step in the group do not make its fault certain."""
    means = np.r_[np.linspace(2.8, 3.2, 40), np.linspace(0.95, 1.05, 40)]
    runs = RunMeans(means, np.repeat([1, 200], 40), 3)
    assert _robust(runs, Settings(), 1)
    assert not _robust(runs, Settings(), 1, weighted=True)
