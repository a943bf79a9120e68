"""Files of other estimators: errors against independent maths, verdicts of filterpy's filter, and every refusal."""

import json
import runpy
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from command import consistency
from document_inputs import planar
from documents import blocks
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from recorded import read_recordings
from scipy import stats
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

import consistency as cs
from consistency.diagnostics import Settings
from consistency.referee.diagnostics.nees import nees
from consistency.referee.errors import InputError
from consistency.referee.geometry import planar_error, se2_log, se3_log, spatial_error
from consistency.referee.readers.truth_matching import associate, common_times
from consistency.referee.verdicts.judge_sources import judge_all

ROOT = Path(__file__).parents[3]
POSE_COLUMNS = ["P_xx", "P_xy", "P_xh", "P_yy", "P_yh", "P_hh"]
coordinate = st.floats(-50, 50).map(lambda value: round(value, 9))  # logm itself fails on subnormal numbers
angle = st.floats(-3.1, 3.1).map(lambda value: round(value, 9))
few = settings(max_examples=25)  # logm is slow


# --- the conventions, against matrix logarithms --------------------------------------------------


def hat(twist):
    """Matrix of the Lie algebra: (x, y, heading) -> (3, 3), (x, y, z, rotation vector) -> (4, 4)."""
    n = 2 if len(twist) == 3 else 3
    out = np.zeros((n + 1, n + 1))
    out[:n, n] = twist[:n]
    if n == 2:
        out[:2, :2] = [[0, -twist[2]], [twist[2], 0]]
    else:
        a, b, c = twist[3:]
        out[:3, :3] = [[0, -c, b], [c, 0, -a], [-b, a, 0]]
    return out


def vee(matrix):
    if len(matrix) == 3:
        return np.array([matrix[0, 2], matrix[1, 2], matrix[1, 0]])
    return np.array([*matrix[:3, 3], matrix[2, 1], matrix[0, 2], matrix[1, 0]])


def matrix(pose):
    """Homogeneous matrix of (x, y, heading) or of (x, y, z, qx, qy, qz, qw)."""
    if len(pose) == 3:
        c, s = np.cos(pose[2]), np.sin(pose[2])
        return np.array([[c, -s, pose[0]], [s, c, pose[1]], [0, 0, 1]])
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = Rotation.from_quat(pose[3:]).as_matrix(), pose[:3]
    return out


def spatial(position, turn):
    return np.concatenate([position, Rotation.from_rotvec(turn).as_quat()])


vector3 = st.tuples(coordinate, coordinate, coordinate).map(np.array)
turn3 = st.tuples(*[st.floats(-1.7, 1.7)] * 3).map(lambda values: np.round(values, 9))


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-8, 1e-5, 1e-3, 0.00999, 0.01001, 0.1, 1.0, 3.0, 3.14159, np.pi - 1e-9])
def test_log_undoes_the_exponential_at_every_angle(size):
    """Also across the switch to the series, and near pi, where eq. 146 as printed divides zero by zero."""
    twist = np.array([3.0, -4.0, 5.0, *(size * np.array([2.0, -1.0, 2.0]) / 3.0)])
    exponential = expm(hat(twist))
    pose = np.concatenate([exponential[:3, 3], Rotation.from_matrix(exponential[:3, :3]).as_quat()])
    assert_allclose(se3_log(pose), twist, rtol=1e-6, atol=1e-12)
    planar = np.array([3.0, -4.0, size])
    T = expm(hat(planar))
    assert_allclose(se2_log(np.array([T[0, 2], T[1, 2], size])), planar, rtol=1e-9, atol=1e-12)


