"""Bounds, radii and intervals at a level: their tests, verdicts, files, options, gates and plan."""

import itertools
import json

import numpy as np
import pytest
from command import consistency, refused
from numpy.testing import assert_allclose
from scipy import stats

import consistency as cs
from consistency.diagnostics import Settings, judge
from consistency.referee.diagnostics.exceedance import (
    Exceedance,
    betting,
    bound_runs,
    deviations_of,
    fewest_runs,
    gaffke,
    level_of,
    missing_steps,
)
from consistency.referee.diagnostics.record import Bound, BoundErrors, Errors, Record, skip_of
from consistency.referee.readers.formats.bounds import bound_columns, level_of_text, levels_of
from consistency.testing import ConsistencyError, InsufficientTrials, assert_consistent


def errors(runs=400, steps=40, n=1, seed=0):
    """Errors (runs, steps, n) whose components are the quantiles of a unit Gaussian, in random order."""
    rng = np.random.default_rng(seed)
    quantiles = stats.norm.ppf((np.arange(runs * steps) + 0.5) / (runs * steps))
    return np.stack([rng.permutation(quantiles).reshape(runs, steps) for _ in range(n)], axis=-1)


def judged(e, bound=1.96, **options):
    return cs.judge(e, bounds=np.full(e.shape, bound), level=0.95, **options)


# --- tests of run means ------------------------------------------------------------------------------------------


def test_gaffke_is_the_binomial_test_where_runs_are_inside_or_outside_throughout():
    for n, k in ((20, 3), (50, 9), (100, 0), (30, 30)):
        x = np.r_[np.ones(k), np.zeros(n - k)]
        assert_allclose(gaffke(x, 0.05), stats.binom.sf(k - 1, n, 0.05), rtol=1e-9)
        assert_allclose(gaffke(1.0 - x, 0.95), stats.binom.cdf(k, n, 0.05), rtol=1e-9)


def test_gaffke_is_the_probability_of_a_mixture_by_its_closed_form():
    """Of exponentials with different weights c, P(sum > 0) = sum over c_i > 0 of prod c_i / (c_i - c_j)."""
    rng = np.random.default_rng(1)
    for (n, near), a in itertools.product(((3, 0.1), (6, 0.08), (12, 0.05)), (0.05, 0.32)):
        x = rng.beta(0.6, 0.6 * (1 - a) / a, (200, n)) ** 0.5
        c = np.concatenate([x - a, np.full((200, 1), -a)], axis=1)
        apart = c[:, :, None] - c[:, None, :] + np.eye(n + 1)
        ratio = np.where(np.eye(n + 1, dtype=bool), 1.0, c[:, :, None] / apart)
        exact = 1.0 - np.where(c > 0, ratio.prod(axis=2), 0.0).sum(axis=1)
        found = gaffke(x, a)
        some = (exact > 1e-3) & (exact < 0.2)
        assert some.sum() > 3
        assert_allclose(found[some], exact[some], rtol=near)
        assert (found[some] > 0.97 * exact[some]).all()
    assert gaffke(np.full(10, 0.01), 0.05) == 1.0


def test_the_bet_is_a_martingale_where_the_share_is_as_stated():
    a = 0.05
    outcomes = np.array(list(itertools.product([0.0, 1.0], repeat=3)))
    chance = np.prod(np.where(outcomes == 1.0, a, 1.0 - a), axis=1)
    wealth = 1.0 / np.where((p := betting(outcomes, a)) < 1.0, p, np.nan)
    assert np.nansum(wealth * chance) < 1.0
    assert_allclose(betting(np.ones((1, 1)), a), 1.0 / (1.0 + np.mean(BETS) * (1 / a - 1.0)), rtol=1e-12)


BETS = np.r_[0.002, 0.005, 0.01, 0.02, 0.05, np.linspace(0.1, 0.99, 19)]


def test_rates_on_right_bounds_hold():
    """Three laws of run means and both sides at 2.5 %; by chance less than once in 100,000 runs."""
    rng = np.random.default_rng(2)
    gates, runs, a = 400, 40, 0.05
    limit = stats.binom.isf(1e-6, gates, 0.025)
    for x in (
        (rng.random((gates, runs)) < a).astype(float),
        rng.beta(0.3, 0.3 * (1 - a) / a, (gates, runs)),
        rng.binomial(40, a, (gates, runs)) / 40,
    ):
        for test in (gaffke, betting):
            assert (test(x, a) <= 0.025).sum() <= limit
            assert (test(1.0 - x, 1.0 - a) <= 0.025).sum() <= limit
    assert (gaffke(rng.binomial(40, 3 * a, (gates, runs)) / 40, a) <= 0.025).all()


