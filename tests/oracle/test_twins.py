"""Compiled filters against their textbook twins, and the Kalman filter against batch least squares."""

from dataclasses import replace

import numpy as np
import pytest

import consistency as cs
from consistency.bench.filters.kernel.loop import trial_kernel
from consistency.bench.filters.run_filter import step_through
from consistency.bench.filters.textbook.ukf import CUBATURE, sigma_points
from consistency.bench.simulation import planned_path

MERWE = {"belief__sigma_points": {"alpha": 0.5, "beta": 2.0, "kappa": 1.0}}
EIGHT = {"shape": "figure-of-eight", "radius": 2.0, "start": (0.0, 0.0), "heading": 0.3, "speed": 0.8}


def differences(a, b):
    """Largest difference of poses (m, rad), of covariances in correlation units, and of NIS, relative, or log det S."""
    sigma = np.sqrt(np.einsum("kii->ki", b.covariance))
    scale = np.maximum(sigma[:, :, None] * sigma[:, None, :], 1e-30)
    pose = np.abs(a.pose - b.pose).max()
    covariance = (np.abs(a.covariance - b.covariance) / scale).max()
    assert np.array_equal(a.nis_dof, b.nis_dof)
    assert np.array_equal(np.isfinite(a.nis), b.nis_dof > 0)
    nis = np.nanmax(np.abs(a.nis - b.nis) / np.maximum(b.nis, 1.0))
    log_det = np.nanmax(np.abs(a.log_det - b.log_det))
    return float(pose), float(covariance), float(max(nis, log_det))


def agree(a, b, tolerance=1e-9):
    assert a.failure is None
    assert b.failure is None
    return max(differences(a, b)) < tolerance


def compiled(name, trial, belief):
    return cs.get_filter(name).run(trial, belief)


# --- twins -----------------------------------------------------------------------------------

CASES = [
    ("ekf-xyz", "herath2007-stereo", 300, {}),
    ("ekf-xyz", "long-loop", 300, {}),
    ("ekf-uvd", "herath2007-wide-baseline", 150, {"truth__motion__noise_on": "motion"}),
    ("ukf-xyz", "herath2007-stereo", 120, {}),
    ("ukf-xyz", "herath2007-xyz", 120, MERWE),
    ("ukf-uvd", "herath2007-wide-baseline", 120, {"truth__path": EIGHT}),
    ("ukf-uvd", "herath2007-wide-baseline", 120, MERWE),
]


@pytest.mark.parametrize("name, world, steps, changes", CASES)
def test_kernel_equals_its_twin(small, name, world, steps, changes):
    scenario = small(world, truth__steps=steps, **changes)
    trial = cs.simulate(scenario, run=1)
    assert agree(
        compiled(name, trial, scenario.belief), step_through(cs.get_filter(name).textbook, trial, scenario.belief)
    )


def test_the_four_steps_of_a_compiled_filter_are_its_twin(uvd):
    trial, filter_ = cs.simulate(uvd), cs.get_filter("ekf-uvd")
    stepped = step_through(filter_, trial, uvd.belief)
    assert np.array_equal(stepped.pose, step_through(filter_.textbook, trial, uvd.belief).pose)


def test_one_compiled_signature_serves_every_caller(uvd):
    """Arrays from a table are often column-major; a second signature would cost half a minute to compile."""
    trial = cs.simulate(uvd)
    ours = compiled("ekf-uvd", trial, uvd.belief)
    signatures = len(trial_kernel._entries)
    turned = replace(trial, controls=np.asfortranarray(trial.controls), z=np.asfortranarray(trial.z))
    turned.controls.flags.writeable = False
    again = compiled("ekf-uvd", turned, uvd.belief)
    assert np.array_equal(again.pose, ours.pose)
    assert len(trial_kernel._entries) == signatures


def test_the_cubature_filter_has_its_points_whatever_the_belief_says(small):
    trial = cs.simulate(small("herath2007-stereo"))
    default, merwe = (small("herath2007-stereo", **changes).belief for changes in ({}, MERWE))
    ckf = compiled("ckf-uvd", trial, merwe)
    assert np.array_equal(ckf.pose, compiled("ukf-uvd", trial, default).pose)
    assert agree(ckf, step_through(cs.get_filter("ckf-uvd").textbook, trial, merwe))
    assert not agree(ckf, compiled("ukf-uvd", trial, merwe), 1e-6)


def test_cubature_points(rng):
    """Arasaratnam & Haykin (2009): 2 L points at a distance of sqrt(L), equal weights, none for the centre."""
    L, root = 5, np.tril(rng.normal(size=(5, 5)))
    points, wm, wc = sigma_points(np.zeros(L), root @ root.T, np.arange(L), CUBATURE)
    whitened = np.linalg.solve(root, points.T).T
    assert np.allclose(np.linalg.norm(whitened[1:], axis=1), np.sqrt(L))
    assert np.allclose(wm[1:], 1 / (2 * L))
    assert np.allclose(wc, wm)
    assert wm[0] == pytest.approx(0, abs=1e-15)


def test_filters_differ_where_the_world_is_nonlinear(uvd):
    """Negative control: the four stereo filters are four filters."""
    trial = cs.simulate(uvd)
    every = [compiled(name, trial, uvd.belief) for name in ("ekf-xyz", "ekf-uvd", "ukf-xyz", "ukf-uvd")]
    for i in range(4):
        for j in range(i):
            assert not agree(every[i], every[j], 1e-6)


# --- the linear world ----------------------------------------------------------------------------