@few
@given(true=vector3, true_turn=turn3, estimate=vector3, turn=turn3)
def test_spatial_errors_by_matrices(true, true_turn, estimate, turn):
    one, two = spatial(true, true_turn), spatial(estimate, turn)
    X, Y = matrix(one), matrix(two)
    if np.linalg.norm(se3_log(spatial(np.zeros(3), Rotation.from_matrix(X[:3, :3] @ Y[:3, :3].T).as_rotvec()))) > 3.1:
        return  # at pi the logarithm has two branches
    left, right = np.linalg.inv(Y) @ X, X @ np.linalg.inv(Y)
    assert_allclose(spatial_error(one, two, "left"), vee(np.real(logm(left))), atol=1e-7)
    assert_allclose(spatial_error(one, two, "right"), vee(np.real(logm(right))), atol=1e-7)
    for convention, turned in (("so3", right), ("so3-body", left)):
        error = spatial_error(one, two, convention)
        assert_allclose(error[:3], true - estimate)
        assert_allclose(error[3:], vee(np.real(logm(turned)))[3:], atol=1e-7)


@few
@given(true=st.tuples(coordinate, coordinate, angle), estimate=st.tuples(coordinate, coordinate, angle))
def test_planar_errors_by_matrices(true, estimate):
    one, two = np.array(true), np.array(estimate)
    X, Y = matrix(one), matrix(two)
    if abs(planar_error(one, two, "so2")[2]) > 3.1:
        return
    assert_allclose(planar_error(one, two, "left"), vee(np.real(logm(np.linalg.inv(Y) @ X))), atol=1e-8)
    assert_allclose(planar_error(one, two, "right"), vee(np.real(logm(X @ np.linalg.inv(Y)))), atol=1e-8)


def test_headings_are_wrapped_except_in_a_vector():
    true, estimate = np.array([0.0, 0.0, np.pi - 0.1]), np.array([0.0, 0.0, 0.1 - np.pi])
    assert_allclose(planar_error(true, estimate, "so2")[2], -0.2)
    assert_allclose(planar_error(true, estimate, "vector")[2], 2 * np.pi - 0.2)


# --- trajectories whose errors have the stated covariance ------------------------------------------

DRAW = {
    # estimate T (4, 4), error xi (6,), its exponential (4, 4) -> true position and rotation
    "left": lambda T, xi, E: ((T @ E)[:3, 3], (T @ E)[:3, :3]),
    "right": lambda T, xi, E: ((E @ T)[:3, 3], (E @ T)[:3, :3]),
    "so3": lambda T, xi, E: (T[:3, 3] + xi[:3], E[:3, :3] @ T[:3, :3]),
    "so3-body": lambda T, xi, E: (T[:3, 3] + xi[:3], T[:3, :3] @ E[:3, :3]),
}
RUNS, STEPS = 5, 80


def covariance6(rng):
    """One with every correlation, and very different along its axes."""
    sigma = np.array([0.1, 0.5, 0.02, 0.02, 0.005, 0.1])
    root = np.tril(rng.normal(0, 0.4, (6, 6)), -1) + np.eye(6)
    C = root @ root.T
    d = np.sqrt(np.diag(C))
    return sigma[:, None] * (C / np.outer(d, d)) * sigma


def write_trajectories(at, convention, order="translation-rotation", triangle=False):
    """Folders est, truth, P with a file for each run."""
    rng = np.random.default_rng(20180)
    for folder in ("est", "truth", "P"):
        (at / folder).mkdir()
    for run in range(RUNS):
        estimates, truths, matrices = [], [], []
        for step in range(STEPS):
            t = 1.6e9 + 0.05 * step
            P = covariance6(rng)
            xi = np.linalg.cholesky(P) @ rng.normal(size=6)
            estimate = spatial(rng.uniform(-20, 20, 3), rng.uniform(-1.5, 1.5, 3))
            position, turn = DRAW[convention](matrix(estimate), xi, expm(hat(xi)))
            if order == "rotation-translation":
                swap = [3, 4, 5, 0, 1, 2]
                P = P[np.ix_(swap, swap)]
            estimates.append([t, *estimate])
            truths.append([t, *position, *Rotation.from_matrix(turn).as_quat()])
            matrices.append([t, *(P[np.triu_indices(6)] if triangle else P.ravel())])
        for folder, rows in (("est", estimates), ("truth", truths), ("P", matrices)):
            np.savetxt(at / folder / f"run{run}.txt", rows, fmt="%.17g", header="made")