def test_steps_after_the_end_of_runs_are_missing_and_gaps_are_not():
    nan = np.nan
    ratios = np.array([[1, 1, 1, 1, nan], [1, nan, 1, 1, nan], [1, 1, nan, nan, nan], [nan] * 5])
    assert missing_steps(ratios).tolist() == [0, 0, 2, 4]
    low, high = Exceedance(2.0 * ratios, missing_steps(ratios), 0.9).shares()
    assert_allclose(low, [1, 1, 0.5, 0])
    assert_allclose(high, [1, 1, 1, 1])
    assert Exceedance(ratios, missing_steps(ratios), 0.9).rate() == 0.0
    assert Exceedance(2.0 * ratios, missing_steps(ratios), 0.9).rate() == 1.0


def test_the_interval_of_the_factor_holds_what_no_test_rejects():
    rng = np.random.default_rng(3)
    sizes = Exceedance(np.abs(rng.standard_normal((150, 20))), np.zeros(150, int), 0.95)
    value, low, high = sizes.factor()
    assert low < value < high
    assert 1.8 < value < 2.1
    assert sizes.p_small(low * 0.9999) <= 0.025 < sizes.p_small(low)
    assert sizes.p_large(high) <= 0.025 < sizes.p_large(high * 0.9999)
    few = Exceedance(sizes.ratios[:60], sizes.missing[:60], 0.95).factor()
    assert few.high == np.inf
    assert low * 0.8 < few.low < value
    assert_allclose(Exceedance(np.zeros((100, 1)), np.zeros(100, int), 0.95).rate_limit(), 1 - 0.05**0.01, rtol=1e-6)


@pytest.mark.parametrize(("level", "factor"), [(0.75, 150.0), (0.95, 190.0)])
def test_the_factor_is_the_smallest_size_with_no_more_than_its_share_outside(level, factor):
    of = Exceedance(np.arange(1.0, 201.0)[:, None], np.zeros(200, int), level)
    assert of.factor().value == factor


def test_a_bound_of_zero_has_no_factor():
    sizes = Exceedance(np.full((100, 3), np.inf), np.zeros(100, int), 0.95)
    assert sizes.factor() == (np.inf, np.inf, np.inf)
    assert sizes.rate() == 1.0


def test_fewest_runs_and_levels_are_those_of_the_tables():
    assert [fewest_runs(q) for q in (0.68, 0.95, 0.99, 0.999)] == [8, 59, 299, 2995]
    of = [deviations_of(0.95, 1), deviations_of(0.95, 2), deviations_of(0.5, 2)]
    assert_allclose(of, [1.96, 2.4477, 1.1774], rtol=1e-4)
    assert_allclose([level_of(2, 1), level_of(2, 2), level_of(1, 1)], [0.9545, 0.8647, 0.6827], rtol=1e-4)


def test_planned_runs_are_those_of_the_binomial():
    for level, expected in ((0.68, (316, 94, 73)), (0.95, (336, 73, 142))):
        planned = bound_runs(level)
        assert planned[1:] == expected
    a, found = 0.05, {}
    rate = 2 * stats.norm.sf(stats.norm.isf(a / 2) / 1.5)
    for n in range(60, 90):
        k = next(k for k in range(n) if stats.binom.sf(k - 1, n, a) <= 0.025)
        found[n] = stats.binom.sf(k - 1, n, rate)
    assert found[73] >= 0.95 > found[72]
    assert bound_runs(1.0 - 1e-7)[:2] == (29957322, None)


# --- verdicts --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size", "status"), [(1.0, "consistent"), (1.5, "overconfident"), (1 / 1.5, "conservative"), (1.1, "overconfident")]
)
def test_a_verdict_names_the_factor_of_the_bound(size, status):
    verdict = judged(size * errors())
    (score,) = verdict.bounds
    assert verdict.status == score.status == status
    assert score.factor.low <= size * 1.05
    assert score.factor.high >= size * 0.95
    assert_allclose(score.factor.value, size, rtol=0.06)
    assert f"{score.factor.value:.2f} [" in verdict.reasons[0]
    assert score.name in str(verdict)
    assert_allclose(score.equivalence.factor, 1.5**0.5)
    assert verdict.consistent == (status == "consistent")
    assert (verdict.p_value <= 0.05) == (status != "consistent")


