"""Sub-maps: one large filter to first order after each join, and less certain between them."""

import numpy as np
import pytest

import consistency as cs
from consistency.bench.filters.run_filter import step_through
from consistency.bench.filters.textbook.submaps import SubmapKalman, joined_map
from consistency.bench.protocols import Problem

STEPS = 20
WORLDS = {True: "herath2007-wide-baseline", False: "herath2007-xyz"}


def quiet(scenario, scale):
    """The world with all noise, true and believed, multiplied."""
    belief, changes = scenario.belief, {}
    for table in ("truth", "belief"):
        changes[f"{table}__motion__sigma_v"] = scale * belief.motion.sigma_v
        changes[f"{table}__motion__sigma_omega"] = scale * belief.motion.sigma_omega
        changes[f"{table}__sensor__sigma"] = tuple(scale * s for s in belief.sensor.sigma)
    return scenario.variant("quiet", **changes)


def compared(scenario, uvd):
    """Of each step: distance from the EKF's pose in standard deviations, and the ratio of the traces of P."""
    trial = cs.simulate(scenario, run=1)
    ours = step_through(SubmapKalman("submaps", uvd, STEPS), trial, scenario.belief)
    one = step_through(cs.get_filter("ekf-uvd" if uvd else "ekf-xyz").textbook, trial, scenario.belief)
    assert ours.failure is None
    sigma = np.sqrt(np.einsum("kii->ki", one.covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        distance = (np.abs(ours.pose - one.pose) / sigma).max(axis=1)
        spread = np.einsum("kii->ki", ours.covariance)[:, 2] / sigma[:, 2] ** 2
    return distance, spread


@pytest.mark.parametrize("uvd", [True, False])
def test_a_join_gives_what_one_filter_has(small, uvd, tilted):
    world = small(WORLDS[uvd], truth__sensor__mount=tilted, belief__sensor__mount=tilted)
    at = np.arange(STEPS, 61, STEPS) - 1
    (tenth, _), (hundredth, spread) = (compared(quiet(world, scale), uvd) for scale in (0.1, 0.01))
    assert 0.8 < np.log10(tenth[at].max() / hundredth[at].max()) < 1.2
    assert hundredth[at].max() < 0.01
    assert spread[at] == pytest.approx(1.0, abs=0.01)
    between = STEPS + STEPS // 2
    assert hundredth[between] > 0.1  # the large map is not asked
    assert spread[between] > 1.05


def test_a_landmark_is_in_the_map_once(small):
    scenario = small(WORLDS[True])
    trial, filter_ = cs.simulate(scenario, run=1), SubmapKalman("submaps", True, STEPS)
    state = filter_.init(Problem(scenario.belief, trial.start))
    for k in range(1, 31):
        state, _ = filter_.update(filter_.predict(state, trial.control(k)), trial.observation(k))
    assert state.steps == 30 - STEPS
    whole = joined_map(state)
    assert len(set(whole.landmarks)) == len(whole.landmarks) == (len(whole.x) - 3) // 3
    assert set(whole.landmarks) == set(trial.landmark[: trial.first[30]].tolist())
    assert set(state.large.landmarks) & set(state.small.landmarks)
    errors = [gaussian.mean - trial.landmarks[label] for label, gaussian in filter_.map(state).items()]
    assert np.linalg.norm(errors, axis=1).max() < 1.0
