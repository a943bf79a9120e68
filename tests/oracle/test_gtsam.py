"""gtsam's smoothers against a dense Gauss-Newton in other variables, a Kalman filter, and the likelihood itself."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
import pytest
from scipy.stats import truncnorm

import consistency as cs
from consistency.bench.filters import EXTRAS, SMOOTHERS, filter_names, usable_names
from consistency.bench.filters.run_filter import run_filter, step_through
from consistency.bench.filters.textbook import basics
from consistency.bench.filters.textbook.basics import PointSensor, heading_matrix
from consistency.bench.protocols import Problem
from consistency.bench.scenario import models
from consistency.referee.types import Array

gtsam = pytest.importorskip("gtsam", reason="gtsam is not installed: pip install -e '.[smoothing]'")

from consistency.bench.filters.external import gtsam as gtsam_factors  # noqa: E402
from consistency.bench.filters.external.gtsam import (  # noqa: E402  # noqa: E402
    FixedLag,
    Incremental,
    PlanarStereo,
    WholeTrialSmoother,
    custom_factor,
    landmark_key,
    pose_key,
)

NAMES = ("gtsam-batch-uvd", "gtsam-lag-uvd", "gtsam-map-uvd")


@pytest.fixture(scope="module")
def sparse(small, tilted):
    """Few landmarks, seen by a tilted sensor that stands apart from the robot's centre; no search range believed."""
    scenario = small("herath2007-stereo", truth__steps=25, truth__landmarks__count=40)
    scenario = scenario.variant("sparse", truth__sensor__mount=tilted, belief__sensor__mount=tilted)
    return told(scenario, None)


def told(scenario, disparity):
    """The scenario with another believed search range."""
    sensor = scenario.belief.sensor.model_copy(update={"disparity": disparity})
    return scenario.model_copy(update={"belief": scenario.belief.model_copy(update={"sensor": sensor})})


def smoothed(trial, scenario):
    estimates = run_filter(cs.get_filter("gtsam-map-uvd"), trial, scenario.belief)
    assert estimates.failure is None
    return estimates


# --- a dense Gauss-Newton ------------------------------------------------------------------------


class Dense:
    """The noise of each step and world points as variables, so that no pose is one; derivatives by complex steps."""

    def __init__(self, trial, scenario):
        self.trial, self.belief = trial, scenario.belief
        self.labels = np.unique(trial.landmark)
        self.sigma_motion = np.array([self.belief.motion.sigma_v, self.belief.motion.sigma_omega])
        self.rows = trial.step - 1
        self.start = np.concatenate([np.zeros(2 * trial.steps), trial.landmarks[self.labels].ravel()])

    def poses(self, x):
        controls = np.array(self.trial.controls, complex)
        controls[:, 1:] += x[: 2 * self.trial.steps].reshape(-1, 2)
        return models.dead_reckoning(self.trial.start, controls)[1:]

    def landmarks(self, x):
        return x[2 * self.trial.steps :].reshape(-1, 3)

    def expected(self, x):
        pose, where = self.poses(x)[self.rows], self.landmarks(x)[np.searchsorted(self.labels, self.trial.landmark)]
        sensor = self.belief.sensor
        c = models.to_sensor(*models.to_robot(*pose.T, *where.T), sensor.mount.packed())
        return np.array(models.project(*c, sensor.f or 0.0, sensor.B or 0.0)).T

    def residual(self, x):
        noise = x[: 2 * self.trial.steps].reshape(-1, 2) / self.sigma_motion
        return np.concatenate([noise.ravel(), ((self.expected(x) - self.trial.z) / self.belief.sensor.sigma).ravel()])

    def solved(self):
        """Variables where the likelihood is greatest, and their covariance to first order."""
        x = self.start
        for _ in range(15):
            J = complex_step(self.residual, x)
            x = x - np.linalg.lstsq(J, self.residual(x), rcond=None)[0]
        J = complex_step(self.residual, x)
        return x, np.linalg.inv(J.T @ J)


def complex_step(f, x):
    """Derivatives (k, n) of f at x (n,)."""
    return np.array([f(x + 1e-30j * e).imag.ravel() / 1e-30 for e in np.eye(len(x))]).T


