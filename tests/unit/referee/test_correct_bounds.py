"""Bounds that ``correct`` has corrected: by the definition of the factor, held out, by group; and what is refused."""

import json
import tomllib
from dataclasses import replace

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
    ratios = np.abs(found.after.record.errors.bounded.ratios[..., 0] if found.after.record else e[..., 0])
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


def test_a_step_without_a_group_has_the_factor_of_all(tmp_path):
    record = cs.read(table(tmp_path / "rx.csv"), level=0.9, by="light")
    index = record.groups.index.copy()
    index[:, 5] = -1
    record = replace(record, groups=replace(record.groups, index=index))
    found = cs.correct(record)
    expected = np.abs(record.errors.bounded.ratios[..., 0])
    for of in found.factors:
        here = index == (record.groups.names.index(of.group) if of.group else -1)
        expected = np.where(here, expected / of.left_out[:, None], expected)
    assert found.rates["bound_x"].value == pytest.approx((expected > 1).mean())


def test_corrected_bounds_are_not_compared_with_an_alert_limit(tmp_path):
    """The regions are those of the bounds that were stated."""
    record = cs.read(table(tmp_path / "rx.csv"), level=0.9, alert_limit=2.0)
    assert cs.judge(record).bounds[0].alerts is not None
    found = cs.correct(record)
    assert [verdict.bounds[0].alerts for verdict in (found.before, found.after)] == [None, None]


def test_tables_are_written_with_corrected_bounds(tmp_path, capsys):
    """Radius, interval and bound, named by --columns: what analyse reads of each table is what correct said of it."""
    rng = np.random.default_rng(9)
    rows = ["run;t;x;y;z;true_x;true_y;true_z;h_acc;lo;x_high;bound_z;z_low;z_high;light"]
    for run in range(1, 41):
        for k in range(4):
            x, y, z = rng.normal(size=3) * (1.0 + k)
            cells = [run, k, x, y, z, 0, 0, 0, 2.0, x - 1.5, x + 2.5, 1.5, z - 1, z + 1, "light" if k < 2 else "dark"]
            rows.append(";".join(map(str, cells)))
    path = tmp_path / "est.csv"
    path.write_text("# a receiver\n" + "\n".join(rows) + "\n")
    words = ("--state", "x,y,z", "--columns", "radius_x_y=h_acc,x_low=lo", "--level", "80%", "--by", "light")
    out, _ = consistency(capsys, "correct", path, *words, "--out", tmp_path / "c")
    assert str(tmp_path / "c/held-out/est.csv") in out
    columns = {"radius_x_y": "h_acc", "x_low": "lo"}
    options = {"state": ["x", "y", "z"], "columns": columns, "level": "80%", "by": "light"}
    stated = cs.read(path, **options)
    found = cs.correct(stated)
    for name, factors in (("corrected", lambda of: of.factor), ("held-out", lambda of: of.left_out[:, None])):
        text = (tmp_path / "c" / name / "est.csv").read_text()
        assert text.splitlines()[:2] == path.read_text().splitlines()[:2]
        restated = cs.read(tmp_path / "c" / name / "est.csv", **options).errors.bounded.ratios
        for b, bound in enumerate(stated.errors.bounded.bounds):
            for of in found.factors:
                if of.bound == bound and of.group:
                    own = stated.groups.index == stated.groups.names.index(of.group)
                    expected = stated.errors.bounded.ratios[..., b] / factors(of)
                    np.testing.assert_allclose(restated[..., b][own], expected[own], rtol=1e-9)
    judged = cs.judge(cs.read(tmp_path / "c/held-out/est.csv", **options)).bounds
    assert judged[0].rate == pytest.approx(found.rates[judged[0].name].value)


def test_an_interval_without_an_estimate_is_written_about_its_middle(tmp_path, capsys):
    path = tmp_path / "hub.csv"
    rows = [f"{run},1,{run % 7 - 3},{-1.0 - run % 2},{1.0 + run % 2}" for run in range(60)]
    path.write_text("\n".join(["run,step,true_x,x_low,x_high", *rows]) + "\n")
    consistency(capsys, "correct", path, "--level", "60%", "--out", tmp_path / "c", "--held-out", "half")
    (factor,) = tomllib.loads((tmp_path / "c/correction.toml").read_text())["factors"]
    low, high = np.loadtxt(tmp_path / "c/corrected/hub.csv", delimiter=",", skiprows=1)[:, 3:].T
    size = factor["factor"] * (1.0 + np.arange(60) % 2)
    np.testing.assert_allclose([low, high], [-size, size])
    held_out = np.loadtxt(tmp_path / "c/held-out/hub.csv", delimiter=",", skiprows=1)
    assert held_out[:, 0].tolist() == list(range(30, 60))
    np.testing.assert_allclose(held_out[:, 4], size[30:])


def test_rows_and_archives_are_not_told_apart_in_a_file(tmp_path, capsys):
    """Rows have corrected bounds alone; an archive has factors alone; groups of a file beside write no table."""
    path = tmp_path / "est.csv"
    path.write_text("\n".join(["t,x,true_x,bound_x", *(f"{k},{k % 5 - 2},0,1.0" for k in range(80))]) + "\n")
    words = ("correct", path, "--level", "80%", "--independent", "--state", "x", "--anyway", "--out")
    out, _ = consistency(capsys, *words, tmp_path / "c")
    assert "corrected/est.csv" in out
    assert "held-out/" not in out
    (factor,) = tomllib.loads((tmp_path / "c/correction.toml").read_text())["factors"]
    bound = np.loadtxt(tmp_path / "c/corrected/est.csv", delimiter=",", skiprows=1)[:, 3]
    np.testing.assert_allclose(bound, factor["factor"])
    of_runs = tmp_path / "runs.csv"
    of_runs.write_text(
        "\n".join(["run,t,x,true_x,bound_x", *(f"{k % 4},{k},{k % 5 - 2},0,1.0" for k in range(80))]) + "\n"
    )
    out, _ = consistency(capsys, "correct", of_runs, *words[2:], tmp_path / "r")
    assert "corrected/runs.csv" in out
    assert "held-out/" not in out
    (tmp_path / "by.csv").write_text("t,light\n" + "\n".join(f"{k},{'ab'[k % 2]}" for k in range(80)) + "\n")
    by = ("--by", "light", "--by-file", tmp_path / "by.csv")
    assert "corrected/est.csv" not in consistency(capsys, *words, tmp_path / "d", *by)[0]
    e, bounds = drawn(60)
    np.savez(tmp_path / "est.npz", errors=e, bounds=bounds)
    out, _ = consistency(capsys, "correct", tmp_path / "est.npz", "--level", "90%", "--anyway", "--out", tmp_path / "n")
    assert "corrected/" not in out
    folder = tmp_path / "runs"
    folder.mkdir()
    for run in range(30):
        (folder / f"{run:02d}.csv").write_text(f"t,x,true_x,radius_x\n0,{run / 9},0,1.0\n1,{run % 3},0,2.0\n")
    consistency(capsys, "correct", folder, "--level", "80%", "--state", "x", "--anyway", "--out", tmp_path / "f")
    read = cs.read(tmp_path / "f/held-out", level="80%", state=["x"])
    found = cs.correct(cs.read(folder, level="80%", state=["x"]))
    assert np.mean(np.abs(read.errors.bounded.ratios) > 1) == pytest.approx(found.rates["radius_x"].value)


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
