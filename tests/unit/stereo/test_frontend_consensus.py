"""Consensus by reprojection, bad matches and bridged motions; no images, and no data."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import consistency as cs
from consistency.stereo.visual_odometry.arrays import MatchError
from consistency.stereo.visual_odometry.odometry import bridged
from consistency.stereo.visual_odometry.relative_motion import (
    MotionSettings,
    RelativeMotion,
    estimate_motion,
    inliers_within,
    resect_ransac,
    squared_reprojections,
)
from consistency.vision import ConsensusError, RelativePose, StereoRig, register_ransac, triangulate

pytest.importorskip("cv2", reason="OpenCV (the extra vision) is not installed")
K = np.array([[700.0, 0.0, 600.0], [0.0, 700.0, 180.0], [0.0, 0.0, 1.0]])
RIG = StereoRig(K, K, np.eye(3), np.array([0.54, 0.0, 0.0]), (1200, 360))
TRUE = RelativePose.from_vector(np.array([0.05, -0.02, 1.2, 0.002, -0.01, 0.003]))
SIGMA = 0.3  # px
N = 200


def matches(rng, depths=(8.0, 120.0)):
    """Right ones, whose inverse depths are spread evenly."""
    z = 1.0 / rng.uniform(1.0 / depths[1], 1.0 / depths[0], N)
    p = np.column_stack([rng.uniform(-0.7, 0.7, N) * z, rng.uniform(-0.2, 0.2, N) * z, z])
    uv0, uv1 = RIG.project(p), RIG.project((p - TRUE.t) @ TRUE.R)
    return uv0 + rng.normal(0.0, SIGMA, (N, 4)), uv1 + rng.normal(0.0, SIGMA, (N, 4))


def estimated(uv0, uv1, rng, **settings):
    """Mahalanobis distance of the pose from the true one, and the inliers."""
    sigma = np.full_like(uv0, SIGMA)
    found = estimate_motion(RIG, uv0, uv1, sigma, sigma, MotionSettings(**settings), rng)  # type: ignore[arg-type]
    error = found.pose.vector - TRUE.vector
    return float(np.sqrt(error @ np.linalg.solve(found.covariance, error))), found.inliers


@pytest.mark.parametrize("estimator", ["reprojection", "svd"])
@pytest.mark.filterwarnings("error")
def test_near_matches_of_which_a_third_is_wrong(estimator, rng):
    """A car that drives ahead and matches of other points. A right pose is 7 sigma off with a chance of 1e-8."""
    uv0, uv1 = matches(rng, (4.0, 8.0))
    car, other = np.arange(0, 30), np.arange(30, 60)
    ahead = triangulate(RIG, uv0[car]) + np.array([0.15, 0.0, 1.1])
    uv1[car] = RIG.project((ahead - TRUE.t) @ TRUE.R)
    uv1[other] = uv1[np.roll(other, 1)]
    far, inliers = estimated(uv0, uv1, rng, estimator=estimator)
    assert far < 7.0
    assert not inliers[:60].any()
    assert inliers[60:].mean() > 0.95


def test_far_points_alone_tell_the_motion(rng):
    """Beyond 40 m a triple misses the others by many metres, but by a few pixels."""
    uv0, uv1 = matches(rng, (40.0, 150.0))
    uv1[:60] = uv1[np.roll(np.arange(60), 1)]
    far, inliers = estimated(uv0, uv1, rng)
    assert far < 7.0
    assert inliers[60:].mean() > 0.95
    assert inliers[:60].mean() < 0.2


def test_a_gate_that_the_stated_noise_makes_too_narrow_grows(rng):
    """Noise of twice the stated one, as with a bad calibration: 9 % are lost in place of a third or more."""
    uv0, uv1 = matches(rng)
    sigma = np.full_like(uv0, SIGMA / 2.0)
    squared = squared_reprojections(RIG, uv0, uv1, sigma, sigma, TRUE)
    assert (squared <= 16.0).mean() < 0.7
    assert inliers_within(squared, 4.0, np.ones(N, bool)).mean() > 0.95
    assert inliers_within(squared, 4.0, squared <= 16.0).mean() > 0.95


def test_noise_that_is_stated_far_too_small_does_not_hide_the_motion(rng):
    """By 30 times: no pose of three points would have others within its gate if the search had no slack."""
    uv0, uv1 = matches(rng)
    sigma = np.full_like(uv0, SIGMA / 30.0)
    found = estimate_motion(RIG, uv0, uv1, sigma, sigma, MotionSettings(), rng)
    assert found.inliers.mean() > 0.95
    assert np.abs(found.pose.t - TRUE.t).max() < 0.1
    assert found.chi2 > 500.0 * found.dof


def test_the_gate_is_of_chi_square_where_the_noise_is_as_stated(rng):
    """4 degrees of freedom; 20,000 draws: the mean within 6 standard errors, and the gate loses 0.3 % +- 6 of them."""
    squared = rng.chisquare(4, 20_000)
    lost = 1.0 - inliers_within(squared, 4.0, np.ones(20_000, bool)).mean()
    assert lost == pytest.approx(0.00302, abs=6.0 * np.sqrt(0.00302 / 20_000))
    uv0, uv1 = matches(rng, (6.0, 25.0))
    sigma = np.full_like(uv0, SIGMA)
    found = squared_reprojections(RIG, uv0, uv1, sigma, sigma, TRUE)
    assert found.mean() == pytest.approx(4.0, abs=6.0 * np.sqrt(8.0 / N))
    behind = RelativePose(np.eye(3), np.array([0.0, 0.0, 200.0]))
    assert np.isinf(squared_reprojections(RIG, uv0, uv1, sigma, sigma, behind)).all()


def test_a_match_that_the_images_do_not_fix_is_dropped(rng):
    """Its disparity at time 1 is below zero; a gate as wide as this takes it in."""
    uv0, uv1 = matches(rng)
    uv0[7, 2], uv1[7, 2] = uv0[7, 0] - 2.1, uv1[7, 0] + 0.5
    far, inliers = estimated(uv0, uv1, rng, gate=50.0)
    assert far < 7.0
    assert not inliers[7]
    with pytest.raises(MatchError) as error:
        triangulate(RIG, uv1)
    assert error.value.match == 7


def test_no_consensus(rng):
    uv0, uv1 = matches(rng)
    sigma = np.full_like(uv0, SIGMA)
    with pytest.raises(ConsensusError, match="of 200 matches agree on a motion, at least 20 must"):
        resect_ransac(RIG, uv0, uv1[rng.permutation(N)], sigma, sigma, gate=4.0, rng=rng)


def test_the_chapters_consensus_stays(rng):
    """Registration of points in metres; of far points it needs their covariances."""
    uv0, uv1 = matches(rng, (4.0, 8.0))
    pose, inliers = register_ransac(triangulate(RIG, uv0), triangulate(RIG, uv1), threshold=0.5, rng=rng)
    assert inliers.mean() > 0.9
    assert np.linalg.norm(pose.t - TRUE.t) < 0.1


def test_unweighted_estimators_say_when_far_points_dominate(rng):
    sigma = np.full((N, 4), SIGMA)
    doubts = {}
    for name, depths in {"near": (4.0, 8.0), "far": (8.0, 120.0)}.items():
        uv0, uv1 = matches(rng, depths)
        for estimator in ("svd", "horn", "reprojection"):
            found = estimate_motion(RIG, uv0, uv1, sigma, sigma, MotionSettings(estimator=estimator), rng)
            doubts[name, estimator] = found.doubt
    assert "take estimator reprojection" in doubts["far", "svd"]
    assert "take estimator reprojection" in doubts["far", "horn"]
    assert {doubt for (name, estimator), doubt in doubts.items() if name == "near" or estimator == "reprojection"} == {
        ""
    }


# --- bridges ---------------------------------------------------------------------------------------


def motion(vector):
    uv, rows = np.ones((9, 4)), np.zeros((9, 2), np.int64)
    return RelativeMotion(
        pose=RelativePose.from_vector(vector), covariance=1e-6 * np.eye(6), inliers=np.ones(9, bool), chi2=9.0, dof=9,
        uv0=uv, uv1=uv, sigma0=uv, sigma1=uv, rows=rows,
    )  # fmt: skip


def drive(t, acceleration=0.4):
    """Motions along z with a velocity of 10 m/s that grows evenly."""
    middle, dt = 0.5 * (t[1:] + t[:-1]), np.diff(t)
    return [
        motion(np.array([0, 0, d * (10.0 + acceleration * m), 0, 0.01 * d, 0])) for m, d in zip(middle, dt, strict=True)
    ]


def test_a_bridge_keeps_the_velocity_of_its_neighbours():
    """Exact where the velocity grows evenly, however the frames lie in time."""
    t = np.cumsum([0, 0.1, 0.1, 0.12, 0.1, 0.3, *[0.1] * 9])
    true = drive(t)
    found = [cs.InputError("a.png to b.png: dark") if k in (4, 5) else m for k, m in enumerate(true)]
    whole = bridged(found, t)
    assert [m.fault for m in whole] == [""] * 4 + ["a.png to b.png: dark"] * 2 + [""] * 8
    for one, other in zip(whole, true, strict=True):
        assert_allclose(one.pose.vector, other.pose.vector, atol=1e-12)
    assert len(whole[4].uv0) == len(whole[4].inliers) == whole[4].dof == 0


def test_the_covariance_of_a_bridge_is_what_the_rule_misses_by(rng):
    """Velocities with independent errors of sigma 0.2: a mean of two neighbours misses by 0.2 sqrt(1.5)."""
    t = 0.1 * np.arange(402.0)
    true = [
        motion(np.append(0.1 * rng.normal([0, 0, 10.0], 0.2), np.zeros(3)) + 1e-6 * rng.normal(size=6))
        for _ in range(401)
    ]
    found = [cs.InputError("dark") if k == 200 else m for k, m in enumerate(true)]
    P = bridged(found, t)[200].covariance
    assert_allclose(np.sqrt(np.diagonal(P)[:3]), 0.1 * 0.2 * np.sqrt(1.5), rtol=0.2)  # 6 standard errors
    assert np.linalg.eigvalsh(P).min() > 0.0


@pytest.mark.parametrize("lost", [0, 9])
def test_at_its_ends_a_drive_keeps_its_velocity(lost):
    t = 0.1 * np.arange(11.0)
    found = [cs.InputError("dark") if k == lost else m for k, m in enumerate(drive(t, acceleration=0.0))]
    assert_allclose(bridged(found, t)[lost].pose.t, [0.0, 0.0, 1.0])
    few = bridged([*found[:6]], t[:7]) if lost == 0 else bridged(found[4:], t[4:])
    P = few[0 if lost == 0 else -1].covariance
    assert np.count_nonzero(P - np.diag(np.diagonal(P))) == 0  # too few for correlations


def test_drives_that_cannot_be_bridged():
    t = 0.1 * np.arange(5.0)
    good, lost = drive(t), ConsensusError("c.png to d.png: dark")
    assert bridged(good, t) == good
    with pytest.raises(ConsensusError, match=r"3 of 4 motions could not be measured; the first: c.png to d.png: dark"):
        bridged([good[0], lost, lost, lost], t)
    with pytest.raises(ConsensusError, match="too few motions around it were measured to bridge it"):
        bridged([good[0], lost, good[2], good[3]], t)
    with pytest.raises(ConsensusError, match=r"^c.png to d.png: dark$"):
        bridged([lost], t[:2])
