"""Covariances of differences of rotation vectors and of roll, pitch, yaw."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import consistency as cs
from consistency.referee.geometry import from_left, inverse, log, matrices, spatial_error, state_error, to_left
from consistency.referee.readers.alignment import WorldTransform, moved
from consistency.referee.readers.truth_matching import make_poses

SIGMA = np.array([0.02, 0.05, 0.03, 0.05, 0.02, 0.08])  # x, y, z, and three of the rotation
CHARTS = ("rvec", "euler")


def numbers(turn, convention):
    """Rotation vectors, or roll, pitch, yaw, as SciPy has them."""
    return turn.as_rotvec() if convention == "rvec" else turn.as_euler("ZYX")[..., ::-1]


def rotation(values, convention):
    return Rotation.from_rotvec(values) if convention == "rvec" else Rotation.from_euler("ZYX", values[..., ::-1])


def drawn(convention, size, rng):
    """Estimates and truth, (N, 7), whose errors are e, (N, 6), in a convention."""
    turn = rotation(rng.uniform(-1.2, 1.2, (size, 3)), convention)
    place, e = rng.normal(size=(size, 3)), SIGMA * rng.normal(size=(size, 6))
    true = rotation(numbers(turn, convention) + e[:, 3:], convention)
    own = np.column_stack([place, turn.as_quat()])
    return own, np.column_stack([place + e[:, :3], true.as_quat()]), e


@pytest.mark.parametrize("convention", CHARTS)
def test_the_error_is_the_difference_of_the_numbers(convention, rng):
    own, true, e = drawn(convention, 50, rng)
    assert_allclose(spatial_error(true, own, convention), e, atol=1e-12)
    assert_allclose(spatial_error(true[3], own[3], convention), e[3], atol=1e-12)
    rest = rng.normal(size=(2, 50, 9))
    state = state_error(np.hstack([true, rest[0]]), np.hstack([own, rest[1]]), convention)
    assert_allclose(state, np.hstack([e, rest[0] - rest[1]]), atol=1e-12)


def test_the_nearer_of_two_triples_or_vectors_counts():
    """A pitch that crosses the vertical, a yaw and a vector that cross half a turn."""
    triples = [([0.0, 1.55, 0.2], [0.0, 1.59, 0.2]), ([0.1, 0.2, 3.13], [0.1, 0.2, -3.13])]
    for own, true in triples:
        a, b = (np.append(np.zeros(3), Rotation.from_euler("ZYX", each[::-1]).as_quat()) for each in (own, true))
        gap = np.subtract(true, own)
        gap -= 2.0 * np.pi * np.round(gap / (2.0 * np.pi))
        assert_allclose(spatial_error(b, a, "euler")[3:], gap, atol=1e-9)
    a, b = (np.append(np.zeros(3), Rotation.from_rotvec([angle, 0.0, 0.0]).as_quat()) for angle in (3.1, 3.2))
    assert_allclose(spatial_error(b, a, "rvec")[3:], [0.1, 0.0, 0.0], atol=1e-9)


@pytest.mark.parametrize("scale", [1.0, 1e-4, 0.0])
@pytest.mark.parametrize("convention", [*CHARTS, "additive"])
def test_the_error_in_the_body_follows_to_first_order(convention, scale, rng):
    """Central differences of 1e-5, whose error is of second order."""
    kind = "rvec" if convention == "additive" else convention
    values = scale * rng.uniform(-1.3, 1.3, (20, 3))
    own = np.column_stack([rng.normal(size=(20, 3)), rotation(values, kind).as_quat()])
    T = matrices(own)
    J = to_left(T, convention)
    for i, step in enumerate(1e-5 * np.eye(6)):
        ends = []
        for sign in (1.0, -1.0):
            turn = rotation(values + sign * step[3:], kind)
            other = np.column_stack([own[:, :3] + sign * step[:3], turn.as_quat()])
            ends.append(log(inverse(T) @ matrices(other)))
        assert_allclose(J[:, :, i], (ends[0] - ends[1]) / 2e-5, atol=1e-8)
    assert_allclose(from_left(T, convention) @ J, np.broadcast_to(np.eye(6), J.shape), atol=1e-9)


@pytest.mark.parametrize("convention", CHARTS)
def test_another_world_carries_the_covariance_along(convention, rng):
    """The NEES of small errors is the same in any world."""
    own, true, e = drawn(convention, 40, rng)
    e *= 1e-4
    values = numbers(Rotation.from_quat(own[:, 3:]), convention)
    true = np.column_stack([own[:, :3] + e[:, :3], rotation(values + e[:, 3:], convention).as_quat()])
    P = np.broadcast_to(np.diag(SIGMA**2), (40, 6, 6)).copy()
    t = np.arange(40.0)
    p = make_poses(None, t, own, P, np.ones(40, bool), t, true, "spatial", convention, 0.0)
    world = WorldTransform(Rotation.from_rotvec([0.2, -0.3, 0.5]), np.array([1.0, 2.0, 3.0]))
    q = moved(p, world)
    error = spatial_error(world.placed(true, "spatial"), q.own.estimate, convention)
    there = np.einsum("ki,kij,kj->k", error, np.linalg.inv(q.own.covariance), error)
    assert_allclose(there, np.square(e / SIGMA).sum(axis=1), rtol=1e-2)


def write_runs(folder, convention, rng, runs=40, steps=5):
    P = np.diag(SIGMA**2)
    for name in ("est", "truth"):
        (folder / name).mkdir()
    for run in range(runs):
        own, true, _ = drawn(convention, steps, rng)
        t = np.arange(steps)
        np.savetxt(folder / f"est/{run:02d}.txt", np.column_stack([t, own, np.tile(P.ravel(), (steps, 1))]))
        np.savetxt(folder / f"truth/{run:02d}.txt", np.column_stack([t, true]))


@pytest.mark.parametrize("convention", CHARTS)
def test_files_of_such_covariances_are_consistent(convention, tmp_path, rng):
    """False-alarm rate 1e-5; the mean NEES of 200 errors of 6 lies within five of its deviations, 2.9e-7 each side."""
    write_runs(tmp_path, convention, rng)
    record = cs.read(tmp_path / "est", tmp_path / "truth", error=convention, time_offset=0.0)
    assert cs.judge(record, false_alarm=1e-5).status in ("consistent", "undecided")
    assert record.errors.nees.mean() == pytest.approx(6.0, abs=5.0 * np.sqrt(12.0 / 200))


def test_calibrations_that_are_independent_are_consistent(rng):
    """One pose of a camera a row, as solvePnP gives it; false-alarm rate 1e-5."""
    own, true, _ = drawn("rvec", 300, rng)
    P = np.broadcast_to(np.diag(SIGMA**2), (300, 6, 6))
    v = cs.judge(spatial_error(true, own, "rvec"), P, independent=True, false_alarm=1e-5)
    assert v.status == "consistent"
    wrong = cs.judge(spatial_error(true, own, "so3"), P, independent=True)
    assert wrong.status != "consistent"


def test_the_truth_of_other_axes_has_no_covariance_of_such_an_error(tmp_path, rng):
    write_runs(tmp_path, "rvec", rng, runs=2)
    with pytest.raises(cs.InputError, match=r"truth_covariance: .*'rvec'"):
        cs.read(
            tmp_path / "est/00.txt", tmp_path / "est/01.txt", error="rvec", truth_covariance="columns",
            truth_world="ned", truth_body_axes="frd", time_offset=0.0,
        )  # fmt: skip