def test_a_radius_bounds_the_length_of_all_components():
    e = errors(n=2)
    r = np.full(e.shape[:2], np.quantile(np.hypot(*np.moveaxis(e, -1, 0)), 0.95))
    right = cs.judge(e, bounds=r, level="95%", axes=["x", "y"])
    assert right.consistent
    assert right.bounds[0].name == "radius_x_y"
    assert np.isnan(right.bounds[0].above)
    wrong = cs.judge(e, bounds=r / 1.5, level="95%")
    assert wrong.status == "overconfident"
    assert_allclose(wrong.bounds[0].factor.value, 1.5, rtol=0.01)
    small = cs.judge(e[..., :1], bounds=r, level="95%", axes=["x"])
    assert small.bounds[0].name == "bound_x"


def test_a_bias_shows_as_sides():
    verdict = judged(errors() + 1.0)
    (score,) = verdict.bounds
    assert_allclose([score.above, score.below], [0.175, 0.0], atol=0.01)
    assert_allclose(score.rate, score.above + score.below)
    assert "17 % above, 0.16 % below" in verdict.reasons[0]
    other = judged(errors() - 1.0)
    assert other.bounds[0].below == score.above


def test_too_few_runs_say_what_they_exclude():
    for size in (1.0, 0.2):
        verdict = judged(size * errors(58))
        assert verdict.status == "undecided"
        assert verdict.bounds[0].factor.high == np.inf
        assert "fewer than 59" in verdict.reasons[0]
        assert "336 runs" in verdict.reasons[0]
    assert "5 % of the steps or more" in verdict.reasons[0]
    none = judged(0.2 * errors(80))
    assert none.status == "conservative"


def test_several_bounds_share_the_rate_and_err_on_two_sides():
    e = errors(n=2) * [1.5, 1.0]
    verdict = judged(e, axes=["x", "y"])
    assert verdict.status == "overconfident"
    assert verdict.faults == ("bound_x",)
    assert [a.share for a in verdict.answers] == [0.5, 0.5]
    assert [score.status for score in verdict.bounds] == ["overconfident", "consistent"]
    assert judged(e * [1.0, 1 / 1.5]).status == "inconsistent"
    by_name = cs.judge(e, bounds=np.full(e.shape, 1.96), level={"bound_x": 0.81, "bound_y": 0.95}, axes=["x", "y"])
    assert [score.level for score in by_name.bounds] == [0.81, 0.95]
    assert by_name.consistent


def test_settings_mean_what_they_mean_of_covariances():
    e = errors()
    assert judged(e / 2, allow="conservative").consistent
    assert judged(e / 2, tolerance=5.0).consistent
    assert judged(e * 1.3, detect=4.0).status == "overconfident"
    assert judged(e, detect=1.02).status == "undecided"
    one = judged(e * 1.5, allow="conservative")
    assert one.status == "overconfident"
    few = Exceedance(np.abs(errors(60, 5)[..., 0]) * 1.2 / 1.96, np.zeros(60, int), 0.95)
    assert few.p_small() <= 0.0005 < few.p_small(test=betting)
    for rate, status in ((0.0011, "overconfident"), (0.001, "undecided")):  # by Gaffke's test, and by betting
        verdict = judged(errors(60, 5) * 1.2, false_alarm=rate)
        assert verdict.status == status


def ended(size=1.0):
    """Errors of runs that end at the first step outside a bound of 1.96."""
    e = size * np.random.default_rng(4).standard_normal((200, 40, 1))
    far = np.abs(e[..., 0]) > 1.96
    end = np.where(far.any(axis=1), far.argmax(axis=1) + 1, 40)
    return np.ma.masked_array(e, (np.arange(40) >= end[:, None])[..., None])


def test_ends_that_depend_on_errors_make_no_fault_unless_they_are_declared_independent():
    e = ended()
    verdict = judged(e)
    assert verdict.status == "undecided"
    assert verdict.bounds[0].missing == e.mask.sum()
    assert any("--ends independent" in line for line in verdict.reasons)
    plain = judged(e, ends="independent")
    assert plain.status == "overconfident"
    assert plain.bounds[0].missing == 0


def test_lost_runs_count_and_leave_no_verdict_consistent():
    e = errors()
    e[:3] = np.nan
    e[3, 20:] = np.nan
    verdict = judged(e)
    assert verdict.status == "failed"
    assert len(verdict.failures) == 4
    assert verdict.bounds[0].missing == 3 * 40 + 20
    assert verdict.bounds[0].runs == 400
    bounds = np.full((400, 40, 1), 1.96)
    bounds[5, 7:] = np.nan
    assert "bound is not finite" in cs.judge(errors(), bounds=bounds, level=0.95).failures[0].reason