def batch(scenario, trial, steps):
    """Pose of step ``steps`` and its covariance by weighted least squares over all noises and landmarks.

    Unknowns are the motion noises (2 a step, prior Q) and the positions of the seen landmarks (no
    prior); the last number is the sum of squares at the minimum, which for a linear-Gaussian world is
    the sum of all NIS.
    """
    reference, sigma = planned_path(scenario.truth), np.array(scenario.belief.sensor.sigma)
    motion = scenario.belief.motion
    rows = trial.first[steps]
    labels, slot = np.unique(trial.landmark[:rows], return_inverse=True)
    unknowns = 2 * steps + 3 * len(labels)
    A, b = [np.eye(2 * steps, unknowns)], [np.zeros(2 * steps)]  # noises in standard deviations
    M = np.zeros((3, unknowns))  # deviation of the pose from the reference, as a function of the unknowns
    for k in range(steps):
        (dt, v, _), heading = trial.controls[k], reference[k, 2]
        c, s = np.cos(heading), np.sin(heading)
        M = np.array([[1, 0, -dt * v * s], [0, 1, dt * v * c], [0, 0, 1]]) @ M
        M[:, 2 * k] += np.array([dt * c, dt * s, 0]) * motion.sigma_v
        M[:, 2 * k + 1] += np.array([0, 0, dt]) * motion.sigma_omega
        x, y, heading = reference[k + 1]
        c, s = np.cos(heading), np.sin(heading)
        for row in range(trial.first[k], trial.first[k + 1]):
            dx, dy, height = trial.landmarks[trial.landmark[row]] - [x, y, 0.0]
            ahead, left = c * dx + s * dy, -s * dx + c * dy
            H = np.array([[-c, -s, left], [s, -c, -ahead], [0, 0, 0]]) @ M
            H[:, 2 * steps + 3 * slot[row] :][:, :3] += [[c, s, 0], [-s, c, 0], [0, 0, 1]]
            A.append(H / sigma[:, None])
            b.append((trial.z[row] - [ahead, left, height]) / sigma)
    big, right = np.vstack(A), np.concatenate(b)
    theta, _, rank, _ = np.linalg.lstsq(big, right, rcond=None)
    assert rank == unknowns
    covariance = M @ np.linalg.inv(big.T @ big) @ M.T
    return reference[steps] + M @ theta, covariance, float(np.sum(np.square(big @ theta - right)))


@pytest.mark.parametrize("run", [0, 1])
def test_kalman_filter_is_batch_least_squares(small, run):
    scenario = small("linear-gaussian", truth__steps=40)
    trial = cs.simulate(scenario, run)
    kf = compiled("kf", trial, scenario.belief)
    for steps in (5, 17, 40):
        pose, P, cost = batch(scenario, trial, steps)
        scale = np.sqrt(np.outer(np.diag(P), np.diag(P)))
        assert np.allclose(kf.pose[steps - 1], pose, rtol=0, atol=1e-9)
        assert np.abs((kf.covariance[steps - 1] - P) / scale).max() < 1e-9
        assert np.nansum(kf.nis[:steps]) == pytest.approx(cost, rel=1e-9)
    # negative control: least squares with another noise is another estimate
    other = small("linear-gaussian", truth__steps=40, belief__motion__sigma_omega=0.1)
    assert not np.allclose(kf.pose[-1], batch(other, trial, 40)[0], rtol=0, atol=1e-6)


def with_xyz(belief):
    """The belief of a linear world, for a filter that takes it to be the nonlinear one."""
    return belief.model_copy(update={"sensor": belief.sensor.model_copy(update={"model": "xyz"})})


def noise(scale):
    sigmas = {
        "motion__sigma_v": 0.05 * scale,
        "motion__sigma_omega": 0.09 * scale,
        "sensor__sigma": (0.05 * scale,) * 3,
    }
    return {f"{table}__{key}": value for table in ("truth", "belief") for key, value in sigmas.items()}


def test_ekf_equals_the_kalman_filter_where_noise_vanishes(small):
    """The second-order terms are of the order of the noise, relative to its standard deviation."""
    gaps = []
    for scale in (1.0, 1e-2, 1e-4):
        scenario = small("linear-gaussian", **noise(scale))
        trial = cs.simulate(scenario)
        kf, ekf = compiled("kf", trial, scenario.belief), compiled("ekf-xyz", trial, with_xyz(scenario.belief))
        pose, covariance, _ = differences(ekf, kf)
        gaps.append((pose / (0.05 * scale), covariance))
    full, hundredth, vanishing = np.array(gaps)
    assert np.all(vanishing < 1e-4)
    assert np.all(vanishing < 0.1 * hundredth)
    assert np.all(hundredth < 0.1 * full)
    assert np.all(full > 1e-4)  # negative control: with noise they differ


@pytest.mark.parametrize("points", [{}, MERWE], ids=["cubature", "Merwe"])
def test_every_filter_is_the_kalman_filter_where_the_heading_is_known(small, points):
    """With no noise on omega eq. 18 and 19 are linear in what is left, so all rules are exact."""
    known = {"truth__motion__sigma_omega": 0.0, "belief__motion__sigma_omega": 0.0, "truth__steps": 100}
    scenario = small("linear-gaussian", **known, **points)
    trial = cs.simulate(scenario)
    kf = compiled("kf", trial, scenario.belief)
    assert np.nansum(kf.nis) > 100
    largest = kf.covariance.max(axis=(1, 2), keepdims=True)  # some variances are zero
    for name in ("ekf-xyz", "ukf-xyz", "iekf-xyz", "ri-ekf-xyz", "fej-ekf-xyz", "oc-ekf-xyz"):
        filter_, belief = cs.get_filter(name), with_xyz(scenario.belief)
        for other in (filter_.run(trial, belief), step_through(filter_.textbook, trial, belief)):
            pose, _, nis = differences(other, kf)
            assert max(pose, nis) < 1e-10
            assert (np.abs(other.covariance - kf.covariance) / largest).max() < 1e-10
