"""NEES of pose and map together: exact laws, what is found of joint Gaussians that are wrong, and what is kept."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from records import changed
from scipy import stats

import consistency as cs
from consistency.bench.filters import get_filter
from consistency.bench.runs.results_to_records import record_of
from consistency.bench.runs.run_outcome import outcome_of
from consistency.diagnostics import JointNees, Settings, judge, make_record
from consistency.referee.diagnostics.maps import joint_nees, joint_test, last_nees
from consistency.referee.diagnostics.scale import is_tolerated
from consistency.referee.diagnostics.verdict_parts import JOINT, JOINT_DISTRIBUTION
from consistency.referee.geometry import planar_error, planar_map_error

RUNS, LANDMARKS = 30, 12
NUMBER = 3 + 3 * LANDMARKS


def covariance_of(rng):
    """Joint covariance (n, n) of a pose and landmarks that share its error."""
    J = np.vstack([np.eye(3), *(np.eye(3) + 0.3 * rng.standard_normal((3, 3)) for _ in range(LANDMARKS))])
    own = rng.standard_normal((NUMBER, NUMBER)) / np.sqrt(NUMBER)
    return np.asarray(J @ np.diag([0.3, 0.2, 0.1]) @ J.T + 0.05 * (own @ own.T + 0.1 * np.eye(NUMBER)))


def map_of_gaussians(rng, errors, P):
    """Record of runs with joint errors (N, n) that state the covariance P (n, n)."""
    parts = np.stack([joint_nees(e, P) for e in errors])
    error = errors[:, 3:].reshape(len(errors), -1, 3)
    blocks = np.stack([P[i : i + 3, i : i + 3] for i in range(3, NUMBER, 3)])
    joint = JointNees(parts[:, 0], parts[:, 1:].sum(axis=1), np.full(len(errors), NUMBER - 3), parts[:, 1:])
    return changed(
        make_record("map", error, np.broadcast_to(blocks, (*error.shape, 3)).copy(), axes=("x", "y", "z")),
        landmarks=np.arange(10, 10 + LANDMARKS),
        joint=joint,
    )


def verdict_on(rng, spoil="", false_alarm=0.05, runs=RUNS):
    P = covariance_of(rng)
    L = np.linalg.cholesky(P)
    w = rng.standard_normal((runs, NUMBER))
    if spoil == "scale":
        w *= 1.5
    elif spoil == "map given the pose":
        w[:, 3:] *= 1.12
    elif spoil == "pose":
        w[:, :3] *= 2.0
    elif spoil == "hidden":
        w[:, :3] *= 0.3
        w[:, 3:] *= 1.3
    elif spoil == "a landmark":
        w[:, -3:] *= 2.5
    elif spoil == "conservative":
        w *= 0.6
    elif spoil == "bias":
        w[:, 0] += 2.5
    elif spoil == "tails":
        w *= np.where(np.arange(runs) == 3, 9.0, 1.0)[:, None]
    return judge(map_of_gaussians(rng, w @ L.T, P), Settings(false_alarm))


def test_the_parts_are_independent_and_add_to_the_nees():
    rng = np.random.default_rng(0)
    P, e = covariance_of(rng), rng.standard_normal(NUMBER)
    parts = joint_nees(e, P)
    assert parts.sum() == pytest.approx(e @ np.linalg.solve(P, e))
    assert parts[0] == pytest.approx(e[:3] @ np.linalg.solve(P[:3, :3], e[:3]))
    given = e[3:6] - P[3:6, :3] @ np.linalg.solve(P[:3, :3], e[:3])
    left = P[3:6, 3:6] - P[3:6, :3] @ np.linalg.solve(P[:3, :3], P[:3, 3:6])
    assert parts[1] == pytest.approx(given @ np.linalg.solve(left, given))


def test_a_covariance_that_is_not_definite_is_infinite():
    assert np.isinf(joint_nees(np.ones(6), np.diag([1.0, 1, 1, 1, 1, -1e-12]))).all()
    assert np.isinf(joint_nees(np.ones(6), np.full((6, 6), np.nan))).all()


def test_the_question_is_an_exact_chi_square():
    joint = JointNees(np.array([2.0, 4.0, np.nan]), np.array([7.0, 20.0, 1.0]), np.array([6, 12, 9]))
    test = joint_test(joint, Settings())
    assert test.p_values[JOINT] == pytest.approx(2 * min(stats.chi2.cdf(33.0, 24), stats.chi2.sf(33.0, 24)))
    assert (test.score.runs, test.score.dof) == (2, 24)
    u = np.sort([stats.chi2.cdf(9.0, 9), stats.chi2.cdf(24.0, 15)])
    assert test.p_values[JOINT_DISTRIBUTION] == pytest.approx(stats.kstest(u, "uniform").pvalue)
    one_sided = joint_test(joint, Settings(allow="conservative"))
    assert one_sided.p_values[JOINT] == pytest.approx(stats.chi2.sf(33.0, 24))
    assert np.isnan(one_sided.p_values[JOINT_DISTRIBUTION])


def test_right_maps_are_found_at_fault_no_more_often_than_stated():
    """200 maps at 5 %: more than 24 faults come by chance with probability 2e-5."""
    found = sum(bool(verdict_on(np.random.default_rng(seed)).faults) for seed in range(200))
    assert found <= 24


@pytest.mark.parametrize(
    "spoil, status, words",
    [
        ("scale", "overconfident", "pose and map together: covariance too small by x2."),
        ("map given the pose", "overconfident", "mainly the map given the pose"),
        ("a landmark", "overconfident", "landmark 21"),
        ("conservative", "conservative", "too large by x2."),
        ("bias", "biased", "sigma"),
        ("tails", "heavy-tailed", "outlier in run 3, "),
    ],
)
def test_what_is_wrong_is_named(spoil, status, words):
    """At a false-alarm rate of 1e-3; each fault is far beyond it."""
    v = verdict_on(np.random.default_rng(5), spoil, false_alarm=1e-3)
    assert v.status == status, v.reasons
    assert words in v.reasons[0], v.reasons
    assert not any("step" in line for line in v.reasons), v.reasons


def test_landmarks_and_the_joint_error_may_contradict_each_other():
    """At a false-alarm rate of 1e-3: small errors of the pose hide large ones of the map given the pose."""
    v = verdict_on(np.random.default_rng(5), "hidden", false_alarm=1e-3, runs=60)
    assert v.status == "inconsistent", v.reasons
    assert v.inflation < 1.0 < v.joint.both.value


@pytest.mark.parametrize("ratio", [1.1, 1 / 1.1])
def test_a_joint_scale_within_the_tolerance_is_excused(ratio):
    joint = JointNees(np.full(50, 3.0 * ratio), np.full(50, 197.0 * ratio), np.full(50, 197))
    for tolerance, excused in ((1.2, True), (1.05, False), (None, False)):
        settings = Settings(tolerance=tolerance)
        test = joint_test(joint, settings)
        assert test.p_values[JOINT] < 1e-10
        assert is_tolerated(test.nees, test.score.dof, settings) == excused
        nees = np.random.default_rng(8).chisquare(3, (50, 1))
        v = judge(changed(make_record("map", nees=nees, dof=3), joint=joint, landmarks=np.arange(1)), settings)
        assert [(a.found, a.tolerated) for a in v.answers if a.question == JOINT] == [(True, excused)]


def test_the_pose_alone_shows_in_its_part():
    v = verdict_on(np.random.default_rng(6), "pose", runs=60)
    assert not v.joint.pose.holds(1.0)
    assert v.joint.map.holds(1.0)


def test_runs_without_a_definite_joint_covariance_are_named():
    rng = np.random.default_rng(7)
    P = covariance_of(rng)
    evidence = map_of_gaussians(rng, rng.standard_normal((RUNS, NUMBER)) @ np.linalg.cholesky(P).T, P)
    broken = np.where(np.arange(RUNS) == 4, np.inf, evidence.map.joint.map)
    numbers = np.arange(100, 100 + RUNS)
    v = judge(changed(evidence, joint=replace(evidence.map.joint, map=broken), numbers=numbers), Settings(1e-6))
    assert v.status == "failed"
    assert v.joint.not_definite == (104,)
    assert "not positive definite in 1 of 30 runs, first run 104" in v.reasons[0]


# --- errors of pose and points -------------------------------------------------------------------------


@pytest.mark.parametrize("convention", ["so2", "left", "right", "vector"])
def test_the_joint_error_is_that_of_its_covariance(convention):
    """To first order the error is T times the additive one, and the covariance is T P T'."""
    rng = np.random.default_rng(1)
    pose, points = np.array([3.0, -2.0, 0.7]), rng.uniform(-5, 5, (4, 3))
    n = 3 + points.size
    root = rng.standard_normal((n, n))
    zero, P = planar_map_error(pose, points, pose, points, root @ root.T, convention)
    assert np.abs(zero).max() < 1e-12
    T, step = np.empty((n, n)), 1e-6
    for j in range(n):
        d = np.zeros(n)
        d[j] = step
        moved = ((pose + h * d[:3], points + h * d[3:].reshape(-1, 3)) for h in (1, -1))
        ends = [planar_map_error(*true, pose, points, np.eye(n), convention)[0] for true in moved]
        T[:, j] = (ends[0] - ends[1]) / (2 * step)
    assert_allclose(P, T @ root @ root.T @ T.T, rtol=1e-6, atol=1e-6)
    true = pose + np.array([0.1, 0.2, 0.3])
    error, _ = planar_map_error(true, points, pose, points, np.eye(n), convention)
    assert_allclose(error[:3], planar_error(true, pose, convention))