def test_every_pose_and_landmark_is_that_of_a_dense_gauss_newton(sparse):
    trial = cs.simulate(sparse, run=1)
    dense = Dense(trial, sparse)
    x, P = dense.solved()
    ours = smoothed(trial, sparse)
    J = complex_step(dense.poses, x).reshape(trial.steps, 3, -1)
    poses, covariances = dense.poses(x).real, J @ P @ np.swapaxes(J, 1, 2)
    sigma = np.sqrt(np.einsum("kii->ki", covariances))[1:]  # the first pose is certain across the heading
    assert np.abs((ours.pose - poses)[1:] / sigma).max() < 1e-4
    assert np.abs((ours.covariance - covariances)[1:] / (sigma[:, :, None] * sigma[:, None, :])).max() < 1e-4
    assert np.abs(ours.covariance[0] - covariances[0]).max() < 1e-4 * covariances[0].max()
    assert np.array_equal(ours.map.landmarks, dense.labels)
    blocks = np.array([P[i : i + 3, i : i + 3] for i in range(2 * trial.steps, len(x), 3)])
    sigma = np.sqrt(np.einsum("kii->ki", blocks))
    assert np.abs((ours.map.mean - dense.landmarks(x)) / sigma).max() < 1e-3
    assert np.abs((ours.map.covariance - blocks) / (sigma[:, :, None] * sigma[:, None, :])).max() < 1e-3


@pytest.mark.parametrize("name", ["gtsam-batch-uvd", "gtsam-lag-uvd"])
def test_the_last_pose_of_a_stepwise_smoother_is_that_of_the_whole_trial(sparse, name):
    """To the thresholds at which they linearise again; all of a short trial is in the window."""
    trial = cs.simulate(sparse, run=1)
    whole, step = smoothed(trial, sparse), run_filter(cs.get_filter(name), trial, sparse.belief)
    sigma = np.sqrt(np.diag(whole.covariance[-1]))
    assert step.failure is None
    assert np.abs((step.pose[-1] - whole.pose[-1]) / sigma).max() < 0.05
    assert (
        np.abs(step.covariance[-1] / np.outer(sigma, sigma) - whole.covariance[-1] / np.outer(sigma, sigma)).max()
        < 0.02
    )
    assert np.abs(step.pose[12] - whole.pose[12]).max() > 1e-4  # which knows what comes after


def test_a_short_window_forgets_what_it_linearised(sparse):
    trial = cs.simulate(sparse, run=1)
    whole = smoothed(trial, sparse)
    short = run_filter(FixedLag("short", 2), trial, sparse.belief)
    assert short.failure is None
    assert np.abs(short.pose[-1] - whole.pose[-1]).max() > 1e-6
    assert np.abs(short.pose[-1] - whole.pose[-1]).max() < 1.0 * np.sqrt(whole.covariance[-1].max())


def test_certainty_across_the_heading_is_a_limit(sparse, monkeypatch):
    trial = cs.simulate(sparse, run=1)
    ours = smoothed(trial, sparse)
    assert np.isnan(cs.run_trials(sparse, ["gtsam-lag-uvd"], runs=1).estimates["nees"][0])  # of rank two
    for across, nearness in ((0.0, 1e-5), (1e-5, 1e-5), (1e-1, np.inf)):
        monkeypatch.setattr(gtsam_factors, "ACROSS", across)
        other = smoothed(trial, sparse)
        gap = np.abs(other.covariance - ours.covariance)[1:].max() / ours.covariance[1:].max()
        assert gap < nearness
    assert gap > 1e-4  # negative control


# --- the likelihood with its search range ----------------------------------------------------------


