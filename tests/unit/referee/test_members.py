"""Members of ensembles, their mean and covariance, and repeats without truth: right ones, wrong ones, bad input.

Right data are judged at a rate of 1e-5 a verdict, so that the file fails by chance less than once in 5,000 runs.
"""

import numpy as np
import pytest
from scipy import special, stats

import consistency as cs
from consistency.errors import InputError
from consistency.referee.diagnostics.normal_numbers import (
    TOGETHER,
    rank_numbers,
    rank_shares,
    rank_tables,
    step_down_numbers,
    step_down_tables,
)
from consistency.referee.diagnostics.number_of_runs import gate_runs
from consistency.referee.gating.checked_input import planned_detect
from consistency.referee.pages.record_figures import record_figures
from consistency.referee.readers.options import make_reading
from consistency.referee.readers.pipeline.read_files import read_recordings
from consistency.testing import ConsistencyError, InsufficientTrials, assert_consistent

RARE = 1e-5
ROOT = np.linalg.cholesky(np.full((3, 3), 0.6) + 0.4 * np.eye(3)).T


def drawn(seed, m=10, runs=80, steps=5, ratio=1.0, root=ROOT):
    """Truth (runs, steps, n) and members (runs, steps, m, n); the truth spreads ``ratio`` times as much."""
    z = np.random.default_rng(seed).standard_normal((runs, steps, m + 1, len(root))) @ root
    return np.sqrt(ratio) * z[:, :, 0], z[:, :, 1:]


def judged(truth, members, **options):
    return cs.judge(members=members, truth=truth, **{"false_alarm": RARE} | options)


def mean_and_covariance(truth, members):
    mean = members.mean(axis=2)
    c = members - mean[:, :, None]
    return truth - mean, np.swapaxes(c, 2, 3) @ c / (members.shape[2] - 1)


# --- numbers -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("below", [0, 1, 4])
def test_a_number_lies_in_the_rank_of_the_truth(below):
    members = np.tile(np.arange(4.0)[:, None], (300, 1, 1))
    u = special.ndtr(rank_numbers(members, np.full((300, 1), below - 0.5), np.random.default_rng(1)))
    assert u.min() >= below / 5
    assert u.max() <= (below + 1) / 5
    assert np.ptp(u) > 0.15  # random within the rank: 300 uniform ones miss a quarter with a chance of 1e-30


def test_members_that_equal_the_truth_share_their_ranks():
    members = np.tile(np.array([0.0, 1.0, 1.0, 2.0])[:, None], (400, 1, 1))
    u = special.ndtr(rank_numbers(members, np.ones((400, 1)), np.random.default_rng(1)))
    assert 0.2 <= u.min() < 0.25
    assert 0.75 < u.max() <= 0.8


def test_the_joint_number_does_not_depend_on_scale_and_correlation_and_is_large_outside():
    points = np.random.default_rng(2).standard_normal((200, 13, 3))
    points[:100, 0] *= 30.0
    A = np.random.default_rng(3).standard_normal((3, 3)) * [1.0, 1e3, 1e-3]
    u = [rank_numbers(x[:, 1:], x[:, 0], np.random.default_rng(4))[:, 3] for x in (points, points @ A + 7.0)]
    np.testing.assert_allclose(*u, rtol=1e-9)
    assert (2.0 * special.ndtr(-np.abs(u[0][:100])) <= 1 / 13).mean() > 0.9
    assert abs(np.sign(u[0]).mean()) < 0.4  # of random sign; by chance once in 1e7


@pytest.mark.parametrize("m, n, numbers", [(3, 3, 3), (4, 3, 4), (9, 1, 1)])
def test_a_joint_number_takes_more_members_than_components(m, n, numbers):
    points = np.random.default_rng(5).standard_normal((6, m + 1, n))
    assert rank_numbers(points[:, 1:], points[:, 0], np.random.default_rng(6)).shape == (6, numbers)
    assert len(rank_tables(m, n)) == numbers