def mean_nees(at, convention, order=None):
    [recording] = read_recordings(at / "est", at / "truth", at / "P", convention, covariance_order=order)
    assert recording.errors.error.shape == (RUNS, STEPS, 6)
    return float(nees(recording.errors.error, recording.errors.covariance).mean())


BAND = stats.chi2.ppf([0.5e-4, 1 - 0.5e-4], 6 * RUNS * STEPS) / (RUNS * STEPS)


@pytest.mark.parametrize("convention", DRAW)
def test_nees_of_a_trajectory_in_each_convention(convention, tmp_path):
    """False-alarm rate 1e-4 for each convention; declared as any other it is far outside (negative control)."""
    write_trajectories(tmp_path, convention)
    assert BAND[0] < mean_nees(tmp_path, convention) < BAND[1]
    for wrong in set(DRAW) - {convention}:
        assert mean_nees(tmp_path, wrong) > 2 * BAND[1]


def test_order_of_the_covariance_and_its_triangle(tmp_path):
    """False-alarm rate 1e-4. The default convention is so3."""
    write_trajectories(tmp_path, "so3", "rotation-translation", triangle=True)
    assert BAND[0] < mean_nees(tmp_path, None, "rotation-translation") < BAND[1]
    assert not BAND[0] < mean_nees(tmp_path, None) < BAND[1]


def test_layouts_of_one_line(tmp_path):
    """Covariance behind the pose: 44 or 29 columns; 20 are two recordings that equal the blocks."""
    write_trajectories(tmp_path, "so3-body")
    est, P = (np.loadtxt(tmp_path / folder / "run0.txt") for folder in ("est", "P"))
    truth = tmp_path / "truth/run0.txt"
    [whole] = read_recordings(tmp_path / "est/run0.txt", truth, tmp_path / "P/run0.txt", "so3-body")
    full = P[:, 1:].reshape(-1, 6, 6)
    i, j = np.triu_indices(3)
    layouts = {
        "44.txt": np.hstack([est, P[:, 1:]]),
        "29.txt": np.hstack([est, full[(slice(None), *np.triu_indices(6))]]),
        "20.txt": np.hstack([est, full[:, 3:, 3:][:, i, j], full[:, :3, :3][:, i, j]]),
    }
    for name, rows in layouts.items():
        np.savetxt(tmp_path / name, rows, fmt="%.17g")
    for name in ("44.txt", "29.txt"):
        [one] = read_recordings(tmp_path / name, truth, None, "so3-body")
        assert_allclose(one.errors.error, whole.errors.error)
        assert_allclose(one.errors.covariance, whole.errors.covariance, rtol=1e-12)
    position, rotation = read_recordings(tmp_path / "20.txt", truth)
    assert (position.errors.axes, rotation.errors.axes) == (("x", "y", "z"), ("roll", "pitch", "yaw"))
    assert (position.name, rotation.name) == ("20 position", "20 rotation")
    assert_allclose(position.errors.error, whole.errors.error[..., :3])
    assert_allclose(rotation.errors.error, whole.errors.error[..., 3:])
    assert_allclose(rotation.errors.covariance, whole.errors.covariance[..., 3:, 3:], rtol=1e-12)


def test_runs_of_different_lengths_and_gaps(tmp_path):
    write_trajectories(tmp_path, "so3")
    shorten(tmp_path / "est/run1.txt", slice(0, 50))
    shorten(tmp_path / "truth/run2.txt", slice(20, None))
    [r] = read_recordings(tmp_path / "est", tmp_path / "truth", tmp_path / "P")
    there = np.isfinite(r.errors.covariance[:, :, 0, 0])
    assert there[1].tolist() == [True] * 50 + [False] * 30
    assert there[2].tolist() == [False] * 20 + [True] * 60  # a common clock keeps the steps in place
    assert there[[0, *range(3, RUNS)]].all()
    assert any("20 of 370 estimates have no truth" in note for note in r.origin.notes)
    assert any("1 run of 5 (1) end before step 80" in note for note in r.origin.notes)
    assert r.failures == ()