def test_rows_may_be_runs():
    rng = np.random.default_rng(5)
    e = rng.standard_normal((1000, 2))
    verdict = judged(e, 1.96 / 1.5, independent=True)
    assert verdict.status == "overconfident"
    assert verdict.runs == 1000
    radius = cs.judge(e, bounds=np.full(1000, 2.4477), level=0.95, independent=True)
    assert radius.bounds[0].steps == 1000
    assert not radius.faults  # by chance once in 20 of other seeds


def test_groups_have_factors_of_their_own():
    e, rain = errors(), np.arange(400) % 2 == 0
    e[rain] *= 1.5
    words = np.where(rain, "rain", "dry")
    verdict = judged(e, by={"weather": words})
    assert verdict.status == "overconfident"
    of = {score.group: score for score in verdict.bounds}
    assert [of[name].status for name in ("weather is dry", "weather is rain")] == ["consistent", "overconfident"]
    assert_allclose(of["weather is rain"].factor.value, 1.5, rtol=0.05)
    assert sum(answer.share for answer in verdict.answers) == 1.0
    short = np.ma.masked_array(e, np.zeros(e.shape, bool))
    short[0, 30:] = np.ma.masked
    unjudged = judged(short, by={"weather": words})
    assert [score.status for score in unjudged.bounds[1:]] == ["", ""]
    assert len(unjudged.answers) == 1


def test_gaussian_bounds_are_covariances():
    e = errors(60, n=2)
    radius = cs.judge(e, bounds=np.full((60, 40), 2.4477), level="95%", gaussian=True)
    same = cs.judge(e, np.broadcast_to(np.eye(2), (60, 40, 2, 2)))
    assert_allclose(radius.inflation, same.inflation, rtol=1e-4)
    assert radius.status == same.status
    each = cs.judge(e, bounds=np.full((60, 40, 2), 3.0), level="3sigma", gaussian=True)
    alone = cs.judge(e, deviations=np.ones((60, 40, 2)))
    assert list(each.parts) == list(alone.parts)
    assert_allclose(each.inflation, alone.inflation, rtol=1e-9)
    scaled = cs.judge(e, np.broadcast_to(1.96**2 * np.eye(2), (60, 40, 2, 2)), level="95%", gaussian=True)
    assert_allclose(scaled.inflation, same.inflation, rtol=1e-3)
    cep = cs.judge(e, np.broadcast_to(1.1774**2 * np.eye(2), (60, 40, 2, 2)), level="CEP", gaussian=True)
    assert_allclose(cep.inflation, same.inflation, rtol=1e-3)


def test_a_record_of_bounds_has_runs_and_can_be_cut():
    record = Record("r", Errors(bounded=BoundErrors((Bound("bound_x", ("x",), 0.95),), errors() / 1.96)))
    assert len(record.run_numbers) == 400
    assert judge(record, Settings()).consistent
    assert judge(record.first_runs(10), Settings()).runs == 10
    assert judge(record.without_first(skip_of(5)), Settings()).bounds[0].steps == 400 * 35


# --- files and options -----------------------------------------------------------------------------------------


def table(path, columns, runs=80, steps=10, drop=()):
    """A table of runs with x, y, their truth, and ``columns`` made of x, y and their errors."""
    e, rng = errors(runs, steps, 2), np.random.default_rng(6)
    truth = 10.0 * rng.standard_normal(e.shape)
    x, y = np.moveaxis(truth - e, -1, 0)
    of = {"run": np.arange(runs)[:, None], "step": np.arange(1, steps + 1), "x": x, "y": y,
          "true_x": truth[..., 0], "true_y": truth[..., 1], **columns(x, y)}  # fmt: skip
    of = {name: np.broadcast_to(value, (runs, steps)).ravel() for name, value in of.items() if name not in drop}
    rows = [",".join(map(repr, map(float, row))) for row in zip(*of.values(), strict=True)]
    path.write_text("\n".join([",".join(of), *rows]) + "\n")
    return path


def analysed(capsys, path, *words):
    (verdict,) = json.loads(consistency(capsys, "analyse", path, "--json", *words)[0]).values()
    return verdict["status"], verdict["statistics"].get("bounds")


