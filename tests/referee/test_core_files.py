"""Files of every format that the core reads, what it refuses, and truth between its samples against known motions."""

import inputs
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

import consistency as cs
from consistency.referee.errors import InputError
from consistency.referee.geometry import SPATIAL, se3_log, spatial_error, wrap
from consistency.referee.readers.formats.sheet import read_sheet
from consistency.referee.readers.mix_ups.hints import hints
from consistency.referee.readers.options import make_reading
from consistency.referee.readers.pipeline.read_files import read_recordings
from consistency.referee.readers.truth_matching import BRIDGED, truth_at
from consistency.referee.verdicts.compare_sources import FILTER_KEYS, _filter_of


def test_a_table_has_the_errors_that_were_written(tmp_path):
    record = cs.read(inputs.planar(tmp_path, "fair"), truth=tmp_path / "truth.csv")
    expected = (inputs.normal(inputs.RUNS * inputs.STEPS, 3) @ np.linalg.cholesky(inputs.P).T).reshape(
        inputs.RUNS, inputs.STEPS, 3
    )
    assert_allclose(record.errors.error, expected, atol=1e-11)
    assert_allclose(record.errors.covariance[3, 2], inputs.P, atol=1e-13)
    assert record.errors.axes == ("x", "y", "heading")
    assert cs.judge(record).status == "consistent"


@pytest.mark.parametrize("scale, status", [(1.0, "consistent"), (1.6, "overconfident"), (0.6, "conservative")])
def test_a_trajectory_in_space(scale, status, tmp_path):
    est, true, cov = inputs.trajectories(tmp_path, scale)
    record = cs.read(est, truth=true, covariance=cov, time_offset=0.0)
    assert_allclose(record.errors.error[0, 0, :3], scale * np.array([0.1, 0.2, 0.05]) * inputs.normal(1, 3)[0])
    assert cs.judge(record).status == status


@pytest.mark.parametrize("align", ["origin", "posyaw", "se3", "posyaw-all", "se3-all"])
def test_a_trajectory_in_another_world(align, tmp_path):
    est, true, cov = inputs.trajectories(tmp_path, runs=4)
    turn, shift = Rotation.from_euler("z", 0.7), np.array([5.0, -2.0, 1.0])
    for path in true.iterdir():
        rows = np.loadtxt(path)
        rows[:, 1:4] = turn.apply(rows[:, 1:4]) + shift
        rows[:, 4:] = (turn * Rotation.from_quat(rows[:, 4:])).as_quat()
        np.savetxt(path, rows, fmt="%.17g")
    assert np.abs(cs.read(est, truth=true, covariance=cov, axes=["x", "y", "z"]).errors.error).max() > 1.0
    assert np.nanmax(np.abs(cs.read(est, truth=true, covariance=cov, align=align).errors.error)) < 1.0


def test_a_state_of_other_columns(tmp_path):
    lines = [[k, float(e), 1.0] for k, e in enumerate(inputs.normal(50, 1)[:, 0])]
    inputs.rows(tmp_path / "est.csv", "step,bias,P_bias_bias", lines)
    inputs.rows(tmp_path / "true.csv", "step,bias", [[k, 0.0] for k in range(50)])
    record = cs.read(tmp_path / "est.csv", truth=tmp_path / "true.csv", state=["bias"])
    assert record.errors.axes == ("bias",)
    assert_allclose(record.errors.error[0, :, 0], -inputs.normal(50, 1)[:, 0], atol=1e-11)


@pytest.mark.parametrize("column, value", [("x", "nan"), ("heading", "inf"), ("heading", "nan")])
def test_an_estimate_that_is_not_finite_is_a_failed_run(column, value, tmp_path):
    """Without a warning on any version; warnings are errors here."""
    path = inputs.planar(tmp_path, "fair")
    header, *lines = path.read_text().splitlines()
    cells = lines[8].split(",")  # run 1, step 3
    cells[header.split(",").index(column)] = value
    lines[8] = ",".join(cells)
    path.write_text("\n".join([header, *lines]))
    [recording] = read_recordings(path, make_reading(truth=tmp_path / "truth.csv"))
    [failure] = recording.failures
    assert (failure.run, failure.step) == (1, 3)
    assert failure.reason.startswith("estimate is not finite")


def test_truth_of_another_time_is_refused(tmp_path):
    est, true, cov = inputs.trajectories(tmp_path)
    for path in true.iterdir():
        rows = np.loadtxt(path)
        rows[:, 0] += 1000.0
        np.savetxt(path, rows, fmt="%.17g")
    with pytest.raises(InputError, match="no estimate has a truth within"):
        cs.read(est, truth=true, covariance=cov)


@pytest.mark.parametrize("convention", SPATIAL)
def test_no_poses_have_no_errors(convention):
    assert spatial_error(np.empty((0, 7)), np.empty((0, 7)), convention).shape == (0, 6)
    assert spatial_error(np.empty((2, 0, 7)), np.empty((2, 0, 7)), convention).shape == (2, 0, 6)
    assert se3_log(np.empty((2, 0, 7))).shape == (2, 0, 6)


def test_an_angle_that_is_not_finite_is_nan():
    assert_array_equal(wrap(np.array([0.5, np.nan, np.inf])), [0.5, np.nan, np.nan])