def shorten(path, keep):
    np.savetxt(path, np.loadtxt(path)[keep], fmt="%.17g")


def test_clocks_of_different_days_are_counted_from_the_start():
    columns, t = common_times([np.array([0.0, 0.1, 0.2]), np.array([50.0, 50.1])])
    assert [column.tolist() for column in columns] == [[0, 1, 2], [0, 1]]
    assert np.isnan(t).all()
    columns, t = common_times([np.array([0.1, 0.2]), np.array([0.0, 0.1, 0.2])])
    assert [column.tolist() for column in columns] == [[1, 2], [0, 1, 2]]
    assert t.tolist() == [0.0, 0.1, 0.2]


def test_a_failing_trajectory_and_warnings(tmp_path):
    write_trajectories(tmp_path, "so3")
    path = tmp_path / "est/run3.txt"
    rows = np.loadtxt(path)
    rows[20:, 1:] = np.nan
    np.savetxt(path, rows, fmt="%.17g")
    for path in (tmp_path / "truth").iterdir():  # w first, and a truth that jumps about between its samples
        rows = np.loadtxt(path)
        rows[:, 0] -= 0.02
        np.savetxt(path, rows[:, [0, 1, 2, 3, 7, 4, 5, 6]], fmt="%.17g")
    [r] = read_recordings(tmp_path / "est", tmp_path / "truth", tmp_path / "P")
    assert [(f.run, f.step) for f in r.failures] == [(3, 21)]
    assert r.failures[0].reason.startswith("estimate is not finite (")
    assert r.failures[0].reason.endswith("run3.txt, line 21)")
    assert np.isnan(r.errors.error[3, 20:]).all()
    assert any("degrees in the median" in note for note in r.origin.notes)
    assert any("give a truth of a higher rate" in note for note in r.origin.notes)


@pytest.mark.parametrize(
    "spatial_kind, planar_kind", [("so3", "so2"), ("so3-body", "so2"), ("left", "left"), ("right", "right")]
)
def test_a_planar_robot_in_messages_of_six(spatial_kind, planar_kind, tmp_path):
    """Zeros for z, roll and pitch: with three axes the errors are those of the planar poses."""
    rng = np.random.default_rng()
    t, n = 0.1 * np.arange(40), 40
    true = np.column_stack([rng.uniform(-9, 9, (n, 2)), rng.uniform(-3, 3, n)])
    own = true + rng.normal(0, [0.3, 0.2, 0.1], (n, 3))
    A = rng.normal(size=(n, 3, 3))
    P3 = A @ A.transpose(0, 2, 1) + 0.1 * np.eye(3)
    P = np.zeros((n, 6, 6))
    P[np.ix_(range(n), [0, 1, 5], [0, 1, 5])] = P3
    for name, pose in (("est", own), ("truth", true)):
        half = 0.5 * pose[:, 2]
        zero = np.zeros((n, 1))
        rows = np.column_stack([t, pose[:, :2], zero, zero, zero, np.sin(half), np.cos(half)])
        np.savetxt(tmp_path / f"{name}.txt", rows, fmt="%.17g")
    np.savetxt(tmp_path / "P.txt", np.column_stack([t, P.reshape(n, 36)]), fmt="%.17g")
    files = tmp_path / "est.txt", tmp_path / "truth.txt", tmp_path / "P.txt"
    [r] = read_recordings(*files, spatial_kind, axes=["x", "y", "yaw"])
    assert r.errors.axes == ("x", "y", "yaw")
    assert_allclose(r.errors.error[0], planar_error(true, own, planar_kind), atol=1e-12)
    assert_allclose(r.errors.covariance[0], P3, rtol=1e-12)
    [in_space] = read_recordings(*files, spatial_kind)  # what never changes is left out
    assert in_space.errors.axes == ("x", "y", "yaw")
    assert_allclose(in_space.errors.error, r.errors.error)
    assert any("--axes x,y,yaw" in note for note in in_space.origin.notes)
    with pytest.raises(InputError, match=r"--axes x,heading: 'heading' is not one of x, y, z, roll, pitch, yaw"):
        read_recordings(*files, axes=["x", "heading"])