def test_columns_of_a_table_state_bounds(tmp_path, capsys):
    def of(x, y):
        return {"h_acc": 2.4477, "bound_x": 1.96 / 1.5, "y_low": y - 1.96, "y_high": y + 4.0}

    path = table(tmp_path / "est.csv", of)
    status, bounds = analysed(capsys, path, "--columns", "radius_x_y=h_acc", "--level", "95%")
    assert status == "overconfident"
    assert [b["name"] for b in bounds] == ["radius_x_y", "bound_x", "y_low..y_high"]
    assert [b["status"] == "overconfident" for b in bounds] == [False, True, False]
    assert_allclose([bounds[1]["factor"], bounds[1]["rate"]], [1.5, 0.19], rtol=0.06)
    assert_allclose(
        [bounds[2]["above"], bounds[2]["below"]], [0.0, 0.025], atol=0.003
    )  # truth above y_high, below y_low
    level = "radius_x_y=0.95,bound_x=2sigma,y_low=97.5%"
    _, bounds = analysed(capsys, path, "--columns", "radius_x_y=h_acc", "--level", level)
    assert_allclose([b["level"] for b in bounds], [0.95, 0.9545, 0.975], rtol=1e-4)


def test_an_interval_without_an_estimate_grows_about_its_middle(tmp_path):
    path = table(tmp_path / "est.csv", lambda x, y: {"x_low": x - 1.3, "x_high": x + 1.3}, drop="xy")
    verdict = cs.judge(cs.read(path, level=0.95))
    assert verdict.status == "overconfident"
    assert_allclose(verdict.bounds[0].factor.value, 1.96 / 1.3, rtol=0.03)


def test_a_truth_of_its_own_and_a_heading_that_wraps(tmp_path):
    rng = np.random.default_rng(7)
    truth = np.column_stack([np.repeat(np.arange(60), 4), np.tile(np.arange(1, 5), 60), *rng.normal(size=(2, 240)),
                             rng.uniform(-np.pi, np.pi, 240)])  # fmt: skip
    est = truth.copy()
    e = rng.uniform(0.01, 0.05, 240)
    est[:, 4] = np.mod(est[:, 4] - e, 2 * np.pi)
    for name, rows, more in (("est", est, ",bound_heading"), ("truth", truth, "")):
        text = "\n".join(",".join(map(repr, map(float, [*row, *[0.1] * bool(more)]))) for row in rows)
        (tmp_path / f"{name}.csv").write_text(f"run,step,x,y,heading{more}\n{text}\n")
    record = cs.read(tmp_path / "est.csv", tmp_path / "truth.csv", level="95%")
    assert_allclose(record.errors.bounded.ratios.ravel(), e / 0.1, rtol=1e-6)
    assert record.errors.bounded.bounds == (Bound("bound_heading", ("heading",), 0.95),)


def test_archives_hold_bounds(tmp_path):
    e = errors(n=2)
    path = tmp_path / "a.npz"
    np.savez(path, errors=e, bounds=np.full(e.shape, 1.96), axes=np.array(["x", "y"]))
    assert cs.judge(cs.read(path, level=0.95)).consistent
    np.savez(path, estimates=-e, truth=0 * e, bounds=np.full(e.shape[:2], 1.5))
    verdict = cs.judge(cs.read(path, level=0.95))
    assert verdict.status == "overconfident"
    assert_allclose(verdict.bounds[0].factor.value, 2.4477 / 1.5, rtol=0.02)
    np.savez(path, errors=e[0], bounds=np.full(e.shape[1:], 1.96))
    assert cs.judge(path, level=0.95).runs == 1


def test_the_sign_of_an_error_chooses_the_end_of_an_interval(tmp_path):
    path = table(tmp_path / "est.csv", lambda x, y: {"x_low": x - 100.0, "x_high": x + 1.645})
    (score,) = cs.judge(cs.read(path, level=0.95)).bounds
    assert_allclose([score.above, score.below], [0.05, 0.0], atol=0.005)


@pytest.mark.parametrize(
    ("text", "share", "dimensions"),
    [("95%", 0.95, 1), ("0.5", 0.5, 1), ("2sigma", 0.9545, 1), ("CEP", 0.5, 2), ("R95", 0.95, 2)],
)
def test_levels_are_read(text, share, dimensions):
    level = level_of_text(text)
    assert_allclose(level.of(dimensions), share, rtol=1e-4)
    assert_allclose(level_of(level.in_deviations(dimensions), dimensions), share, rtol=1e-4)
    assert levels_of(f"a={text},b=1%").of("a") == level
    assert_allclose(level_of_text("2sigma").of(2), 0.8647, rtol=1e-4)