def test_the_whole_likelihood_is_greatest_with_the_search_range(sparse):
    searched = (1.0, 32.0)
    far = sparse.variant("far", truth__sensor__range=(2.0, 6.0), truth__landmarks__count=25)
    trial = cs.simulate(far, run=3)
    assert trial.z[:, 2].min() < 1.5

    def slopes(scenario):
        """Derivatives of -log likelihood by noise and landmarks, in standard deviations."""
        dense, ours = Dense(trial, far), smoothed(trial, scenario)
        poses = np.vstack([trial.start, ours.pose])
        v = np.einsum(
            "ki,ki->k", np.diff(poses[:, :2], axis=0), np.array([np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])]).T
        )
        noise = np.column_stack([v, np.diff(poses[:, 2])]) / trial.controls[:, :1] - trial.controls[:, 1:]
        x = np.concatenate([noise.ravel(), ours.map.mean.ravel()])
        scale = np.sqrt(np.diag(np.linalg.inv((J := complex_step(dense.residual, x)).T @ J)))
        low, high = ((edge - dense.expected(x)[:, 2].real) / far.belief.sensor.sigma[2] for edge in searched)
        mass = truncnorm(low, high)
        J = J * scale
        pulls = dense.residual(x)
        pulls[2 * trial.steps + 2 :: 3] += mass.mean()
        return np.asarray(J.T @ pulls)

    assert np.abs(slopes(told(far, searched))).max() < 1e-3
    assert np.abs(slopes(far)).max() > 1e-2  # negative control


# --- a linear world ----------------------------------------------------------------------------------


@dataclass
class LinearWorld:
    """The linear world of the Kalman filter, every Jacobian at the reference."""

    problem: Problem
    origins: dict[int, Array] = field(default_factory=dict)
    reference: dict[int, Array] = field(default_factory=dict)

    def moved(self, pose, control):
        step = len(self.reference)
        at = self.reference.setdefault(0, self.problem.start) if step == 0 else self.reference[step - 1]
        self.reference[max(step, 1)] = basics.pose_after(at, control)
        F, _ = basics.motion_jacobians(at, control)
        return self.reference[max(step, 1)] + F @ (pose - at)

    def motion(self, step, control):
        at, belief = self.reference[step - 1], self.problem.belief.motion
        F, _ = basics.motion_jacobians(at, control)
        turn, ahead = heading_matrix(at[2]).T, self.reference[step]
        sigmas = control.dt * np.array([belief.sigma_v, 1e-7 * belief.sigma_v, belief.sigma_omega])

        def error(poses):
            before, after = poses if step > 1 else (at, *poses)
            J = [-turn @ F, turn] if step > 1 else [turn]
            return turn @ (after - ahead - F @ (before - at)), J

        return custom_factor([pose_key(k) for k in (step - 1, step) if k > 0], sigmas, error)

    def placed(self, label, pose, z):
        self.origins[label] = self.problem.landmarks[label]
        return self.origins[label]

    def sight(self, step, observation):
        sensor = PointSensor(self.problem.belief.sensor, uvd=False)
        labels, at = [int(label) for label in observation.landmarks], self.reference[step]
        known = [self.origins[label] for label in labels]
        H = [sensor.jacobians(at, place) for place in known]
        expected = [sensor.measure(at, place) for place in known]
        sigmas = np.tile(self.problem.belief.sensor.sigma, len(labels))

        def error(values):
            gaps = [e + Hp @ (values[0] - at) + Hl @ (value - place) - z for e, (Hp, Hl), value, place, z
                    in zip(expected, H, values[1:], known, observation.z, strict=True)]  # fmt: skip
            J = [np.vstack([Hp for Hp, _ in H])]
            for i, (_, Hl) in enumerate(H):
                block = np.zeros((3 * len(labels), 3))
                block[3 * i : 3 * i + 3] = Hl
                J.append(block)
            return np.concatenate(gaps), J

        return custom_factor([pose_key(step), *map(landmark_key, labels)], sigmas, error)

    def point(self, label, landmark):
        return landmark