def test_a_turn_of_pose_and_map_leaves_the_right_invariant_error_of_points():
    points, pose, a = np.array([[4.0, 1.0, 0.5], [-2.0, 3.0, 0.1]]), np.array([1.0, 2.0, 0.3]), 0.4
    R = np.array([[np.cos(a), -np.sin(a), 0.0], [np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]])
    true = np.append((R[:2, :2] @ pose[:2]), pose[2] + a)
    error, _ = planar_map_error(true, points @ R.T, pose, points, np.eye(9), "right")
    assert_allclose(error, [0, 0, a, *np.zeros(6)], atol=1e-12)


# --- what is kept ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def results():
    scenario = cs.load_scenario("herath2007-stereo").variant("short", truth__steps=12)
    return cs.run_trials(scenario, ["ekf-uvd", "ri-ekf-uvd"], runs=6, seed=3, jobs=1)


def _evidence(results, name):
    record = record_of(results, name)
    evidence = record.map.read().record(last_nees(record))
    assert evidence is not None
    return evidence


@pytest.mark.parametrize("name", ["ekf-uvd", "ri-ekf-uvd"])
def test_the_table_has_the_nees_of_the_joint_error(results, name):
    scenario = results.scenario
    trial = cs.simulate(scenario, run=2, seed=3)
    estimates = get_filter(name).run(trial, scenario.belief)
    P, points, ids = estimates.map.joint, estimates.map.mean, estimates.map.landmarks
    assert_allclose(P[:3, :3], estimates.covariance[-1], rtol=1e-12)
    assert_allclose(P[3:6, 3:6], estimates.map.covariance[0], rtol=1e-12)
    error, own = planar_map_error(trial.truth[-1], trial.landmarks[ids], estimates.pose[-1], points, P, estimates.error)
    rows = results.map[(results.map["filter"] == name) & (results.map["run"] == 2)]
    at = results.estimates[(results.estimates["filter"] == name) & (results.estimates["run"] == 2)].iloc[-1]
    pose = at["nees"] if name == "ekf-uvd" else at["own_nees"]
    assert rows["joint_nees"].sum() + pose == pytest.approx(error @ np.linalg.solve(own, error), rel=1e-8)
    joint = _evidence(results, name).map.joint
    assert joint.pose[2] + joint.map[2] == pytest.approx(rows["joint_nees"].sum() + pose)
    evidence = _evidence(results, name)
    for j, label in enumerate(evidence.map.landmarks):
        mean = rows[rows["landmark"] == label][["x", "y", "z"]].to_numpy()[0]
        assert_allclose(evidence.errors.error[2, j], trial.landmarks[label] - mean)