def test_skewed_members_have_uniform_ranks():
    """Of 20,000: Kolmogorov, each number at 1e-6."""
    points = np.expm1(np.random.default_rng(7).standard_normal((20_000, 11, 2)) @ ROOT[:2, :2])
    numbers = rank_numbers(points[:, 1:], points[:, 0], np.random.default_rng(8))
    for column in numbers.T:
        assert stats.kstest(column, "norm").pvalue > 1e-6


@pytest.mark.parametrize("m, shown", [(3, 1.098), (10, 1.245), (20, 1.318), (100, 1.426)])
def test_mean_squares_of_ranks(m, shown):
    """A variance wrong by 1.5 beside m members, and 1 where it is right; by simulation within 5 standard errors."""
    (table,) = rank_tables(m, 1)
    assert table.mean_square(1.5) == pytest.approx(shown, abs=1e-3)
    assert table.mean_square(1.0) == pytest.approx(1.0, abs=1e-12)
    assert table.ratio(table.mean_square(0.3)) == pytest.approx(0.3)
    rng = np.random.default_rng(9)
    z = rank_numbers(rng.standard_normal((20_000, m, 1)), 1.5 * rng.standard_normal((20_000, 1)), rng)
    assert np.square(z).mean() == pytest.approx(table.mean_square(2.25), abs=5 * np.square(z).std() / 140)


def test_mean_squares_have_a_ceiling():
    (table,) = rank_tables(3, 1)
    assert table.ratio(2.0) == np.inf
    assert table.ratio(0.1) == table.true[0]
    assert table.factor(1.5) == pytest.approx(1.098, abs=2e-3)


def test_mean_square_of_the_joint_number():
    """Within 5 standard errors of both simulations."""
    rng = np.random.default_rng(10)
    z = rank_numbers(rng.standard_normal((8000, 12, 3)), 1.5 * rng.standard_normal((8000, 3)), rng)[:, 3]
    table = rank_tables(12, 3)[3]
    assert np.square(z).mean() == pytest.approx(table.mean_square(2.25), rel=0.12)
    assert np.square(z).mean() > 1.5


@pytest.mark.parametrize("N, n", [(5, 1), (5, 4), (10, 3)])
def test_step_down_numbers_are_normal_and_independent(N, n):
    """Of 20,000: Kolmogorov at 1e-6 each, correlations within 5 standard errors."""
    truth, members = drawn(11, N, 20_000, 1, root=np.eye(n) + 0.5)
    e, P = mean_and_covariance(truth, members)
    w = np.linalg.solve(np.linalg.cholesky(P), e[..., None])[:, 0, :, 0]
    z = step_down_numbers(w, N)
    for column in z.T:
        assert stats.kstest(column, "norm").pvalue > 1e-6
    products = z.T @ z / len(z)
    assert np.abs(products - np.diag(np.diag(products))).max() < 5 / np.sqrt(len(z))
    assert np.corrcoef(np.square(z).T).reshape(n, n)[np.triu_indices(n, 1)].max(initial=0.0) < 0.05


def test_mean_squares_of_step_down_numbers():
    """A truth that spreads 2.25 times as much: each component within 5 standard errors."""
    truth, members = drawn(12, 6, 20_000, 1, 2.25)
    e, P = mean_and_covariance(truth, members)
    z = step_down_numbers(np.linalg.solve(np.linalg.cholesky(P), e[..., None])[:, 0, :, 0], 6)
    for column, table in zip(z.T, step_down_tables(6, 3), strict=True):
        assert np.square(column).mean() == pytest.approx(table.mean_square(2.25), abs=5 * np.square(column).std() / 140)


def test_a_number_far_in_the_tail_is_finite():
    assert np.isfinite(step_down_numbers(np.array([[1e9], [-1e9]]), 500)).all()


# --- verdicts ----------------------------------------------------------------------------------------


def test_right_members_are_consistent():
    verdict = judged(*drawn(13, 20, 200), axes=["x", "y", "z"])
    assert verdict.status == "consistent"
    assert list(verdict.parts) == ["x", "y", "z", TOGETHER]
    assert verdict.scale.equivalence.factor == verdict.settings.detect == 1.5
    assert np.isnan(verdict.accuracy.rmse).all()  # of numbers without a unit


