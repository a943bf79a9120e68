"""Bounds that ``correct`` has corrected: by the definition of the factor, held out, by group; and what is refused."""

import json
import tomllib

import numpy as np
import pytest
from command import consistency, refused

import consistency as cs
from consistency.referee.diagnostics.exceedance import Exceedance, fewest_fitted

LEVEL = 0.9
RNG = np.random.default_rng(5)


def runs_of(sizes, level=LEVEL):
    return Exceedance(sizes, np.zeros(len(sizes), int), level)


def by_definition(sizes, level):
    """The smallest of the sizes so that the shares outside it and a run that is all outside have the mean 1 - level."""
    sizes = sizes[~np.isnan(sizes).all(axis=1)]
    there = ~np.isnan(sizes)
    for factor in np.unique(np.r_[0.0, sizes[there]]):
        shares = ((sizes > factor) & there).sum(axis=1) / there.sum(axis=1)
        if (shares.sum() + 1.0) / (len(sizes) + 1) <= 1.0 - level + 1e-12:
            return factor
    return np.inf


@pytest.mark.parametrize("digits", [9, 1])  # 1: many sizes are equal
def test_the_factor_is_that_of_conformal_risk_control(digits):
    sizes = np.abs(RNG.standard_normal((25, 12))).round(digits)
    sizes[3, 5:] = np.nan
    sizes[7] = np.nan
    factor, left_out = runs_of(sizes).covering_factors()
    assert factor == by_definition(sizes, LEVEL)
    for run in range(len(sizes)):
        assert left_out[run] == by_definition(np.delete(sizes, run, axis=0), LEVEL)


def test_a_new_run_of_equal_steps_leaves_with_the_rate_of_the_rank():
    sizes = np.repeat(np.arange(1.0, 40.0)[:, None], 7, axis=1)  # 39 runs: 90 % of 40 ranks is the 36th size
    factor, left_out = runs_of(sizes).covering_factors()
    assert factor == 36.0
    assert (left_out[0], left_out[-1]) == (37.0, 36.0)  # two of the 38 others are outside, of 2.9


def test_fewer_runs_than_a_level_takes_have_no_factor():
    assert [fewest_fitted(level) for level in (0.5, 0.9, 0.95, 0.99)] == [1, 9, 19, 99]
    sizes = np.abs(RNG.standard_normal((9, 5)))
    assert runs_of(sizes).covering_factors()[0] == np.nanmax(sizes)
    assert np.isinf(runs_of(sizes).covering_factors()[1]).all()
    assert np.isinf(runs_of(sizes[:8]).covering_factors()[0])


def test_the_interval_of_a_rate_holds_what_no_test_rejects():
    of = runs_of(np.repeat([0.5, 2.0], [90, 10])[:, None] * np.ones((100, 3)))
    rate = of.rate_interval()
    assert rate.value == 0.1
    assert rate[1:] == pytest.approx((0.0490, 0.1762), abs=2e-4)  # Clopper & Pearson


def drawn(runs=400, steps=10, size=1.5):
    e = size * np.random.default_rng(6).standard_normal((runs, steps, 1))
    return e, np.full((runs, steps, 1), 1.645)


def test_bounds_are_corrected_and_judged_by_others():
    e, bounds = drawn()
    found = cs.correct(e, bounds=bounds, level="90%", axes=["x"])
    (factor,) = found.factors
    assert factor.factor == pytest.approx(1.5, rel=0.05)
    assert factor.interval.holds(1.5)
    assert found.status == "consistent"
    assert found.rates["bound_x"].value == pytest.approx(0.1, abs=0.006)
    assert found.before.status == "overconfident"
    ratios = np.abs(found.after.record.errors.bound_ratios[..., 0] if found.after.record else e[..., 0])
    assert "before and in" in repr(found)
    assert (ratios.shape, len(found.judged)) == ((400, 10), 400)
    half = cs.correct(e, bounds=bounds, level="90%", axes=["x"], held_out="half")
    assert (len(half.fitted), len(half.judged)) == (200, 200)
    other = cs.correct(e[:200], bounds=bounds[:200], level="90%", axes=["x"])
    assert half.factors[0].factor == other.factors[0].factor
    assert half.rates["bound_x"].value == pytest.approx((np.abs(e[200:]) > 1.645 * half.factors[0].factor).mean())