# --- association ---------------------------------------------------------------------------------


@given(
    st.lists(st.integers(0, 10**6).map(lambda value: value / 1e5), min_size=1, max_size=20, unique=True),
    st.integers(0, 10**6),
)
def test_association_by_brute_force(reference, seed):
    rng = np.random.default_rng(seed)
    ref, times = np.sort(reference), np.sort(rng.uniform(-1, 11, 15))
    own, match = associate(times, ref, 0.5)
    assert len(set(match)) == len(match)
    assert (np.diff(own) > 0).all()
    assert (np.diff(match) > 0).all()
    distance = np.abs(times[:, None] - ref)
    nearest = distance.argmin(axis=1)
    for k in range(len(ref)):
        wants = [i for i in range(len(times)) if distance[i, k] == distance[i].min() and nearest[i] == k]
        wants = [i for i in wants if distance[i, k] <= 0.5]
        assert [int(i) for i, j in zip(own, match, strict=True) if j == k] == (
            [min(wants, key=lambda i: distance[i, k])] if wants else []
        )


def test_the_tolerance_of_times_is_inside():
    """Also of seconds since 1970, which a double holds to a quarter of a microsecond."""
    for start in (0.0, 1.7e9):
        own, match = associate(start + np.array([0.5, 2.6]), start + np.array([0.0, 2.0]), 0.5)
        assert (own.tolist(), match.tolist()) == ([0], [0])
    own, _ = associate(np.array([1.7e9 + 0.4]), np.array([1.7e9 + 0.3]), 0.1)  # apart by 0.1 and a rounding error
    assert own.tolist() == [0]


# --- tables: poses ---------------------------------------------------------------------------------


def poses(runs=3, steps=5):
    """Estimates and truth of a pose with a known, full covariance."""
    rng = np.random.default_rng(3)
    P = np.array([[0.04, 0.01, 0.002], [0.01, 0.09, -0.003], [0.002, -0.003, 0.01]])
    run, step = (a.ravel() for a in np.meshgrid(np.arange(runs), np.arange(1, steps + 1), indexing="ij"))
    true = pd.DataFrame({"run": run, "step": step, "t": 0.1 * step})
    true[["x", "y", "heading"]] = rng.normal(0, 3, (len(true), 3))
    est = true.copy()
    est[["x", "y", "heading"]] += rng.multivariate_normal(np.zeros(3), P, len(true))
    est[POSE_COLUMNS] = P[np.triu_indices(3)]
    return est, true


def write(at, edit=None, edit_truth=None):
    for name, table, change in zip(("est.csv", "truth.csv"), poses(), (edit, edit_truth), strict=True):
        changed = change(table) if change else None
        (table if changed is None else changed).to_csv(at / name, index=False)
    return at / "est.csv", at / "truth.csv"


def one(estimates, truth, **options):
    [recording] = read_recordings(estimates, truth, **options)
    return recording