def test_names_of_components_may_hold_underscores():
    names = ["pos_n", "pos_e", "radius_pos_n_pos_e", "radius_a_b", "bound_v", "q_low"]
    assert [one.components for one in bound_columns(names)] == [("pos_n", "pos_e"), ("a", "b"), ("v",)]


@pytest.mark.parametrize(
    ("texts", "why"),
    [
        (("0", "1", "1.2", "0%", "100%", "-5%", "nan", "much", "0sigma", "95%%"), "above 0 and below 100 %"),
        (("2DRMS", "drms"), "trace"),
        (("CEP",), "radius of 2 components, not of 1"),
    ],
)
def test_what_is_no_level_is_refused(texts, why):
    for text in texts:
        with pytest.raises(cs.InputError, match=f"--level {text}: .*{why}"):
            level_of_text(text).of(1)


X = {"bound_x": 1.0}


@pytest.mark.parametrize(
    ("columns", "words", "parts"),
    [
        (lambda x: {"bound_x": np.where(x > 0, 1.0, -1.0)}, "--level 95%", ("line", "bound_x is negative, -1")),
        (lambda x: {"x_low": x + 1, "x_high": x - 1}, "--level 95%", ("x_low", "above x_high")),
        (lambda x: {"x_low": x + 1, "x_high": x + 2}, "--level 95%", ("outside x_low", "without a column 'x'")),
        (X, "", ("bound_x", "--level 95%")),
        ({"h_acc": 1.0}, "--level 95%", ("radius_x_y", "--columns", "'bounds'", "--gaussian")),
        (X, "--level bound_y=95%", ("bound_y", "there are: bound_x")),
        (X | {"bound_y": 1.0}, "--level bound_x=95%", ("none for bound_y",)),
        (X, "--gaussian", ("--gaussian", "--level 95%")),
        (X, "--ends independent", ("--ends", "--level 95%")),
        (X, "--level 95% --ends late", ("--ends late", "'independent'")),
        (X, "--level 95% --split 4", ("--level", "--split")),
        (X | {"radius_x_y": 1.0}, "--level 95% --gaussian", ("--gaussian", "x has several")),
        (X, "--level 95% --gaussian --ends independent", ("--ends", "--gaussian")),
        ({"bound_z": 1.0}, "--level 95% --state x,y", ("bound_z", "--state")),
        (X, "--level 95% --alert-limit 0", ("--alert-limit 0", "above 0")),
        (X, "--level 95% --alert-limit bound_x=-4", ("--alert-limit -4", "above 0")),
        (X, "--level 95% --alert-limit nan", ("--alert-limit nan", "above 0")),
        (X, "--level 95% --alert-limit high", ("--alert-limit high", "above 0")),
        (X, "--level 95% --alert-limit bound_y=4", ("--alert-limit bound_y", "there are: bound_x")),
        (X, "--level 95% --gaussian --alert-limit 4", ("--alert-limit", "--gaussian")),
        (X, "--alert-limit 4", ("--alert-limit", "--level 95%")),
    ],
)
def test_bad_bounds_are_refused_in_one_sentence(tmp_path, capsys, columns, words, parts):
    path = table(tmp_path / "est.csv", lambda x, y: columns(x) if callable(columns) else columns, runs=3)
    err = refused(capsys, "analyse", path, *words.split())
    for part in parts:
        assert part in err


@pytest.mark.parametrize(
    ("name", "words", "parts"),
    [
        ("est.tum", "--level 95%", ("--level: does not go with", "covariances alone", "radius_x_y", ".npz")),
        ("est.tum", "--level 95% --alert-limit 4", ("--level", "table")),
        ("est.tum", "--members x=e*", ("--members", "columns of --members")),
        ("est.bag", "--level 95%", ("--level", "radius_x_y")),
        ("log.ulg", "--level 95%", ("flight logs", "eph", "radius_x_y with --level")),
        ("log.bin", "--level 95%", ("flight logs", "eph", "radius_x_y with --level")),
    ],
)
def test_files_that_hold_no_bounds_name_the_way(tmp_path, capsys, name, words, parts):
    rows = "".join(f"{k / 10} {k} 0 0 0 0 0 1\n" for k in range(40))
    for file in (name, "truth.tum"):
        (tmp_path / file).write_bytes(b"#ROSBAG V2.0\n" if file.endswith(".bag") else rows.encode())
    truth = () if name.endswith((".ulg", ".bin", ".bag")) else ("--truth", tmp_path / "truth.tum")
    err = refused(capsys, "analyse", tmp_path / name, *truth, *words.split())
    for part in parts:
        assert part in err