@pytest.mark.parametrize("ratio, status", [(4.0, "overconfident"), (0.25, "conservative")])
def test_the_ratio_of_wrong_members_is_that_of_their_covariance(ratio, status):
    truth, members = drawn(14, 10, 200, ratio=ratio)
    verdict = judged(truth, members)
    assert verdict.status == status
    assert verdict.inflation == pytest.approx(ratio, rel=0.25)
    for part in verdict.parts.values():
        assert part.inflation == pytest.approx(ratio, rel=0.6)
    e, P = mean_and_covariance(truth, members)
    verdict = cs.judge(e, P, ensemble=10, false_alarm=RARE)
    assert verdict.status == status
    assert verdict.inflation == pytest.approx(ratio, rel=0.25)
    assert verdict.scale.detectable > 1.1


def test_biased_members_are_biased():
    truth, members = drawn(15, 10, 100)
    assert cs.judge(members=members, truth=truth + 0.4).status == "biased"


def test_few_members_do_not_make_a_wrong_ensemble_consistent():
    """m = 3 shows a ratio of 2.25 as 1.20, far inside [1 / 1.5, 1.5]."""
    verdict = judged(*drawn(16, 3, 400, ratio=2.25, root=np.eye(1)))
    assert verdict.status != "consistent"
    assert 0.67 < verdict.scale.mean_anees < 1.4
    assert verdict.scale.equivalence.interval[1] > 1.5


def test_a_ratio_beyond_what_members_show_is_a_bound():
    verdict = judged(*drawn(34, 3, 60, ratio=1e6, root=np.eye(1)))
    assert verdict.inflation_interval[1] == np.inf
    assert verdict.inflation_interval[0] > 5.0
    assert "at least x" in verdict.reasons[0]
    assert "a few runs" not in verdict.reasons[0]


def test_few_right_members_are_undecided():
    """m = 3 must show mean squares within 1.10 of 1, which 60 runs do not, though they show them within 1.5."""
    verdict = judged(*drawn(32, 3, 60, root=np.eye(1)))
    assert verdict.status == "undecided"
    assert 0.75 < verdict.scale.mean_anees < 1.3


def test_the_tolerance_is_of_the_covariance():
    """m = 5 shows a ratio of 1.7 as 1.2."""
    wrong = drawn(17, 5, 600, ratio=1.7, root=np.eye(1))
    assert judged(*wrong, false_alarm=0.05, tolerance=1.4).status == "overconfident"
    assert judged(*wrong, false_alarm=1e-3, tolerance=2.5, detect=2.5).status == "consistent"


def test_groups_have_ratios_of_the_covariance():
    truth, members = drawn(18, 5, 300, 6, root=np.eye(1))
    truth[:, 3:] *= 2.0
    by = np.tile(np.repeat(["calm", "windy"], 3), (300, 1))
    verdict = cs.judge(*mean_and_covariance(truth, members), ensemble=5, by={"weather": by})
    calm, windy = verdict.by_group.groups
    assert (calm.status, windy.status) == ("consistent", "overconfident")
    assert windy.ratio.value == pytest.approx(4.0, rel=0.3)
    assert calm.equivalence.factor == 1.5


def test_a_right_mean_and_covariance_of_members_is_consistent():
    truth, members = drawn(19, 6, 200)
    e, P = mean_and_covariance(truth, members)
    verdict = cs.judge(e, P, ensemble=6, false_alarm=RARE)
    assert verdict.status == "consistent"
    assert cs.judge(e, P, false_alarm=RARE).status == "overconfident"  # without saying so