def test_a_table_is_read_back_to_the_last_digit(tmp_path):
    est, true = poses()
    r = one(*write(tmp_path))
    expected = true[["x", "y", "heading"]].to_numpy() - est[["x", "y", "heading"]].to_numpy()
    assert_allclose(r.errors.error, expected.reshape(3, 5, 3), rtol=0, atol=1e-15)  # wrapping rounds once more
    assert (r.name, r.errors.axes, r.errors.convention, r.runs.numbers.tolist()) == (
        "est",
        ("x", "y", "heading"),
        "so2",
        [0, 1, 2],
    )
    assert_allclose(r.runs.t, [0.1, 0.2, 0.3, 0.4, 0.5])
    assert r.errors.covariance[2, 4].tolist() == [[0.04, 0.01, 0.002], [0.01, 0.09, -0.003], [0.002, -0.003, 0.01]]
    for suffix in ("parquet", "csv"):  # Parquet, shuffled rows, and semicolons: the same
        shuffled = est.sample(frac=1, random_state=1)
        if suffix == "csv":
            shuffled.to_csv(tmp_path / "again.csv", index=False, sep=";")
        else:
            shuffled.to_parquet(tmp_path / "again.parquet")
        again = one(tmp_path / f"again.{suffix}", tmp_path / "truth.csv")
        assert_array_equal(again.errors.error, r.errors.error)
        assert_array_equal(again.errors.covariance, r.errors.covariance)


def test_without_run_and_step(tmp_path):
    """One run, matched by time; a truth without runs serves all."""
    est, truth = write(tmp_path, lambda e: e[e["run"] == 0].drop(columns=["run", "step"]), lambda t: t[t["run"] == 0])
    alone = one(est, truth)
    assert alone.runs.numbers.tolist() == [0]
    assert alone.errors.error.shape == (1, 5, 3)
    shared = write(tmp_path, None, lambda t: t[t["run"] == 1].drop(columns=["run", "step"]))
    several = one(*shared)
    assert several.errors.error.shape == (3, 5, 3)
    assert several.errors.convention == "so2"


def test_filters_are_recordings(tmp_path):
    est, truth = write(tmp_path, lambda e: pd.concat([e.assign(filter="a"), e.assign(filter="b", x=e["x"] + 9)]))
    assert [r.name for r in read_recordings(est, truth)] == ["a", "b"]
    assert list(judge_all(read_recordings(est, truth), ["b"])) == ["b"]
    with pytest.raises(InputError, match="--filter c: is not in these files; there are: a, b"):
        judge_all(read_recordings(est, truth), ["c"])


def set_cell(row, column, value):
    def edit(table):
        table[column] = table[column].astype(float)
        table.loc[row, column] = value

    return edit


@pytest.mark.parametrize(
    "row, column, value, reason",
    [
        (7, "x", np.nan, "estimate is not finite"),
        (7, "heading", np.inf, "estimate is not finite"),
        (7, "P_xh", np.nan, "covariance is not finite"),
        (7, "P_yy", -1.0, "covariance is not positive definite"),
        (7, "P_xy", 0.5, "covariance is not positive definite"),
        (7, "P_xx", 0.0, "covariance is not positive definite"),
        (5, "P_xx", -1.0, "covariance is not positive definite"),
    ],
)
def test_a_broken_row_is_a_failed_run(row, column, value, reason, tmp_path):
    est, truth = write(tmp_path, set_cell(row, column, value))
    r = one(est, truth)
    step = row - 5
    assert [(f.filter, f.run, f.step) for f in r.failures] == [("est", 1, step + 1)]
    assert r.failures[0].reason == f"{reason} ({est}, line {row + 2})"
    assert np.isnan(r.errors.error[1, step:]).all()
    assert np.isnan(r.errors.covariance[1, step:]).all()
    assert np.isfinite(r.errors.error[1, :step]).all()
    assert np.isfinite(r.errors.error[[0, 2]]).all()
    verdict = judge_all([r])["est"]
    assert not verdict.consistent
    assert verdict.statistics["failures"] == [[1, step + 1, r.failures[0].reason]]


def test_a_start_known_exactly_is_left_out(tmp_path):
    def singular(table):
        table.loc[table["step"] == 1, POSE_COLUMNS] = 0.0
        table.loc[table["step"] == 2, POSE_COLUMNS] = [1.0, 1.0, 0.0, 1.0, 0.0, 1.0]  # rank 2

    r = one(*write(tmp_path, singular))
    assert r.failures == ()
    assert np.isnan(r.errors.nees[:, :2]).all()
    assert np.isnan(r.errors.covariance[:, :2]).all()
    assert_allclose(r.errors.nees[:, 2:], nees(r.errors.error[:, 2:], r.errors.covariance[:, 2:]))
    assert np.isfinite(r.errors.error).all()
    assert any("6 estimates before the covariance has full rank" in note for note in r.origin.notes)
    assert judge_all([r])["est"].statistics["left_out_steps"] == [1, 2]