def test_each_run_is_judged_without_itself():
    e, bounds = drawn(30, 4)
    e[4] *= 100.0
    found = cs.correct(e, bounds=bounds, level="90%", axes=["x"])
    own = np.abs(e[..., 0]) / 1.645 / found.factors[0].left_out[:, None]
    assert found.rates["bound_x"].value == pytest.approx((own > 1).mean())
    assert found.factors[0].left_out[4] < found.factors[0].factor


def test_rows_may_be_runs_of_bounds():
    e, bounds = drawn(300, 1)
    by_rows = cs.correct(e[:, 0], bounds=bounds[:, 0], level=0.9, axes=["x"], independent=True)
    assert by_rows.factors[0].factor == cs.correct(e, bounds=bounds, level=0.9, axes=["x"]).factors[0].factor
    assert "300 rows" in by_rows.sentence


def table(path, runs=60, steps=8, rare=60):
    rng = np.random.default_rng(8)
    lines = ["run,t,x,true_x,bound_x,light"]
    for run in range(runs):
        for k in range(steps):
            light = "dark" if k % 2 else "night" if run < rare and k == 0 else "bright"
            size = {"dark": 3.0, "bright": 1.0, "night": 1.0}[light]
            lines.append(f"{run},{k},{size * rng.normal():.6f},0,1.645,{light}")
    path.write_text("\n".join(lines) + "\n")
    return path


def test_groups_have_factors_of_their_own(tmp_path, capsys):
    path = table(tmp_path / "est.csv", rare=3)
    words = ("correct", path, "--level", "90%", "--by", "light")
    out, _ = consistency(capsys, *words, "--out", tmp_path / "c")
    saved = tomllib.loads((tmp_path / "c" / "correction.toml").read_text())
    factor = {each.get("group"): each["factor"] for each in saved["factors"]}
    assert factor["light is dark"] == pytest.approx(3.0, rel=0.25)
    assert factor["light is bright"] == pytest.approx(1.0, rel=0.25)
    assert factor["light is night"] == factor[None]  # three runs
    assert "light is night: 3 runs of 10 needed; the factor is that of all steps" in out
    data = json.loads(consistency(capsys, *words, "--json")[0])
    assert data["corrected"][0]["outside"] <= 0.1
    record = cs.read(path, level=0.9, by="light")
    found = cs.correct(record)
    expected = np.abs(record.errors.bound_ratios[..., 0])
    for group, number in (("light is dark", 1), ("light is bright", 0), ("light is night", 2)):
        (of,) = (each for each in found.factors if each.group == group)
        place = record.groups.names.index(group)
        expected = np.where(record.groups.index == place, expected / of.left_out[:, None], expected)
        assert number >= 0
    assert found.rates["bound_x"].value == pytest.approx((expected > 1).mean())


def test_a_stated_bound_is_not_taken_for_nothing(tmp_path, capsys):
    out, notes = consistency(capsys, "correct", table(tmp_path / "est.csv"), "--level", "90%")
    assert "states no covariance" not in notes
    assert "held-out errors leave bound_x" in out


def test_what_cannot_be_corrected_is_refused(tmp_path, capsys):
    path = table(tmp_path / "est.csv", runs=9)
    assert "9 runs of 10 that a factor for 90 %" in refused(capsys, "correct", path, "--level", "90%")
    assert "--independent" in refused(capsys, "correct", path, "--level", "90%")
    assert "--per axis" in refused(capsys, "correct", path, "--level", "50%", "--per", "axis")
    e, bounds = drawn(40)
    with pytest.raises(cs.InputError, match="bound_x: errors or bounds are 0"):
        cs.correct(0 * e, bounds=bounds, level=0.9, axes=["x"])
    with pytest.raises(cs.InputError, match="bound_x: errors or bounds are 0"):
        cs.correct(e, bounds=0 * bounds, level=0.9, axes=["x"])
    with pytest.raises(cs.InputError, match="covariances, bounds"):
        cs.correct(e, np.ones((40, 10, 1, 1)), bounds=bounds, level=0.9)
    with pytest.raises(cs.InputError, match="bounds and level"):
        cs.correct(e, level=0.9)
