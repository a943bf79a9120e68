"""Groups of runs and steps by a column: how they are cut, judged, named, refused and read."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from command import consistency
from records import changed
from scipy import stats

import consistency as cs
from consistency.diagnostics import Settings, judge, make_record
from consistency.referee.diagnostics.groups import (
    Column,
    column_of,
    groups_of,
    made_from_errors,
    on_steps,
    selects_on_outcome,
)
from consistency.referee.diagnostics.number_of_runs import group_runs, power_of, required_runs
from consistency.referee.diagnostics.planning import in_pieces
from consistency.referee.diagnostics.scale import equivalence, ratio_interval, scale_test, weighted_of
from consistency.referee.diagnostics.verdict_parts import GROUP, SHARES, shares_of
from consistency.referee.pages.ratio_figures import ratio_by_group_figure


def errors(runs=40, steps=20, n=2, seed=1):
    """Errors of unit variance, which are the same in every call, and their covariances."""
    error = np.random.default_rng(seed).standard_normal((runs, steps, n))
    return error, np.broadcast_to(np.eye(n), (*error.shape, n)).copy()


def wrong_in_the_first(steps=20):
    """Errors twice as large where a column of 0, 1, 2, 3 is 0, their covariances, and the column."""
    error, covariance = errors(steps=steps)
    column = np.tile(np.arange(steps) % 4, (len(error), 1))
    error[column == 0] *= 2.0
    return error, covariance, column


# --- how a column is cut -------------------------------------------------------------------------------------


def test_numbers_are_cut_at_quantiles_with_few_digits():
    values = np.arange(1.0, 101.0)
    groups = groups_of(column_of("n", values), 4)
    assert groups.edges == (25.0, 50.0, 75.0)
    assert groups.names == ("n <= 25", "25 < n <= 50", "50 < n <= 75", "n > 75")
    assert np.bincount(groups.index).tolist() == [25, 25, 25, 25]
    assert groups_of(column_of("n", values / 300.0), 2).edges == (0.17,)
    assert groups_of(column_of("t", 1.7e9 + values), 2).edges == (1700000050.0,)


def test_values_that_are_the_same_stay_together():
    few = groups_of(column_of("sats", [4, 4, 4, 4, 5, 6, 6]), 5)
    assert few.names == ("sats <= 4", "4 < sats <= 5", "sats > 5")
    assert np.bincount(few.index).tolist() == [4, 1, 2]
    tied = groups_of(column_of("n", np.r_[np.zeros(80), np.arange(1.0, 21.0)]), 5)
    assert tied.edges == (0.0,)


def test_edges_can_be_given_and_used_again():
    groups = groups_of(column_of("n", [1.0, 40.0, 41.0, np.nan, np.inf]), [40, 120])
    assert groups.index.tolist() == [0, 0, 1, -1, -1]
    assert groups.names[1] == "40 < n <= 120"
    assert groups_of(column_of("n", [200.0]), groups.edges).index.tolist() == [2]


def test_words_are_groups():
    groups = groups_of(column_of("weather", np.array([["sun", "rain"], ["", None]], object)))
    assert groups.names == ("weather is rain", "weather is sun")
    assert groups.index.tolist() == [[1, 0], [-1, -1]]
    assert groups.edges is None
    assert groups_of(column_of("indoor", [True, False])).names == ("indoor is False", "indoor is True")


def test_only_what_is_judged_makes_groups():
    counted = np.array([True, True, True, False])
    assert groups_of(column_of("w", ["a", "b", "b", "c"]), counted=counted).names == ("w is a", "w is b")
    assert groups_of(column_of("n", [1.0, 2.0, 3.0, 99.0]), 2, counted).edges == (2.0,)


@pytest.mark.parametrize(
    "values, bins, why",
    [
        ([1.0, 1.0], 5, "has one value only"),
        ([np.nan], 5, "has no value where errors are judged"),
        (["a", "a"], 5, "has one value only"),
        ([str(i) for i in range(51)], 5, "51 different words; at most 50"),
        ([1.0, 2.0], 1, "bins must be 2 to 50"),
        ([1.0, 2.0], [2.0, 1.0], "must be finite and increase"),
        ([1.0, 2.0], [1.0, np.nan], "must be finite and increase"),
    ],
)
def test_columns_and_bins_that_make_no_groups(values, bins, why):
    with pytest.raises(ValueError, match=why):
        groups_of(column_of("n", values), bins)  # type: ignore[arg-type]


def test_values_of_runs_hold_in_all_of_their_steps():
    assert on_steps([1, 2], (2, 3)).tolist() == [[1, 1, 1], [2, 2, 2]]
    assert on_steps([1, 2, 3], (1, 3)).tolist() == [[1, 2, 3]]
    with pytest.raises(ValueError, match=r"has shape \(3,\), needs \(2, 3\) or \(2,\)"):
        on_steps([1, 2, 3], (2, 3))


# --- weights --------------------------------------------------------------------------------------------------


def test_equal_weights_change_nothing():
    means = np.random.default_rng(2).gamma(5.0, 0.2, 50)
    weights = np.full(50, 7)
    assert scale_test(means, 2, 9, weights=weights) == scale_test(means, 2, 9)
    assert ratio_interval(means, 2, weights=weights) == ratio_interval(means, 2)
    settings = Settings()
    assert equivalence(means, 2, 9, settings, weights=weights) == equivalence(means, 2, 9, settings)


def test_a_weighted_mean_spreads_as_fewer_runs():
    means, weights = np.array([1.0, 2.0, 3.0]), np.array([1, 1, 4])
    found = weighted_of(means, weights)
    assert found.ratio == pytest.approx((1 + 2 + 12) / 6)
    assert found.values.tolist() == pytest.approx([1.75, 2.25, 3.5])
    assert found.squares == pytest.approx((0.25 + 0.25 + 4.0) / 3)
    assert found.cubes == pytest.approx((0.125 + 0.125 + 8.0) / 3)
    test = scale_test(means, 3, 5, weights=weights)  # of few runs: one error in all steps
    assert test.ratio == found.ratio
    assert test.effective_dof == pytest.approx(3 / found.squares)
    low, high = ratio_interval(means, 3, weights=weights)[1:]
    assert high / low > np.divide(*ratio_interval(means, 3)[:0:-1])


def test_runs_count_by_their_steps_in_a_group():
    """By the mean NIS so far a run stays long in a group when later errors are small: plain means are not 1."""
    rng, runs = np.random.default_rng(3), 4000
    variance, error, rows = 1.0, rng.standard_normal(runs), []
    for _ in range(30):
        variance, error = variance + 0.1, error + np.sqrt(0.1) * rng.standard_normal(runs)
        innovation, gain = error + rng.standard_normal(runs), variance / (variance + 1.0)
        scaled = innovation / np.sqrt(variance + 1.0)
        error, variance = error - gain * innovation, (1.0 - gain) * variance
        rows.append((error**2 / variance, scaled))
    nees, innovations = (np.stack([row[i] for row in rows], axis=1) for i in (0, 1))
    groups = groups_of(column_of("sum", innovations.cumsum(axis=1)), [-5.0, 5.0])
    verdict = judge(make_record("kf", nees=nees, dof=1, groups=groups), Settings(1e-6))  # fails with 1e-6 at most
    assert GROUP not in verdict.faults
    middle = np.where(groups.index == 1, nees, np.nan)
    assert np.nanmean(np.nanmean(middle, axis=1)) > 1.02


# --- verdicts -------------------------------------------------------------------------------------------------


def verdict_by(column, **settings):
    error, covariance, _ = wrong_in_the_first()
    return cs.judge(error, covariance, by={"mode": column}, **settings)


@pytest.mark.parametrize("factor, side", [(2.0, "too small"), (0.5, "too large")])
def test_a_fault_in_every_group_is_everywhere(factor, side):
    """A standard error of 2 % tells factors of 4 and 16 apart."""
    error = np.random.default_rng(5).normal(size=(400, 4, 2)) * factor
    error[:, 2] *= factor
    verdict = cs.judge(error, np.tile(np.eye(2), (400, 4, 1, 1)), by={"turn": np.tile([0, 1, 2, 3], (400, 1))}, bins=4)
    sentence = verdict.reasons[0]
    assert f"covariance {side} everywhere, most (x1" in sentence  # x16
    assert "where 1 < turn <= 2" in sentence or "where turn 2" in sentence, sentence
    assert ("ratio 0.0" in sentence) == (factor < 1.0)


def test_the_wrong_group_is_named_and_where_it_is_right():
    error, covariance, column = wrong_in_the_first()
    error[column == 0] /= 2.0  # right everywhere: the same draws
    right = cs.judge(error, covariance, by={"mode": column})
    verdict = verdict_by(column)
    assert GROUP in verdict.faults
    assert verdict.status == "overconfident"
    assert verdict.by_group is not None
    assert [group.status for group in verdict.by_group.groups] == ["overconfident", *["consistent"] * 3]
    assert verdict.by_group.worst.name == "mode <= 0"
    assert verdict.by_group.worst.ratio.low > 3.0
    p_value = scale_test(np.square(error[column == 1]).reshape(40, -1).mean(axis=1), 2, 5).p_value
    assert verdict.by_group.groups[1].p_value == pytest.approx(min(1.0, 4.0 * p_value))
    assert "where mode <= 0; consistent where mode > 0" in verdict.reasons[0]
    assert GROUP not in right.faults
    assert "consistent in each of 4 groups by mode" in right.reasons[0]
    assert right.reasons[0].startswith("consistent: ")


def test_without_groups_no_number_changes():
    error, covariance, column = wrong_in_the_first()
    plain = cs.judge(error, covariance)
    assert plain.by_group is None
    assert GROUP not in [answer.question for answer in plain.answers]
    assert "by" not in plain.statistics
    shares = {answer.question: answer.share for answer in cs.judge(error, covariance, by=column).answers}
    assert shares["scale"] == 0.5
    assert sum(shares.values()) == pytest.approx(1.0)


def test_a_wrong_group_makes_a_whole_that_is_right_wrong():
    """The mean over all is 1; one group is too small, and one too large."""
    error, covariance = errors(runs=80)
    names = np.array(list("abcd"))[(np.arange(20) + np.arange(80)[:, None]) % 4]
    error[names == "a"] *= np.sqrt(1.8)
    assert cs.judge(error, covariance, by={"w": np.where(names == "a", "a", "rest")}).status == "overconfident"
    error[names == "b"] *= np.sqrt(0.2)
    verdict = cs.judge(error, covariance, by={"w": names})
    assert "scale" not in verdict.faults
    assert GROUP in verdict.faults
    assert verdict.status == "inconsistent"
    assert verdict.by_group.worst.name == "w is b"
    assert "where w is a" in verdict.reasons[0]
    assert "where w is b" in verdict.reasons[0]
    allowed = cs.judge(error, covariance, by={"w": names}, allow="conservative")
    assert allowed.status == "overconfident"
    assert [g.status for g in allowed.by_group.groups][:2] == ["overconfident", "consistent"]


def test_a_group_on_the_other_side_than_the_whole_makes_it_inconsistent():
    error, covariance = errors(runs=80)
    kinds = np.repeat(["large", "small"], [60, 20])
    error[kinds == "large"] *= 2.0
    assert cs.judge(error, covariance, by={"kind": np.arange(80) % 2}).status == "overconfident"
    error[kinds == "small"] *= 0.4
    assert cs.judge(error, covariance, by={"kind": kinds}).status == "inconsistent"


def test_a_group_in_few_runs_says_so():
    error, covariance = errors(runs=30)
    rare = np.where(np.arange(30) < 4, "rare", "usual")
    verdict = cs.judge(error, covariance, by={"kind": rare})
    rare_group = verdict.by_group.groups[0]
    assert (rare_group.runs, rare_group.steps, rare_group.status) == (4, 80, "undecided")
    (line,) = [line for line in verdict.reasons if line.startswith("kind is rare")]
    assert "in 80 steps of 4 runs, too few to see how steps depend on each other (20 are needed); " in line
    assert line.endswith("such runs would probably decide")


def test_steps_without_a_value_are_counted():
    error, covariance, column = wrong_in_the_first()
    column = column.astype(float)
    column[:, :3] = np.nan
    verdict = cs.judge(error, covariance, by={"mode": column})
    assert verdict.by_group.without == 120
    assert "120 steps without a value of mode are in no group" in verdict.reasons


def test_heavy_tails_in_a_group_are_called_so():
    """Three of forty runs in one group are far larger: no scale that is wrong, however it is found."""
    few, many = (stats.chi2.ppf((np.arange(count) + 0.5) / count, 3) for count in (40, 240))
    few[-3:] *= 2.5
    groups = groups_of(column_of("w", np.repeat(["few", "many"], [40, 240])[:, None]))
    verdict = judge(make_record("tails", nees=np.r_[few, many][:, None], dof=3, groups=groups), Settings(0.2))
    assert verdict.faults == (GROUP,)
    assert verdict.status == "heavy-tailed"


def test_a_tolerated_ratio_is_no_fault_of_a_group():
    column = wrong_in_the_first()[2]
    error, covariance = errors(runs=100)
    error[column[:1].repeat(100, axis=0) == 0] *= np.sqrt(1.3)
    by = {"mode": column[:1].repeat(100, axis=0)}
    assert GROUP in cs.judge(error, covariance, by=by).faults
    tolerant = cs.judge(error, covariance, by=by, tolerance=2.0)
    assert GROUP not in tolerant.faults
    assert {group.status for group in tolerant.by_group.groups} == {"consistent"}
    assert {group.equivalence.factor for group in tolerant.by_group.groups} == {2.0}


def test_standard_deviations_are_judged_by_group_one_by_one():
    error, covariance, column = wrong_in_the_first()
    sigma = np.sqrt(np.diagonal(covariance, axis1=2, axis2=3))
    verdict = cs.judge(error, deviations=sigma, axes=("x", "y"), by={"mode": column})
    assert verdict.by_group is None
    assert verdict.parts["x"].by_group.worst.name == "mode <= 0"
    assert f"{GROUP} of x" in verdict.faults
    assert any(line.startswith("x: mode <= 0: covariance ratio") for line in verdict.reasons)
    assert verdict.statistics["by_part"]["y"]["groups"][0]["status"] == "overconfident"
    error[column == 0] /= 2.0
    right = cs.judge(error, deviations=sigma, axes=("x", "y"), by={"mode": column})
    assert "; x: consistent in each of 4 groups by mode; y: consistent in each of 4 groups by mode" in right.reasons[0]


def test_groups_go_with_runs_windows_and_pieces():
    error, covariance, column = wrong_in_the_first()
    groups = groups_of(column_of("mode", column))
    record = make_record("mine", error, covariance, nees=np.square(error).sum(-1), dof=2, groups=groups)
    assert record.first_runs(3).groups.index.shape == (3, 20)
    as_runs = changed(record, independent=True).as_runs
    assert as_runs.groups.index.shape == (800, 1)
    assert as_runs.groups.index[:5, 0].tolist() == [0, 1, 2, 3, 0]
    log = make_record("log", *(array.reshape(1, 800, *array.shape[2:]) for array in (error, covariance)),
                 groups=groups_of(column_of("mode", column.reshape(1, 800))))  # fmt: skip
    assert in_pieces(log, 20).groups.index.shape == (20, 40)
    assert in_pieces(log, 20).groups.index[1, :4].tolist() == [0, 1, 2, 3]


def test_the_plan_counts_on_the_share_of_groups():
    runs = group_runs(3, 1.5, 5)
    asked = [question for question in SHARES if "pose and map" not in question]
    rate = shares_of(asked)[GROUP] * 0.05 / 5
    assert runs == required_runs(3, 1.5, rate)
    assert power_of(3, runs, 1.5, rate) >= 0.95 > power_of(3, runs - 1, 1.5, rate)
    with pytest.raises(ValueError, match="groups must be at least 2"):
        group_runs(3, 1.5, 1)


def test_the_figure_has_a_row_for_each_group():
    (figure,) = ratio_by_group_figure(verdict_by(wrong_in_the_first()[2]))
    assert figure.title == "By mode"
    (axes,) = figure.drawings[0]().axes
    assert [label.get_text() for label in axes.get_yticklabels()] == [
        "mode <= 0", "0 < mode <= 1", "1 < mode <= 2", "mode > 2",
    ]  # fmt: skip
    assert axes.get_xlim()[1] > 3.0
    assert ratio_by_group_figure(cs.judge(*errors())) == ()


# --- what selects on the outcome ------------------------------------------------------------------------------


def test_columns_made_from_the_errors_are_refused():
    error, covariance = errors()
    nees = np.square(error).sum(-1)
    made = {"a": nees, "b": np.log(nees), "c": np.abs(error[..., 1]), "d": -error[..., 0], "e": nees > 9.21}
    for name, values in made.items():
        with pytest.raises(cs.InputError, match=f"^by {name}: the column is made from the errors \\(its values"):
            cs.judge(error, covariance, by={name: values})
    for name in ("NEES", "pos_error", "posErr", "ape"):
        with pytest.raises(cs.InputError, match="its name says"):
            cs.judge(error, covariance, by={name: np.arange(40)})


def test_honest_columns_are_not_refused():
    error, covariance = errors()
    flat, nees = error.reshape(-1, 2), np.square(error).sum(-1).ravel()
    number = np.arange(len(flat)) % 40.0
    assert made_from_errors("n_matches", number, flat, nees) == ""
    assert made_from_errors("terrorist", number, flat, nees) == ""
    indoor = number < 20  # a hundred times too small in one of both, without a threshold
    assert made_from_errors("indoor", indoor * 1.0, flat, np.where(indoor, 1e4 * nees + 900.0, nees)) == ""
    assert selects_on_outcome(Column("t", flat[:, 0]), ("x", "y"), truth=flat) == ""
    assert selects_on_outcome(Column("n_matches", number), ("x", "y"), flat, flat, covariance) == ""


def test_the_way_of_one_run_is_not_its_drift():
    """Errors that only grow are in the order of the way, of which they are not made."""
    way = np.linspace(0.0, 100.0, 200)
    drift = np.column_stack([0.01 * way, 0.001 * way**2])
    assert made_from_errors("way", way, drift, np.square(drift).sum(axis=1)) == ""
    assert made_from_errors("far", 1.0 * (way > 50.0), drift, np.square(drift).sum(axis=1)) == ""
    assert selects_on_outcome(Column("way", way), ("x", "y"), truth=np.column_stack([way, way])) == ""


@pytest.mark.parametrize("names, selects", [
    ("x true_x x_gt est_y sigma P_xx std_y", True), ("p_hpa gnss_std speed true_speed t var_of_matches", False),
])  # fmt: skip
def test_names_that_select_on_the_outcome(names, selects):
    for name in names.split():
        assert (selects_on_outcome(Column(name, np.arange(40.0)), ("x", "y")) != "") is selects, name


def test_groups_of_the_outcome_show_and_do_not_convict():
    rng = np.random.default_rng(6)
    error, variance = rng.standard_normal((60, 20, 1)), rng.chisquare(5, (60, 20)) / 5.0
    verdict = cs.judge(error, variance[..., None, None], by={"quality": 3.0 * np.sqrt(variance)})
    assert GROUP not in [answer.question for answer in verdict.answers]
    ratios = [group.ratio.value for group in verdict.by_group.groups]
    assert ratios[0] > 3.0 > 0.7 > ratios[-1]
    assert {group.status for group in verdict.by_group.groups} == {""}
    assert (
        "quality is a stated sigma, which selects on the outcome: groups show, they do not convict" in verdict.reasons
    )
    assert "groups by quality are reported and not judged" in verdict.reasons[0]


# --- files ----------------------------------------------------------------------------------------------------


@pytest.fixture
def table(tmp_path):
    """Runs of one component with their truth, whose P is too small by x4 where n_matches is 5."""
    rng, rows = np.random.default_rng(8), []
    for run in range(40):
        for step in range(1, 21):
            matches = 5 if step % 4 == 0 else 100 + step
            truth = 3.0 * rng.standard_normal()
            estimate = truth + rng.standard_normal() * (2.0 if matches == 5 else 1.0)
            rows.append(f"{run},{step},{step / 10},{estimate},{truth},1,{matches},{'ab'[run % 2]},{abs(truth)}")
    header = "run,step,t,a,true_a,P_a_a,n_matches,site,far\n"
    (tmp_path / "est.csv").write_text(header + "\n".join(rows) + "\n")
    return tmp_path / "est.csv"


def test_a_column_of_the_table(table, capsys):
    out, _ = consistency(capsys, "analyse", table, "--state", "a", "--by", "n_matches", "--bins", "40,", "--json")
    by = json.loads(out)["est"]["statistics"]["by"]
    assert [group["name"] for group in by["groups"]] == ["n_matches <= 40", "n_matches > 40"]
    assert [group["status"] for group in by["groups"]] == ["overconfident", "consistent"]
    assert [group["steps"] for group in by["groups"]] == [200, 600]
    record = cs.read(table, state=["a"], by="site")
    assert record.groups.names == ("site is a", "site is b")
    assert record.groups.index[:3, 0].tolist() == [0, 1, 0]


def test_the_size_of_the_truth_is_seen_by_its_values(table):
    verdict = cs.judge(cs.read(table, state=["a"], by="far"))
    assert verdict.by_group.outcome == "is a component of the truth"
    assert GROUP not in [answer.question for answer in verdict.answers]


def test_a_table_beside_the_estimates(table, tmp_path):
    """The last value at or before a step counts; before the first there is none."""
    (tmp_path / "sats.csv").write_text("run,t,sats\n" + "".join(f"{run},0.5,9\n{run},1.2,4\n" for run in range(40)))
    record = cs.read(table, state=["a"], by="sats", by_file=tmp_path / "sats.csv")
    assert record.runs.by[7, :4].tolist() == pytest.approx([np.nan] * 4, nan_ok=True)
    assert record.runs.by[7, 4:11].tolist() == [9.0] * 7
    assert record.runs.by[7, 11:].tolist() == [4.0] * 9
    (tmp_path / "sites.csv").write_text("run,site\n" + "".join(f"{run},{'ab'[run % 2]}\n" for run in range(40)))
    record = cs.read(table, state=["a"], by="site", by_file=tmp_path / "sites.csv")
    assert record.groups.index[:3, -1].tolist() == [0, 1, 0]


def test_groups_of_a_single_run_are_undecided_in_a_line():
    """The ratio of each group, and one line on the runs that are missing."""
    error, covariance = errors(runs=1, steps=400)
    verdict = cs.judge(error, covariance, by={"t": np.arange(400.0)[None]}, bins=[199.0])
    assert "all 2 groups by t undecided" in verdict.reasons[0]
    ratio = np.square(error[0, :200]).mean()
    assert f"t <= 199: covariance ratio {ratio:.2f}, in 200 steps" in verdict.reasons
    [advice] = [line for line in verdict.reasons if line.startswith("groups by t are undecided: ")]
    assert "1 run, too few to see how steps depend on each other (20 are needed); " in advice
    many, covariance = errors(runs=20, steps=4)
    verdict = cs.judge(many, covariance, by={"t": np.tile(np.arange(4.0), (20, 1))}, bins=[1.0])
    assert not any("are undecided" in line for line in verdict.reasons)
    assert any(line.startswith("t <= 1: covariance ratio ") and "[" in line for line in verdict.reasons)


def test_a_trajectory_with_a_table(tmp_path):
    rng, t = np.random.default_rng(9), np.arange(400) / 10.0
    poses = np.column_stack([t, rng.standard_normal((400, 3)), np.zeros((400, 3)), np.ones(400)])
    covariance = np.column_stack([t, np.tile(0.01 * np.eye(6).ravel(), (400, 1))])
    estimate = poses + np.column_stack([np.zeros(400), 0.1 * rng.standard_normal((400, 3)), np.zeros((400, 4))])
    for name, rows in (("truth", poses), ("est", estimate), ("P", covariance)):
        np.savetxt(tmp_path / f"{name}.txt", rows)
    (tmp_path / "m.csv").write_text("t,n_matches\n" + "".join(f"{k / 10},{k % 7}\n" for k in range(0, 400, 2)))
    files = {"truth": tmp_path / "truth.txt", "covariance": tmp_path / "P.txt", "error": "so3"}
    record = cs.read(tmp_path / "est.txt", **files, by="n_matches", by_file=tmp_path / "m.csv")
    assert record.runs.by[0, :4].tolist() == [0.0, 0.0, 2.0, 2.0]
    assert cs.read(tmp_path / "est.txt", **files, by="t").runs.by[0] == pytest.approx(t)
    with pytest.raises(cs.InputError, match="has no columns of its own; by_file=FILE names a table"):
        cs.read(tmp_path / "est.txt", **files, by="n_matches")
    names = "t,x,y,z,qx,qy,qz,qw,n_matches"
    named = np.column_stack([estimate, np.arange(400) % 7])
    np.savetxt(tmp_path / "named.csv", named, delimiter=",", header=names, comments="")
    record = cs.read(tmp_path / "named.csv", **files, by="n_matches")
    assert record.runs.by[0, :4].tolist() == [0.0, 1.0, 2.0, 3.0]


def test_windows_take_the_value_at_their_beginning(tmp_path):
    rng, rows, true = np.random.default_rng(10), [], []
    for step in range(41):
        small, P = 0.01 * rng.standard_normal(3), "0.0001,0,0,0.0001,0,0.0001"
        rows.append(f"{step},{small[0]},{small[1]},{small[2]},{P},{step % 4}")
        true.append(f"{step},0,0,0")
    (tmp_path / "est.csv").write_text("t,x,y,heading,P_xx,P_xy,P_xh,P_yy,P_yh,P_hh,mode\n" + "\n".join(rows) + "\n")
    (tmp_path / "truth.csv").write_text("t,x,y,heading\n" + "\n".join(true) + "\n")
    record = cs.read(
        tmp_path / "est.csv", tmp_path / "truth.csv", relative=2, motions=True, windows="independent", by="mode"
    )
    assert record.runs.by[0, :4].tolist() == [0.0, 2.0, 0.0, 2.0]
    assert record.as_runs.groups.index[:4, 0].tolist() == [0, 1, 0, 1]


def test_innovations_have_no_groups(tmp_path):
    (tmp_path / "nis.csv").write_text("t,nis,nis_dof,mode\n0,1,1,1\n1,1,1,2\n")
    with pytest.raises(cs.InputError, match=r"by=mode: .*nis.csv has no truth"):
        cs.read(tmp_path / "nis.csv", by="mode")


def test_a_component_that_is_not_judged_is_environment(tmp_path):
    rng = np.random.default_rng(11)
    rows = [f"{k},{a},0,{a + b},{c},1,{a}" for k, (a, b, c) in enumerate(rng.standard_normal((60, 3)))]
    (tmp_path / "est.csv").write_text("t,a,P_a_b,true_a,b,P_a_a,mine\n" + "\n".join(rows) + "\n")
    assert cs.read(tmp_path / "est.csv", state=["a"], by="b").groups.outcome == ""
    assert cs.read(tmp_path / "est.csv", state=["a"], by="a").groups.outcome == "is a component of the estimate"
    assert cs.read(tmp_path / "est.csv", state=["a"], by="mine").groups.outcome == "is a component of the estimate"


def test_a_key_of_an_archive(tmp_path):
    error, covariance, column = wrong_in_the_first()
    np.savez(tmp_path / "mine.npz", errors=error, covariances=covariance, mode=column, lab=np.arange(40) % 2)
    assert cs.read(tmp_path / "mine.npz", by="lab").groups.index[:3, 5].tolist() == [0, 1, 0]
    assert cs.judge(cs.read(tmp_path / "mine.npz", by="mode")).by_group.worst.name == "mode <= 0"
    with pytest.raises(cs.InputError, match=r"by=speed: .* has no such key; it holds"):
        cs.read(tmp_path / "mine.npz", by="speed")
    nees = np.square(error).sum(-1)
    np.savez(tmp_path / "nees.npz", nees=nees, dof=2, mode=column)
    assert GROUP in cs.judge(cs.read(tmp_path / "nees.npz", by="mode")).faults


@pytest.mark.parametrize(
    "options, message",
    [
        (["--by", "nope"], "--by nope: .*est.csv has no such column; there are: run, step"),
        (["--bins", "4"], "--bins: goes with --by COLUMN"),
        (["--by", "site", "--bins", "4"], "--bins: site holds words, each of which is a group"),
        (["--by", "site", "--by-file", "one.csv"], "one.csv: column 't' or 'run' is missing"),
        (["--by", "site", "--by-file", "two.csv"], "two.csv: holds no run 0"),
        (["--by", "site", "--by-file", "three.csv"], "three.csv, line 3: run 0 has several rows; they need a column t"),
        (["--by", "n_matches", "--bins", "4,x"], "--by n_matches: bins: edges between groups must be finite"),
        (["--by", "n_matches", "--truth-errors", "common"], "does not go with --by"),
    ],
)
def test_options_that_do_not_fit(table, capsys, monkeypatch, options, message):
    monkeypatch.chdir(table.parent)
    for name, text in (("one", "a,site\n1,2\n"), ("two", "run,site\n99,2\n"), ("three", "run,site\n0,1\n0,2\n")):
        Path(f"{name}.csv").write_text(text)
    _, err = consistency(capsys, "analyse", table, "--state", "a", *options, status=2)
    assert re.search(message, err)


def test_plan_says_how_many_runs_groups_take(capsys):
    out, _ = consistency(capsys, "plan", "--detect", "1.5", "--groups", "5")
    each = group_runs(3, 1.5, 5)
    assert f"{5 * each} runs, {each} in each of 5 groups, find that in one group by itself (--by)" in out
    _, err = consistency(capsys, "plan", "--groups", "1", status=2)
    assert "--groups must be at least 2, got 1" in err