def test_step_0_is_the_start_only_where_nothing_is_uncertain(tmp_path):
    def shift(table):
        table["step"] -= 1

    kept = one(*write(tmp_path, shift, shift))
    assert kept.errors.error.shape == (3, 5, 3)
    assert any("which has 0 to 4" in note for note in kept.origin.notes)

    def exact(table):
        shift(table)
        table.loc[table["step"] == 0, POSE_COLUMNS] = 0.0

    start = one(*write(tmp_path, exact, shift))
    assert start.errors.error.shape == (3, 4, 3)
    assert_array_equal(start.errors.error, kept.errors.error[:, 1:])


def test_short_and_missing_runs_are_told(tmp_path):
    r = one(*write(tmp_path, lambda e: e[(e["run"] != 1) & ((e["run"] != 2) | (e["step"] < 4))]))
    assert r.runs.numbers.tolist() == [0, 2]
    assert np.isnan(r.errors.error[1, 3:]).all()
    assert any("no estimates of 1 run of the truth (1)" in note for note in r.origin.notes)
    assert any("1 run of 2 (2) end before step 5" in note for note in r.origin.notes)


def test_nis_alone(tmp_path):
    rng = np.random.default_rng(4)
    table = pd.DataFrame({"run": np.repeat(range(20), 50), "step": np.tile(np.arange(1, 51), 20)})
    table["nis"], table["nis_dof"] = 4 * rng.chisquare(2, 1000), 2
    table.loc[3, ["nis", "nis_dof"]] = np.nan
    table.to_csv(tmp_path / "nis.csv", index=False)
    r = one(tmp_path / "nis.csv", None)
    assert (r.errors.error, r.errors.covariance, r.errors.nees, r.errors.dof) == (None, None, None, 0)
    undeclared = judge_all([r])["nis"]
    assert (undeclared.status, undeclared.faults) == ("undecided", ())
    assert "declares an optimal gain" in undeclared.reasons[0]
    assert "reported and not judged" in undeclared.reasons[1]
    assert judge_all([r], optimal_gain=True)["nis"].status == "overconfident"


def test_our_own_files_get_our_own_verdict(uvd, tmp_path):
    results = cs.run_trials(uvd, ["ekf-uvd"], runs=3, jobs=1)
    results.write(tmp_path / "out")
    r = one(tmp_path / "out/estimates.parquet", tmp_path / "out/truth.parquet")
    ours, theirs = cs.analyse(results)["ekf-uvd"], judge_all([r])["ekf-uvd"]
    assert (theirs.status, theirs.statistics["left_out_steps"]) == (ours.status, ours.statistics["left_out_steps"])
    assert_allclose(theirs.statistics["anees"], ours.statistics["anees"], rtol=1e-9)


# --- archives --------------------------------------------------------------------------------------


def archive(at, **arrays):
    np.savez(at / "a.npz", **arrays)
    return at / "a.npz"


def gaussian(scale=1.0):
    rng = np.random.default_rng(5)
    P = np.array([[0.04, 0.01], [0.01, 0.09]])
    errors = rng.multivariate_normal([0, 0], scale * P, (40, 30))
    return {"errors": errors, "covariances": np.broadcast_to(P, (40, 30, 2, 2))}