def test_in_a_linear_world_they_are_the_kalman_filter(linear):
    trial = cs.simulate(linear, run=2)
    exact = run_filter(cs.get_filter("kf"), trial, linear.belief)
    sigma = np.sqrt(np.einsum("kii->ki", exact.covariance))[1:]
    scale = sigma[:, :, None] * sigma[:, None, :]
    for filter_ in (Incremental("batch", LinearWorld), FixedLag("lag", 10, LinearWorld)):
        ours = step_through(filter_, trial, linear.belief)
        assert ours.failure is None
        assert np.abs((ours.pose - exact.pose)[1:] / sigma).max() < 1e-6
        assert np.abs((ours.covariance - exact.covariance)[1:] / scale).max() < 1e-6
    whole = WholeTrialSmoother("map", LinearWorld).run(trial, linear.belief)
    assert whole.failure is None
    assert np.abs((whole.pose - exact.pose)[-1] / sigma[-1]).max() < 1e-6
    assert np.abs((whole.covariance - exact.covariance)[-1] / scale[-1]).max() < 1e-6
    variances = np.einsum("kii->ki", whole.covariance)[1:-1]
    assert (variances < sigma[:-1] ** 2 * (1 + 1e-9)).all()  # later data add
    assert (variances.min(axis=1) < 0.9 * sigma[:-1].min(axis=1) ** 2).any()


# --- in the bench ------------------------------------------------------------------------------------


class BlindWorld(PlanarStereo):
    """From step 4 on the observations say nothing."""

    def sight(self, step, observation):
        if step < 4:
            return super().sight(step, observation)
        keys = [pose_key(step), *(landmark_key(int(label)) for label in observation.landmarks)]
        return custom_factor(keys, np.ones(3), lambda values: (np.zeros(3), [np.zeros((3, 3)) for _ in values]))


def test_what_cannot_be_solved_is_a_result_with_step_and_reason(sparse):
    trial = cs.simulate(sparse, run=1)
    new = [k for k in range(4, 26) if set(trial.landmark[trial.first[k - 1] : trial.first[k]])
           - set(trial.landmark[: trial.first[k - 1]])]  # fmt: skip
    for filter_, step in ((Incremental("blind", BlindWorld), new[0]), (WholeTrialSmoother("blind", BlindWorld), 1)):
        failure = run_filter(filter_, trial, sparse.belief).failure
        assert failure.step in (step, step + 1)  # gtsam notices at once, or when it solves again
        assert "ndeterminate linear system detected while working near variable" in failure.reason
        assert "\n" not in failure.reason


def test_they_run_beside_ours_in_threads_and_processes(small):
    scenario = small("herath2007-stereo", truth__steps=12, truth__landmarks__count=40)
    alone = cs.run_trials(scenario, NAMES, runs=2, jobs=1)
    assert len(alone.failures) == 0
    among = cs.run_trials(scenario, NAMES, runs=2, jobs=2)
    pd.testing.assert_frame_equal(among.estimates, alone.estimates, check_exact=True)
    threads = cs.run_trials(scenario, ["gtsam-map-uvd", "ekf-uvd"], runs=2, jobs=2).estimates
    same = alone.estimates[alone.estimates["filter"] == "gtsam-map-uvd"].reset_index(drop=True)
    pd.testing.assert_frame_equal(
        threads[threads["filter"] == "gtsam-map-uvd"].reset_index(drop=True), same, check_exact=True
    )


def test_the_smoother_of_whole_trials_is_marked_and_cannot_be_stepped(sparse):
    marked = {name for name in usable_names() if getattr(cs.get_filter(name), "causal", True) is False}
    assert marked == SMOOTHERS
    with pytest.raises(cs.InputError, match="'gtsam-map-uvd' smooths whole trials and cannot be stepped"):
        cs.get_filter("gtsam-map-uvd").init(None)


def test_gtsam_is_loaded_when_it_is_asked_for():
    def loaded(name):
        code = f"import sys, consistency; consistency.get_filter('{name}'); print('gtsam' in sys.modules)"
        out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
        return out.stdout.strip() == "True"

    assert not loaded("ekf-uvd")
    assert loaded("gtsam-map-uvd")


def test_a_world_without_stereo_is_refused(xyz):
    with pytest.raises(cs.InputError, match="filter 'gtsam-map-uvd' works on a sensor uvd, not 'xyz'"):
        cs.run_trials(xyz, ["gtsam-map-uvd"], runs=1)


def test_the_registry_knows_them():
    assert set(NAMES) <= set(filter_names())
    assert set(EXTRAS) == {"external.filterpy", "external.gtsam"}