def test_landmarks_in_a_plane_have_two_dimensions_in_the_joint_error():
    """By differences of the NEES of the first variables; the height of each landmark is none."""
    scenario = cs.load_scenario("esde-xy").variant("short", truth__steps=20)
    trial = cs.simulate(scenario, run=0)
    estimates = get_filter("ekf-xy").run(trial, scenario.belief)
    m, (outcome,) = estimates.map, outcome_of(trial, [estimates]).maps.values()
    assert m.joint is not None
    error, P = planar_map_error(
        trial.truth[-1], trial.landmarks[m.landmarks], estimates.pose[-1], m.mean, m.joint, estimates.error
    )
    flat = np.append([0, 1, 2], [3 + 3 * k + axis for k in range(len(m.landmarks)) for axis in (0, 1)])
    error, P = error[flat], P[np.ix_(flat, flat)]
    nees = [error[:n] @ np.linalg.solve(P[:n, :n], error[:n]) for n in range(3, len(error) + 1, 2)]
    assert_allclose(outcome["joint_nees"], np.diff(nees), rtol=1e-6)


def test_results_without_joint_nees_are_judged_and_say_so(results, tmp_path):
    old = replace(results, map=results.map.drop(columns="joint_nees"))
    old.write(tmp_path / "old")
    for kept in (old, cs.read_results(tmp_path / "old")):
        assert not kept.has_joint
        with_joint, without = (cs.analyse(r)["ekf-uvd"] for r in (results, kept))
        assert (with_joint.status, with_joint.reasons) == (without.status, without.reasons)
        assert without.map.verdict.joint is None
        assert "the joint covariance of pose and map was not kept" in " ".join(without.map.verdict.reasons)
        assert JOINT not in {a.question for a in without.map.verdict.answers}
    assert JOINT in {a.question for a in with_joint.map.verdict.answers}