def test_three_kinds_of_archives_agree(tmp_path):
    """Consistent errors: false-alarm rate 0.05 of the verdict, so it is asked at 1 - 1e-4."""
    arrays = gaussian()
    by_error = one(archive(tmp_path, **arrays, axes=["px", "py"]), None)
    assert by_error.errors.axes == ("px", "py")
    truth = np.random.default_rng(6).normal(size=(40, 30, 2))
    estimates = {"estimates": truth - arrays["errors"], "truth": truth, "covariances": arrays["covariances"]}
    by_truth = one(archive(tmp_path, **estimates), None)
    assert_allclose(by_truth.errors.error, by_error.errors.error, atol=1e-12)
    values = nees(error=arrays["errors"], covariance=arrays["covariances"])
    by_nees = one(archive(tmp_path, nees=values, dof=2), None)
    assert by_nees.errors.error is None
    for r in (by_error, by_truth, by_nees):
        verdict = judge_all([r], settings=Settings(false_alarm=1e-4))["a"]
        assert verdict.status == "consistent"
        assert_allclose(verdict.statistics["mean_anees"], values.mean())
    for bad in (gaussian(2.0), {"nees": 2 * values, "dof": 2}):
        assert judge_all([one(archive(tmp_path, **bad), None)])["a"].status == "overconfident"


def test_lengths_failures_and_starts_of_archives(tmp_path):
    arrays = gaussian()
    errors = arrays["errors"].copy()
    errors[3, 20:] = np.nan
    errors[5, 10:] = np.nan
    lengths = np.full(40, 30)
    lengths[5] = 10
    r = one(archive(tmp_path, errors=errors, covariances=arrays["covariances"], lengths=lengths), None)
    assert [(f.run, f.step) for f in r.failures] == [(3, 21)]
    values = np.full((2, 5), 2.0)
    values[0, 0] = values[1, 3] = np.nan
    r = one(archive(tmp_path, nees=values, dof=2), None)
    assert [(f.run, f.step) for f in r.failures] == [(1, 4)]
    assert np.isnan(r.errors.nees[1]).tolist() == [False, False, False, True, True]


def test_poses_in_an_archive_take_a_convention(tmp_path):
    est, true = poses()
    estimates, truth = (table[["x", "y", "heading"]].to_numpy().reshape(3, 5, 3) for table in (est, true))
    path = archive(tmp_path, estimates=estimates, truth=truth, covariances=np.tile(np.eye(3), (3, 5, 1, 1)))
    assert_allclose(one(path, None, error="left").errors.error, planar_error(truth, estimates, "left"))
    assert_allclose(one(path, None).errors.error, truth - estimates)


# --- the commands of the manual ----------------------------------------------------------------------


FILTERPY = (ROOT / "docs/examples/filterpy_csv.py").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "change, status",
    [
        (None, "consistent"),
        (("believed = 1.0", "believed = 0.5"), "overconfident"),
        (("believed = 1.0", "believed = 2.0"), "conservative"),
        (("kf.Q = start.copy(), P0.copy(), F, H, Q", "kf.Q = start.copy(), P0.copy(), F, H, 0.5 * Q"), "overconfident"),
    ],
)
def test_the_filterpy_filter_of_the_manual(
    change, status, inside,
    capsys,
):  # fmt: skip
    """The manual's seed, so no false alarm of its own; the three wrong filters are the negative control."""
    text = FILTERPY
    if change:
        assert change[0] in text
        text = text.replace(*change)
    (inside / "make.py").write_text(text)
    runpy.run_path("make.py")
    arguments = ("analyse", "estimates.csv", "--truth", "truth.csv", "--state", "px,py,vx,vy")
    code = int(status != "consistent")
    out, err = consistency(capsys, *arguments, "--json", "--fail-on", "inconsistent", status=code)
    verdict = json.loads(out)["estimates"]
    assert verdict["status"] == status
    assert verdict["statistics"]["axes"] == ["px", "py", "vx", "vy"]
    assert "error convention vector" in err


def test_the_notebook_of_the_manual(inside):
    (block,) = (block.text for block in blocks("docs/files.md", "python") if "record.plot(" in block.text)
    (inside / "notebook.py").write_text(block)
    planar(inside)
    assert runpy.run_path("notebook.py")["verdict"].status == "consistent"
    assert (inside / "mine.png").read_bytes().startswith(b"\x89PNG")