def test_members_that_are_not_more_than_components_are_judged_one_by_one():
    truth, members = drawn(20, 3, 300)
    e, P = mean_and_covariance(truth, members)
    verdict = cs.judge(e, P, ensemble=3, axes=["x", "y", "z"], false_alarm=RARE)
    assert not verdict.faults
    assert list(verdict.parts) == ["x", "y", "z"]
    assert "rank 2" in verdict.notes[0]
    sigma = np.sqrt(np.diagonal(P, axis1=2, axis2=3))
    assert cs.judge(e, deviations=sigma, ensemble=3, axes=["x", "y", "z"]).p_value == verdict.p_value


def test_deviations_of_members_are_mapped_one_by_one():
    truth, members = drawn(33, 6, 10)
    e, P = mean_and_covariance(truth, members)
    sigma = np.sqrt(np.diagonal(P, axis1=2, axis2=3))
    record = cs.judge(e, deviations=sigma, ensemble=6).record
    expected = stats.norm.ppf(stats.t.cdf(e / sigma / np.sqrt(1 + 1 / 6), 5))
    np.testing.assert_allclose(record.errors.error, expected, rtol=1e-6)
    assert record.errors.parts == ((0,), (1,), (2,))


def test_a_run_without_members_from_a_step_on_has_failed():
    truth, members = drawn(21)
    members[2, 3:] = np.nan
    verdict = cs.judge(members=members, truth=truth)
    (failure,) = verdict.failures
    assert (failure.run, failure.step) == (2, 4)


# --- repeats -----------------------------------------------------------------------------------------


def repeated(seed, N=20, steps=1, n=3, ratio=1.0):
    rng = np.random.default_rng(seed)
    s = np.exp(rng.standard_normal((N, steps, 1)))
    A = rng.standard_normal((N, steps, n, n))
    P = s[..., None] * (A @ np.swapaxes(A, 2, 3) + np.eye(n))
    noise = np.linalg.cholesky(P) @ rng.standard_normal((N, steps, n, 1))
    return np.sqrt(ratio) * noise[..., 0] + rng.standard_normal((steps, n)) * 100.0, P


def test_repeats_keep_what_the_weighted_mean_leaves():
    """The NEES of all contrasts add to the squares about the weighted mean, whose dof are (N - 1) n."""
    x, P = repeated(22, 7, 2)
    record = cs.judge(x, P, truth="repeats").record
    assert record.errors.error.shape == (6, 2, 3)
    W = np.linalg.inv(P)
    mean = np.linalg.solve(W.sum(axis=0), (W @ x[..., None]).sum(axis=0))[..., 0]
    about = ((x - mean)[..., None, :] @ W @ (x - mean)[..., None])[..., 0, 0]
    np.testing.assert_allclose(record.errors.nees.sum(axis=0), about.sum(axis=0), rtol=1e-9)


def test_contrasts_of_repeats_are_independent_of_those_before():
    """Products over 20,000 draws within 5 standard errors."""
    x, P = repeated(23, 4, 20_000, 1)
    record = cs.judge(x, P, truth="repeats").record
    z = record.errors.error[..., 0] / np.sqrt(record.errors.covariance[..., 0, 0])
    assert np.abs(z @ z.T / z.shape[1] - np.eye(3)).max() < 5 * np.sqrt(2.0 / z.shape[1])


def test_an_error_that_all_repeats_share_changes_nothing_and_is_not_asked():
    x, P = repeated(24)
    verdict, moved = (cs.judge(each, P, truth="repeats") for each in (x, x + 50.0))
    assert verdict.p_value == pytest.approx(moved.p_value)
    assert not {answer.question for answer in verdict.answers} & {"bias", "bias in some step"}
    assert "cannot be seen" in verdict.reasons[0]


@pytest.mark.parametrize("ratio, status", [(6.0, "overconfident"), (1 / 6, "conservative")])
def test_wrong_repeats_are_found(ratio, status):
    x, P = repeated(25, 60, ratio=ratio)
    verdict = cs.judge(x[:, 0], P[:, 0], truth="repeats", independent=True, false_alarm=1e-3)
    assert verdict.status == status
    assert verdict.inflation == pytest.approx(ratio, rel=0.5)