def test_bad_arrays_are_refused():
    e, bounds = errors(5), np.ones((5, 40, 1))
    with pytest.raises(cs.InputError, match=r"bounds need their level"):
        cs.judge(e, bounds=bounds)
    with pytest.raises(cs.InputError, match=r"shape \(5, 40, 2\), needs \(5, 40, 1\)"):
        cs.judge(e, bounds=np.ones((5, 40, 2)), level=0.9)
    wrong = bounds.copy()
    wrong[2, 3] = -1.0
    with pytest.raises(cs.InputError, match=r"bounds, run 2, step 4: negative"):
        cs.judge(e, bounds=wrong, level=0.9)
    with pytest.raises(cs.InputError, match="give one of them"):
        cs.judge(e, np.ones((5, 40, 1, 1)), bounds=bounds, level=0.9)
    with pytest.raises(cs.InputError, match="gaussian="):
        cs.judge(e, np.ones((5, 40, 1, 1)), level=0.9)


def test_commands_for_covariances_refuse_bounds(tmp_path, capsys):
    path = table(tmp_path / "est.csv", lambda x, y: {"bound_x": 2.0})
    for words in (("baseline", path, "--out", tmp_path / "b.json"), ("compare", path, path)):
        assert "--gaussian" in refused(capsys, *words, "--level", "95%")


# --- alert limits ------------------------------------------------------------------------------------------------


def test_steps_are_in_the_regions_of_the_stanford_diagram():
    """Errors and bounds in each region beside an alert limit of 10, some a hair from its edges."""
    steps = {  # error, bound
        "nominal operation": [(0, 0), (3, 4), (4, 4), (10, 10)],
        "misleading": [(4.1, 4), (10, 9.9)],
        "hazardously misleading": [(10.1, 4), (10.1, 10), (99, 1)],
        "unavailable": [(3, 11), (10.5, 10.5)],
        "unavailable and misleading": [(12, 11)],
    }
    e, b = np.array([pair for pairs in steps.values() for pair in pairs], float).T
    verdict = cs.judge(np.stack([e, -e])[..., None], bounds=np.stack([b, b])[..., None], level=0.5, alert_limit=10)
    (score,) = verdict.bounds
    shares = verdict.as_dictionary()["statistics"]["bounds"][0]["alerts"]["shares"]
    assert shares == pytest.approx({name: len(pairs) / len(e) for name, pairs in steps.items()})
    outside = sum(share for name, share in shares.items() if "misleading" in name)
    assert outside == pytest.approx(score.rate)


def test_the_longer_side_of_an_interval_alerts_and_runs_are_weighed_alike(tmp_path):
    def of(x, y):
        return {"x_low": x - np.where(np.arange(10) < 5, 30.0, 8.0), "x_high": x + 9.0, "y_low": y, "y_high": y + 1.0}

    path = table(tmp_path / "est.csv", of, runs=4)
    rows = path.read_text().splitlines()
    path.write_text("\n".join(row for row in rows if not row.startswith("0.0,") or float(row.split(",")[1]) > 5) + "\n")
    x, y = cs.judge(cs.read(path, level="95%", alert_limit={"x_low": 20.0, "y_high": 2})).bounds
    unavailable = np.mean([0.0, 0.5, 0.5, 0.5])
    assert x.alerts.shares == (1.0 - unavailable, 0, 0, unavailable, 0)
    assert x.alerts.limit == 20.0
    assert y.alerts.shares[3:] == (0, 0)
    assert sum(y.alerts.shares[1:]) == pytest.approx(y.rate)
    only_x = cs.judge(cs.read(path, level="95%", alert_limit={"x_low": 20.0})).bounds
    assert [one.alerts is None for one in only_x] == [False, True]


def test_an_excluded_rate_of_hazards_counts_missing_steps_and_is_three_over_runs():
    e = errors(100)
    alerts = judged(e, 5.0, alert_limit=6.0).bounds[0].alerts
    assert alerts.shares == (1, 0, 0, 0, 0)
    assert alerts.hazard_limit == pytest.approx(1.0 - 0.05 ** (1 / 100), rel=1e-3)  # 3 / N
    (line,) = [one for one in judged(e, 5.0, alert_limit=6).reasons if "alert limit" in one]
    for part in ("in 0 % of the steps", "3 % or more is excluded", "100 runs never show a rate below 3 %", "1e-7"):
        assert part in line
    small = judged(e, 1.5, alert_limit=6.0).bounds[0].alerts
    assert small.shares[1] > 0.05  # misleading, and not a hazard
    assert small.hazard_limit == alerts.hazard_limit
    e[:10, 30:] = np.nan
    ended = judged(e, 5.0, alert_limit=6.0).bounds[0].alerts
    assert ended.hazard_limit > alerts.hazard_limit + 0.02
    declared = judged(e, 5.0, alert_limit=6.0, ends="independent").bounds[0].alerts
    assert declared.hazard_limit == pytest.approx(alerts.hazard_limit)