def test_a_map_that_is_not_definite_survives_a_file(results, tmp_path):
    broken = results.map.copy()
    broken.loc[(broken["filter"] == "ekf-uvd") & (broken["run"] == 1), "joint_nees"] = np.inf
    replace(results, map=broken).write(tmp_path / "out")
    v = cs.analyse(cs.read_results(tmp_path / "out"))["ekf-uvd"].map.verdict
    assert v.joint.not_definite == (1,)
    assert not v.consistent


def test_landmarks_that_only_some_runs_saw_count_in_the_joint_nees_alone(results):
    label = results.map["landmark"].iloc[0]
    rare = replace(results, map=results.map[(results.map["landmark"] != label) | (results.map["run"] == 0)])
    whole, part = (_evidence(r, "ekf-uvd") for r in (results, rare))
    assert label in whole.map.landmarks
    assert label not in part.map.landmarks
    assert part.map.joint.dof[0] == part.map.joint.dof[1] + 3


def test_the_pose_beside_a_map_is_that_of_its_own_run(results):
    later = replace(results, map=results.map[results.map["run"] > 1])
    whole, part = (_evidence(r, "ekf-uvd") for r in (results, later))
    assert_array_equal(part.run_numbers, [2, 3, 4, 5])
    assert_array_equal(part.map.joint.pose, whole.map.joint.pose[2:])