def test_a_repeat_that_is_missing_is_passed_over():
    x, P = repeated(26, 6, 3)
    x[0, 2] = x[3, 1:] = np.nan
    record = cs.judge(x, P, truth="repeats").record
    np.testing.assert_array_equal(np.isnan(record.errors.nees), [[0, 0, 1], [0, 0, 0], [0, 1, 1], [0, 0, 0], [0, 0, 0]])
    rest = cs.judge(np.delete(x, 3, axis=0), np.delete(P, 3, axis=0), truth="repeats").record
    np.testing.assert_allclose(record.errors.nees[[0, 1, 3, 4], 1], rest.errors.nees[:, 1])


# --- files -------------------------------------------------------------------------------------------


def test_files_of_members_are_judged_as_arrays_are(tmp_path):
    truth, members = drawn(27, 6, 30, 4)
    verdict = cs.judge(members=members, truth=truth)
    np.savez(tmp_path / "m.npz", members=members, truth=truth)
    assert cs.judge(tmp_path / "m.npz").p_value == verdict.p_value
    names = ["run", "step", "true_x", "true_y", "true_z", *(f"{axis}{k}" for axis in "abc" for k in range(6))]
    run, step = np.indices((30, 4))
    columns = [run[..., None], step[..., None] + 1, truth, np.swapaxes(members, 2, 3).reshape(30, 4, 18)]
    rows = np.concatenate(columns, axis=2).reshape(120, -1)
    np.savetxt(tmp_path / "m.csv", rows, "%.17g", ",", header=",".join(names), comments="")
    record = cs.read(tmp_path / "m.csv", members={"x": "a*", "y": "b*", "z": "c*"})
    assert list(record.errors.axes) == ["x", "y", "z", TOGETHER]
    assert cs.judge(record).p_value == pytest.approx(verdict.p_value)
    e, P = mean_and_covariance(truth, members)
    np.savez(tmp_path / "e.npz", errors=e, covariances=P)
    (ensemble,) = read_recordings(tmp_path / "e.npz", make_reading(ensemble=6))
    assert cs.judge(ensemble).p_value == cs.judge(e, P, ensemble=6).p_value