def test_groups_and_first_steps_have_regions_of_their_own():
    e, bounds = errors(60), np.where(np.arange(40)[None, :, None] < 10, 9.0, 2.0) * np.ones((60, 40, 1))
    by = {"part": np.where(np.arange(40) < 10, "first", "last")[None].repeat(60, axis=0)}
    scores = cs.judge(e, bounds=bounds, level=0.95, alert_limit=5.0, by=by).bounds
    assert [one.alerts.shares[3] for one in scores] == [0.25, 1.0, 0.0]
    later = cs.judge(e, bounds=bounds, level=0.95, alert_limit=5.0, skip="10").bounds
    assert later[0].alerts.shares[3] == 0.0
    rows = cs.judge(e[:, :, :], bounds=bounds, level=0.95, alert_limit=5.0, independent=True).bounds
    assert (rows[0].alerts.shares[3], rows[0].runs) == (0.25, 2400)


def test_coverage_and_regions_are_printed_and_on_the_page(tmp_path, capsys):
    path = table(tmp_path / "est.csv", lambda x, y: {"HPL": np.where(np.arange(10) < 2, 50.0, 2.4477), "bound_x": 1.3})
    words = ("--columns", "radius_x_y=HPL", "--state", "x,y", "--level", "95%", "--alert-limit", "radius_x_y=40")
    out, _ = consistency(capsys, "analyse", path, *words, "--report", tmp_path / "report")
    (row,) = [line.split() for line in out.splitlines() if line.startswith("radius_x_y ")]
    assert row[1] == "40.0"
    assert float(row[5]) == 20.0
    assert sum(map(float, row[2:])) == pytest.approx(100.0, abs=0.1)
    assert "in bound_x" in out
    assert "NIS only" not in out
    html = (tmp_path / "report/report.html").read_text()
    for text in (
        "Stanford",
        "hazardously misleading",
        "Inside (%)",
        "Gaffke",
        "by which bounds must grow",
        "radius_x_y",
    ):
        assert text in html
    assert "degrees of freedom" not in html.split("How a verdict comes about")[1]
    _, bounds = analysed(capsys, path, *words)
    assert bounds[0]["alerts"]["shares"]["unavailable"] == pytest.approx(0.2)
    assert "alerts" not in str(analysed(capsys, path, *words[:-2])[1][0].get("alerts") or "")


# --- gates, plan, reports ------------------------------------------------------------------------------------------


def test_gates_take_bounds():
    bounds = np.full((400, 40, 1), 1.96)
    assert assert_consistent(errors(), bounds=bounds, level=0.95).consistent
    with pytest.raises(ConsistencyError, match=r"must grow by a factor of 1\.5"):
        assert_consistent(1.5 * errors(), bounds=bounds, level=0.95)
    with pytest.raises(InsufficientTrials, match=r"plan --level 95%") as few:
        assert_consistent(errors(40), bounds=bounds[:40], level="95%")
    assert few.value.needed == 336
    with pytest.raises(ValueError, match="level and ends go with bounds"):
        assert_consistent(errors(), np.ones((400, 40, 1, 1)), level=0.95)
    with pytest.raises(ValueError, match="covariances or bounds, not both"):
        assert_consistent(errors(), np.ones((400, 40, 1, 1)), bounds=bounds, level=0.95)


def test_plan_says_runs_of_a_level(capsys):
    planned = json.loads(consistency(capsys, "plan", "--level", "99%", "--json")[0])
    assert [planned[key] for key in ("fewest", "consistent", "small", "large")] == [299, 913, 88, 555]
    out, _ = consistency(capsys, "plan", "--level", "95%")
    assert "336 runs show" in out
    assert "fewer than 59 runs" in out
    assert "--groups" not in refused(capsys, "plan", "--level", "95%", "--groups", "3")
    assert "more than a million" in consistency(capsys, "plan", "--level", "99.99999%")[0]
