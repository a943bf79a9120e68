"""A filter with an error of its own is judged in it, by either way in; the additive error and the map stand beside."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from invariant import Invariant
from numpy.testing import assert_allclose, assert_array_equal
from recorded import read_recordings

import consistency as cs
from consistency.bench.filters.run_filter import run_filter, step_through
from consistency.bench.runs.montecarlo import run_until_decided
from consistency.bench.runs.results_to_records import analyse, mean_nees_of_runs, record_of, results_source
from consistency.bench.store.results import open_results
from consistency.diagnostics import Interval, Settings, judge, map_score, sequential_design
from consistency.referee.column_names import OWN_COVARIANCE
from consistency.referee.diagnostics.scale import ratio_interval
from consistency.referee.diagnostics.verdict import MapScore
from consistency.referee.gating.checked_input import record_of_filter
from consistency.referee.show.terminal import show
from consistency.referee.types import Failure
from consistency.referee.verdicts.compare_sources import baseline
from consistency.referee.verdicts.tables import document, map_text

RUNS = 24
KEYS = ["run", "step", "t", "x", "y", "heading"]


@pytest.fixture(scope="module")
def results(uvd):
    return cs.run_trials(uvd, ["ekf-uvd", Invariant()], runs=RUNS, seed=5, jobs=1)


@pytest.fixture(scope="module")
def folder(results, tmp_path_factory):
    out = tmp_path_factory.mktemp("own") / "run"
    results.write(out)
    return out


def export(results, name, out):
    """What a user would write of a filter: its poses with the covariance of its own error, and the truth."""
    rows = results.estimates[results.estimates["filter"] == name]
    own = rows[list(OWN_COVARIANCE)].rename(columns=lambda column: column.removeprefix("own_"))
    pd.concat([rows[KEYS], own], axis=1).to_parquet(out / f"{name}.parquet", index=False)
    results.truth.to_parquet(out / "truth.parquet", index=False)
    return out / f"{name}.parquet", out / "truth.parquet"


@pytest.fixture(scope="module")
def exported(results, tmp_path_factory):
    return export(results, "right", tmp_path_factory.mktemp("exported"))


# --- both ways in give the same number --------------------------------------------------------------


def test_both_ways_in_give_the_same_nees_and_verdict(results, exported):
    c = record_of(results, "right")
    [recording] = read_recordings(*exported, error="right")
    assert_allclose(recording.errors.nees, c.errors.nees, rtol=1e-9)
    assert_allclose(recording.errors.error[:, 1:], c.errors.error[:, 1:], rtol=0, atol=1e-12)
    ours, theirs = cs.analyse(results)["right"], analyse([recording])["right"]
    assert (ours.status, ours.convention) == (theirs.status, theirs.convention)
    assert ours.statistic == pytest.approx(theirs.statistic, rel=1e-9)
    assert ours.inflation_interval == pytest.approx(theirs.inflation_interval, rel=1e-9)
    [wrong] = read_recordings(*exported, error="so2")
    assert np.nanmax(np.abs(wrong.errors.nees - c.errors.nees)) > 1.0, "negative control"


def test_both_ways_of_the_invariant_filter_of_the_bench(uvd, tmp_path):
    results = cs.run_trials(uvd, ["ri-ekf-uvd"], runs=RUNS, seed=5, jobs=1)
    c = record_of(results, "ri-ekf-uvd")
    [recording] = read_recordings(*export(results, "ri-ekf-uvd", tmp_path), error="right")
    assert_allclose(recording.errors.nees, c.errors.nees, rtol=1e-9)
    ours, theirs = cs.analyse(results)["ri-ekf-uvd"], analyse([recording])["ri-ekf-uvd"]
    assert (ours.status, ours.convention) == (theirs.status, "right")
    trial = cs.simulate(uvd, 3, seed=5)
    compiled = run_filter(cs.get_filter("ri-ekf-uvd"), trial, uvd.belief)
    stepped = step_through(cs.get_filter("ri-ekf-uvd"), trial, uvd.belief)
    assert_allclose(stepped.own, compiled.own, rtol=1e-7, atol=1e-12)
    assert_array_equal(c.errors.covariance[3, 1:], compiled.own[1:])


def test_columns_of_own_errors_serve_only_the_filter_that_has_them(folder):
    by_name = {
        r.name: r for r in read_recordings(folder / "estimates.parquet", folder / "truth.parquet", error="right")
    }
    c = record_of(open_results(folder), "ekf-uvd")
    assert_array_equal(by_name["ekf-uvd"].errors.covariance[:, 1:], c.errors.covariance[:, 1:])
    assert not any("own_P" in note for note in by_name["ekf-uvd"].origin.notes)
    assert any("own_P" in note for note in by_name["right"].origin.notes)


# --- what is judged ---------------------------------------------------------------------------------


def test_a_record_holds_both_errors(results, folder):
    for source in (results, open_results(folder)):
        c = record_of(source, "right")
        rows = results.estimates.query("filter == 'right' and run == 3")
        assert_array_equal(c.errors.nees[3], rows["own_nees"])
        assert_array_equal(c.errors.covariance[3, :, 0, 2], rows["own_P_xh"])
        assert_array_equal(c.errors.covariance[3, :, 2, 0], rows["own_P_xh"])
        assert_array_equal(c.in_world.errors.nees[3], rows["nees"])
        assert_array_equal(c.in_world.innovations.nis[3], rows["nis"])
        assert_array_equal(c.in_world.errors.covariance[3, :, 0, 2], rows["P_xh"])
        assert (c.errors.convention, c.in_world.errors.convention) == ("right", "")
        plain = record_of(source, "ekf-uvd")
        assert (plain.world, plain.in_world, plain.errors.convention) == (None, plain, "")


def test_the_headline_is_of_the_own_error_and_the_world_beside_it(results):
    """Own covariances a quarter of what they should be: the filter is overconfident in its own error alone."""
    columns = list(OWN_COVARIANCE)
    table = results.estimates.copy()
    table[columns] /= 4.0
    table["own_nees"] *= 4.0
    v = analyse(replace(results, estimates=table), ["right"])["right"]
    honest = analyse(results)["right"]
    assert (v.status, v.convention) == ("overconfident", "right")
    assert v.world.status == honest.world.status != "overconfident"
    assert v.scale.mean_anees == pytest.approx(4.0 * honest.scale.mean_anees)
    assert v.world.scale.mean_anees == honest.world.scale.mean_anees
    assert v.in_world is v.world
    plain = analyse(results)["ekf-uvd"]
    assert (plain.world, plain.convention, plain.in_world) == (None, None, plain)
    assert "world" not in plain.statistics
    assert "convention" not in plain.statistics


def test_run_means_and_baselines_are_of_the_own_error(results):
    c = record_of(results, "right")
    assert_allclose(mean_nees_of_runs(c), np.nanmean(c.errors.nees, axis=1), rtol=1e-12)
    of = baseline(results_source(results)).filters["right"]
    assert_allclose(of.nees, mean_nees_of_runs(c) / 3.0, rtol=1e-12)
    world, counted = c.in_world, np.isfinite(c.errors.nees)[..., None]
    square = np.nanmean(np.where(counted, np.square(world.errors.error), np.nan), axis=1)
    assert_allclose(of.squared, square, rtol=1e-12)


def test_a_gate_has_the_own_error_alone(results):
    record = record_of_filter(results_source(results), "right")
    verdict = judge(record)
    assert (verdict.world, verdict.map, verdict.convention) == (None, None, None)
    assert verdict.scale.mean_anees == analyse(results)["right"].scale.mean_anees


def test_a_null_where_the_own_covariance_should_be(results):
    table = results.estimates.copy()
    table.loc[table.index[-5], "own_P_xy"] = np.nan
    with pytest.raises(cs.InputError, match=r"estimates of 'right': column 'own_P_xy' is null, but manifest\.json"):
        analyse(replace(results, estimates=table))


def test_until_decided_says_both(uvd):
    results, verdicts = run_until_decided(uvd, [Invariant()], max_runs=13, seed=5, jobs=1)
    v = verdicts["right"]
    c = record_of(results, "right")
    assert (v.convention, v.runs) == ("right", len(c.run_numbers))
    assert v.world.scale.mean_anees == pytest.approx(np.nanmean(c.in_world.errors.nees[: v.world.runs]))
    assert v.map.runs == v.runs
    again = analyse(results)["right"]
    assert (again.status, again.statistic, again.world.statistic) == (v.status, v.statistic, v.world.statistic)


def test_a_look_scores_the_maps_of_its_own_runs(results):
    record, design = record_of(results, "ekf-uvd"), sequential_design(3, max_runs=12)
    v = judge(record, Settings(), design)
    assert (v.runs, v.map.runs) == (12, 12)
    planned = replace(results, manifest=results.manifest | {"until_decided": {"dof": 3, "max_runs": 12}})
    assert analyse(planned, ["ekf-uvd"])["ekf-uvd"].runs == 12
    assert analyse(planned, ["ekf-uvd"], settings=Settings())["ekf-uvd"].runs == RUNS


# --- the map ----------------------------------------------------------------------------------------


def test_a_score_by_hand():
    nan = np.nan
    run, nees = np.array([4, 4, 9, 9, 9, 11]), np.array([3.0, 9.0, nan, 1.5, 1.5, nan])
    score = map_score(run, nees)
    assert score.ratio == ratio_interval(np.array([2.0, 0.5]), 3), "each run counts once"
    assert (score.runs, score.landmarks, score.left_out) == (2, 4, 2)
    assert score.ratio.value == 1.25
    nothing = map_score(run[-1:], nees[-1:])
    assert (nothing.runs, nothing.landmarks, nothing.left_out) == (0, 0, 1)
    assert np.isnan(nothing.ratio.value)


def test_the_score_is_that_of_the_table(results):
    table = results.map
    means = table[table["filter"] == "ekf-uvd"].groupby("run")["nees"].mean() / 3.0
    v = analyse(results)["ekf-uvd"]
    assert v.map.ratio.value == pytest.approx(means.mean())
    assert (v.map.runs, v.map.landmarks) == (RUNS, len(table) // 2)
    in_json = [v.statistics[f"map_{key}"] for key in ("ratio", "runs", "landmarks", "left_out")]
    assert in_json == [v.map.ratio.value, RUNS, len(table) // 2, 0]


def test_the_map_is_no_part_of_the_verdict(results):
    bad = results.map.assign(nees=1e6)
    with_map, without = (analyse(replace(results, map=m))["ekf-uvd"] for m in (bad, None))
    assert with_map.map.ratio.value > 1e5
    assert without.map is None
    assert (with_map.status, with_map.reasons, with_map.answers) == (without.status, without.reasons, without.answers)
    assert not any(key.startswith("map") for key in without.statistics)


# --- terminal ---------------------------------------------------------------------------------------


def printed(capsys, *names, results):
    show(*document(analyse(results, list(names)), reasons=False).opening)
    return capsys.readouterr().out.splitlines()


def test_the_terminal_names_each_error(results, capsys):
    head, plain, own, world, *below = printed(capsys, "ekf-uvd", "right", results=results)
    v = analyse(results)["right"]
    assert head.split()[:4] == ["filter", "error", "verdict", "ANEES"]
    assert plain.split()[:2] == ["ekf-uvd", "so2"]
    assert own.split()[:4] == ["right", "right", v.status, f"{v.scale.mean_anees:.2f}"]
    assert f"{v.world.accuracy.rmse_position:.3f}" in own.split()
    assert world.split()[:5] == ["so2,", "beside", "it", v.world.status, f"{v.world.scale.mean_anees:.2f}"]
    assert below[0].startswith("error right: Log(truth estimate^-1) of SE(2), in the world frame; so2: position")
    assert below[1].startswith("map after the last step, mean NEES / 3: ekf-uvd ")
    assert f"right {v.map.verdict.status}, {map_text(v.map)}" in below[1]


def test_without_maps_and_own_errors_nothing_is_added(results, capsys):
    lines = printed(capsys, "ekf-uvd", results=replace(results, map=None))
    assert len(lines) == 2  # no axis has an interval without 1
    assert lines[0].split()[:3] == ["filter", "verdict", "ANEES"]
    with_map = printed(capsys, "ekf-uvd", results=results)
    assert with_map[:2] == lines
    assert len(with_map) == 3


def test_a_verdict_in_words(results):
    v = analyse(results)["right"]
    text = str(v)
    assert "  error             right: Log(truth estimate^-1) of SE(2), in the world frame" in text
    assert "(additive error, 'so2')" in text
    assert f"after the last step; the map is {v.map.verdict.reasons[0]}" in text
    plain = str(analyse(replace(results, map=None))["ekf-uvd"])
    assert "map" not in plain
    assert "error  " not in plain


@pytest.mark.parametrize(
    "score, text",
    [
        (MapScore(Interval(1.5, 1.1, 2.1), 3, 30, 0), "1.50 [1.10, 2.10]"),
        (MapScore(Interval(1.5, 1.1, 2.1), 3, 30, 2), "1.50 [1.10, 2.10] (2 of 32 landmarks left out)"),
        (MapScore(Interval(np.nan, np.nan, np.nan), 0, 0, 2), "- (2 of 2 landmarks left out)"),
    ],
)
def test_a_score_in_words(score, text):
    assert map_text(score) == text


def test_some_runs_have_both_errors_and_their_own_failures(results):
    failures = (Failure("right", 3, 2, "NaN"), Failure("right", 11, 2, "NaN"))
    c = replace(record_of(results, "right"), failures=failures)
    some = c.first_runs(10)
    assert_array_equal(some.errors.nees, c.errors.nees[:10])
    assert_array_equal(some.in_world.errors.nees, c.in_world.errors.nees[:10])
    assert_array_equal(some.errors.covariance, c.errors.covariance[:10])
    assert_array_equal(some.in_world.errors.error, c.in_world.errors.error[:10])
    assert_array_equal(some.run_numbers, np.arange(10))
    assert some.failures == failures[:1]
    one = c.of_runs(np.flatnonzero(c.run_numbers == 11))
    assert (one.innovations.nis.shape[0], one.failures) == (1, failures[1:])