def test_files_of_repeats_are_judged_as_arrays_are(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    x, P = repeated(28, 12, 1, 2)
    verdict = cs.judge(x, P, truth="repeats")
    np.savez("r.npz", estimates=x, covariances=P)
    assert cs.judge(cs.read("r.npz", truth="repeats")).p_value == pytest.approx(verdict.p_value)
    rows = np.column_stack([x[:, 0], P[:, 0, 0, 0], P[:, 0, 0, 1], P[:, 0, 1, 1]])
    np.savetxt("r.csv", rows, "%.17g", ",", header="x,y,P_x_x,P_x_y,P_y_y", comments="")
    alone = cs.read("r.csv", truth="repeats", state=["x", "y"])
    assert cs.judge(alone).p_value == pytest.approx(verdict.p_value)
    numbered = np.column_stack([np.arange(12) + 3, np.ones(12), rows])
    np.savetxt("s.csv", numbered, "%.17g", ",", header="run,step,x,y,P_x_x,P_x_y,P_y_y", comments="")
    assert cs.judge(cs.read("s.csv", truth="repeats", state=["x", "y"])).p_value == pytest.approx(verdict.p_value)


def test_ranks_are_drawn(tmp_path):
    truth, members = drawn(29, 40, 50, 4)
    verdict = judged(truth, members, axes=["x", "y", "z"])
    shares, width = rank_shares(verdict.record)
    assert list(shares) == ["x", "y", "z"]
    assert all(len(share) == 21 and share.sum() == pytest.approx(1.0) for share in shares.values())
    assert 0.02 < width < 0.08  # 3.0 of sqrt(1 / 21 / 200) = .015
    far = judged(truth, 0.2 * members, axes=["x", "y", "z"]).record
    assert rank_shares(far)[0]["x"][[0, -1]].min() > 0.2
    figures = {figure.title: figure for figure in record_figures(verdict.record, verdict)}
    for title in ("Ranks among the members", "Spread and skill"):
        figures[title].drawings[0]().savefig(tmp_path / "one.png")


# --- bad input ---------------------------------------------------------------------------------------

TRUTH, MEMBERS = drawn(30, 5, 6, 3)
PARTLY = MEMBERS.copy()
PARTLY[2, 1, 3, 0] = np.nan
X, COVARIANCE = repeated(31, 5)


@pytest.mark.parametrize("given, message", [
    ({"members": PARTLY, "truth": TRUTH}, "members, run 2, step 2: member 4 of 5 .*equally many"),
    ({"members": MEMBERS, "truth": TRUTH[:, :2]}, r"truth has shape \(6, 2, 3\), needs \(6, 3, 3\)"),
    ({"members": MEMBERS[:, 0], "truth": TRUTH[:, 0]}, r"members has shape \(6, 5, 3\).*\(runs, steps, m, n\)"),
    ({"members": [[[[1.0], [2.0]]], [[[1.0]]]], "truth": TRUTH}, "members"),
    ({"members": MEMBERS}, "truth="),
    ({"members": MEMBERS, "truth": "repeats"}, "truth="),
    ({"members": MEMBERS[:, :, :1], "truth": TRUTH}, "2 or more"),
    ({"members": MEMBERS, "truth": TRUTH, "ensemble": 5}, "ensemble"),
    ({"members": MEMBERS, "truth": TRUTH, "weights": MEMBERS[..., 0]}, "weights: .*equal weight"),
    ({"record": X, "covariances": COVARIANCE, "truth": X}, "repeats"),
    ({"record": X, "covariances": COVARIANCE, "ensemble": 1}, "ensemble=1: .*2 or more"),
    ({"record": X[:1], "covariances": COVARIANCE[:1], "truth": "repeats"}, "2 runs"),
])  # fmt: skip
def test_arrays_that_do_not_fit(given, message):
    with pytest.raises(InputError, match=message):
        cs.judge(**given)


TABLE = "run,step,true_x,true_y,a1,a2,b1\n0,1,0,0,1,2,3\n0,2,0,0,1,2,3\n"


@pytest.mark.parametrize("table, members, message", [
    (TABLE, {"x": "a*", "y": "b*"}, "m.csv: members: .*x 2, y 1"),
    (TABLE.replace("b1", "weight"), {"x": "a*"}, "m.csv: column 'weight' .*draw members of equal weight"),
    (TABLE, {"x": "q*"}, "m.csv: members=.*x=q.*a1"),
    (TABLE.replace("0,2,0,0,1,2", "0,2,0,0,1,"), {"x": "a*"}, "m.csv, line 3: member 2 of 2"),
])  # fmt: skip
def test_tables_of_members_that_do_not_fit(tmp_path, table, members, message):
    (tmp_path / "m.csv").write_text(table)
    with pytest.raises(InputError, match=message):
        cs.read(tmp_path / "m.csv", members=members)


@pytest.mark.parametrize("keys, options, message", [
    ({"members": MEMBERS, "truth": TRUTH, "weights": MEMBERS[..., 0]}, {}, "'weights'.*equal weight"),
    ({"members": PARTLY, "truth": TRUTH}, {}, "'members', run 2, step 2: member 4 of 5"),
    ({"members": MEMBERS, "truth": TRUTH}, {"ensemble": 5}, "ensemble"),
    ({"members": MEMBERS, "truth": TRUTH}, {"members": {"x": "e*"}}, "key 'members'"),
    ({"nees": np.ones((3, 2)), "dof": np.array(2)}, {"ensemble": 5}, "ensemble=5"),
    ({"estimates": X, "covariances": COVARIANCE}, {"truth": "repeats", "split": 2}, "repeats.*split"),
    ({"estimates": X, "covariances": COVARIANCE}, {}, "truth"),
])  # fmt: skip
def test_archives_that_do_not_fit(tmp_path, monkeypatch, keys, options, message):
    monkeypatch.chdir(tmp_path)
    np.savez("a.npz", **keys)
    with pytest.raises(InputError, match=message):
        cs.read("a.npz", **options)


def test_trajectories_are_not_repeats(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "est.tum").write_text("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    with pytest.raises(InputError, match=r"repeats.*est\.tum"):
        cs.read("est.tum", truth="repeats")


# --- gates -------------------------------------------------------------------------------------------


def unit(runs, n=3):
    return np.random.default_rng(31).standard_normal((runs, n)), np.broadcast_to(np.eye(n), (runs, n, n))


def test_gates_take_members_and_plan_for_what_they_show():
    truth, members = drawn(28, 20, 300)
    verdict = assert_consistent(members=members, truth=truth, axes=["x", "y", "z"], false_alarm=RARE)
    same = judged(truth, members, axes=["x", "y", "z"])
    assert (verdict.p_value, verdict.inflation) == (same.p_value, same.inflation)
    with pytest.raises(ConsistencyError, match="overconfident"):
        assert_consistent(members=members, truth=2 * truth)
    with pytest.raises(InsufficientTrials, match=r"--dof 1 --detect 1\.318 --false-alarm 2e-06") as few:
        assert_consistent(members=members[:20], truth=truth[:20], false_alarm=4 * 2e-6)
    assert 1.318 <= min(table.factor(1.5) for table in rank_tables(20, 3)) <= 1.319
    assert few.value.needed >= gate_runs(1, 1.318, 2e-6)
    assert planned_detect(same.record, 1 / 1.5) == pytest.approx(1 / 1.318)
    assert planned_detect(same.record, 1.0001) == 1.001


def test_gates_take_the_mean_and_covariance_of_members_repeats_and_rows():
    truth, members = drawn(29, 10, 400)
    e, P = mean_and_covariance(truth, members)
    assert assert_consistent(e, P, ensemble=10, false_alarm=RARE).consistent
    with pytest.raises(ConsistencyError, match="overconfident"):
        assert_consistent(e, P)
    x, cov = unit(300)
    assert assert_consistent(x, cov, independent=True, false_alarm=RARE).unit == "row"
    assert assert_consistent(x + 7.0, cov, truth="repeats", independent=True, false_alarm=RARE).runs == 299
    wide = stats.norm.ppf(0.975) * np.ones((300, 1, 3))
    assert assert_consistent(x[:, None], deviations=wide, level="95%", gaussian=True, false_alarm=RARE).consistent


def test_gates_take_records_of_files(tmp_path):
    x, cov = unit(300)
    np.savez(tmp_path / "rows.npz", errors=x[None], covariances=cov[None])
    record = cs.read(tmp_path / "rows.npz", independent=True)
    verdict = assert_consistent(record, false_alarm=RARE, name="mine")
    assert (verdict.runs, verdict.filter) == (300, "mine")
    assert assert_consistent(record, false_alarm=RARE).filter == "rows"
    with pytest.raises(ConsistencyError, match="overconfident"):
        assert_consistent(cs.judge(2 * x, cov, independent=True).record)
    with pytest.raises(ValueError, match="covariances: a record"):
        assert_consistent(record, cov)
    with pytest.raises(ValueError, match="skip"):
        assert_consistent(record, skip=1)


@pytest.mark.parametrize(
    "given, message",
    [
        ({"members": np.ones((3, 2, 4, 1))}, "members: need truth="),
        ({"members": np.ones((3, 2, 4, 1)), "truth": np.ones((3, 2, 1)), "errors": np.ones((3, 2, 1))}, "nothing else"),
        ({"truth": "repeats"}, "truth: goes with members"),
        ({"nees": np.ones((3, 2)), "dof": 2, "ensemble": 9}, "ensemble: needs errors"),
        (
            {"nis": np.ones((3, 2)), "nis_dof": 2, "optimal_gain": True, "independent": True},
            "independent: needs errors",
        ),
    ],
)
def test_gates_refuse_what_does_not_go_together(given, message):
    with pytest.raises(ValueError, match=message):
        assert_consistent(**given)