def test_the_logarithm_of_a_motion_in_space():
    """Beside the exponential of its matrix."""
    twist = np.array([0.3, -1.2, 2.0, 0.4, -0.7, 1.1])
    generator = np.zeros((4, 4))
    generator[:3, 3], (a, b, c) = twist[:3], twist[3:]
    generator[:3, :3] = [[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]]
    motion = expm(generator)
    pose = np.concatenate([motion[:3, 3], Rotation.from_matrix(motion[:3, :3]).as_quat()])
    assert_allclose(se3_log(pose), twist, atol=1e-12)


def test_a_quoted_row_with_too_few_fields(tmp_path):
    (tmp_path / "a.csv").write_text('x,y,z\n"1",2\n')
    with pytest.raises(InputError, match="line 2: has 2 columns, the header has 3"):
        read_sheet(tmp_path / "a.csv")


def test_an_unknown_key_of_a_baseline():
    with pytest.raises(ValueError, match=r"key 'filters\.a\.more': unknown"):
        _filter_of(dict.fromkeys(FILTER_KEYS, 1) | {"more": 1}, "filters.a")


def test_no_run_needs_no_hint():
    assert hints("a", ("x", "y", "heading"), []) == []


# --- truth between its samples --------------------------------------------------------------------------------


T = 100.0 + 0.1 * np.arange(30)


@pytest.fixture
def times():
    return np.sort(np.random.default_rng().uniform(T[0], T[-1], 50))


def straight(t):
    return np.outer(t, [1.0, -2.0, 0.5]) + np.array([3.0, 1.0, 0.0])


def test_even_motion_is_met_exactly(times):
    """Straight on, and about one axis of the body, in space."""
    axis = np.array([0.3, -0.5, 0.8])

    start = Rotation.from_euler("ZYX", [0.4, -0.7, 1.1])

    def motion(t):
        return np.hstack([straight(t), (start * Rotation.from_rotvec(np.outer(t - 100.0, axis))).as_quat()])

    known = truth_at(times, T, motion(T), "spatial", 0.0)
    assert known.rows.tolist() == list(range(50))
    assert_allclose(known.truth[:, :3], straight(times), atol=1e-9)
    turn = Rotation.from_quat(known.truth[:, 3:]).inv() * Rotation.from_quat(motion(times)[:, 3:])
    assert turn.magnitude().max() < 1e-9
    assert_allclose(known.bend, 0.0, atol=1e-9)


def test_a_quaternion_and_its_negative_are_one_turn(times):
    poses = np.hstack([straight(T), Rotation.from_rotvec(np.outer(T, [0, 0, 0.4])).as_quat()])
    flipped = poses * np.where(np.arange(len(T))[:, None] % 2, np.append(np.ones(3), -np.ones(4)), 1.0)
    one, other = (Rotation.from_quat(truth_at(times, T, p, "spatial", 0.0).truth[:, 3:]) for p in (poses, flipped))
    assert (one.inv() * other).magnitude().max() < 1e-9


def test_headings_go_the_short_way(times):
    heading = 1.7 * times
    values = np.column_stack([np.cos(T), np.sin(T), wrap(1.7 * T)])
    known = truth_at(times, T, values, "planar", 0.0)
    assert_allclose(wrap(known.truth[:, 2] - heading), 0.0, atol=1e-9)
    assert np.abs(known.truth[:, 2]).max() <= np.pi
    between = (T[:-1] + T[1:]) / 2.0  # one of them where the heading jumps
    plain = truth_at(between, T, values, "vector", 0.0).truth[:, 2]
    assert np.abs(wrap(plain - 1.7 * between)).max() > 0.5, "negative control"


def test_at_a_sample_it_is_the_sample_to_the_bit():
    values = np.random.default_rng().normal(size=(len(T), 7))
    known = truth_at(T, T, values, "spatial", 0.0)
    assert np.array_equal(known.truth, values)
    assert known.before.tolist() == list(range(len(T)))
    assert not known.apart.any()


def test_what_is_bridged():
    """A gap of a second is not, but near one of its ends; nor is what is before the first or after the last sample."""
    reference = np.array([0.0, 0.1, 1.1, 1.1 + BRIDGED])
    times = np.array([-0.02, -0.005, 0.05, 0.108, 0.12, 1.095, 1.15, 1.206, 1.25])
    values = reference[:, None] * [1.0, 2.0]
    known = truth_at(times, reference, values, "vector", 0.01)
    assert known.rows.tolist() == [1, 2, 3, 5, 6, 7]
    assert_allclose(known.truth[:, 0], [0.0, 0.05, 0.108, 1.095, 1.15, 1.1 + BRIDGED], atol=1e-12)
    assert_allclose(known.truth[:, 1], 2.0 * known.truth[:, 0])
    assert_allclose(known.apart, [0.005, 0.05, 0.008, 0.005, 0.05, 0.006], atol=1e-12)


def test_one_sample_serves_what_is_near():
    known = truth_at(np.array([0.9, 0.995, 1.004]), np.array([1.0]), np.array([[7.0]]), "vector", 0.01)
    assert (known.rows.tolist(), known.truth.ravel().tolist()) == ([1, 2], [7.0, 7.0])


def test_the_bend_bounds_the_error_under_even_acceleration(times):
    a = np.array([2.0, -1.0, 0.5])
    values = 0.5 * T[:, None] ** 2 * a
    known = truth_at(times, T, values, "vector", 0.0)
    error = np.linalg.norm(known.truth - 0.5 * times[:, None] ** 2 * a, axis=1)
    assert_allclose(known.bend, error, atol=1e-9)
