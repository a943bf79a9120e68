"""Which directions of the state a filter's own Jacobians leave unobserved over a trial, by singular values.

M stacks H F ... F of all steps, Huang, Mourikis & Roumeliotis (2010); a landmark's first observation counts. Robot and
map together can be shifted in the plane and turned, and no observation tells; heights are observed, because that of
the robot is known. So three singular values of M are zero unless the filter gains information that is not there.
"""

from dataclasses import replace

import numpy as np
import pytest

import consistency as cs
from consistency.bench.filters.filter_inputs import problem_for
from consistency.bench.types import Observation

WORLDS = {"xyz": "herath2007-xyz", "uvd": "herath2007-wide-baseline"}
ZERO, CLEAR = 1e-13, 1e-6  # singular values, relative to the largest


def of_the_robot(state, block):
    """The state with a covariance of the robot and none of the map."""
    P = np.zeros_like(state.P)
    P[:3, :3] = block
    return replace(state, P=P)


def motion_jacobian(twin, state, control):
    """F (3, 3), from what it makes of two covariances."""
    noise, all_ = (twin.predict(of_the_robot(state, P), control).P for P in (np.zeros((3, 3)), np.eye(3)))
    square, F = (all_ - noise)[:3, :3], np.eye(3)
    F[:2, 2] = square[:2, 2]
    assert np.allclose(F @ F.T, square, rtol=0, atol=1e-12)
    return F


def split(state, observation):
    """What is seen of landmarks in the state, and of new ones."""
    known = np.isin(observation.landmarks, state.landmarks)
    old, new = (Observation(observation.landmarks[rows], observation.z[rows]) for rows in (known, ~known))
    return old, new


def observability_matrix(twin, trial, belief):
    """M over all landmarks of the trial, a row for each number that was observed."""
    state, Phi, blocks = twin.init(problem_for(twin, trial, belief)), np.eye(3), []
    for k in range(1, trial.steps + 1):
        Phi = motion_jacobian(twin, state, trial.control(k)) @ Phi
        state = twin.predict(state, trial.control(k))
        old, new = split(state, trial.observation(k))
        _, info = twin.update(replace(state, P=np.eye(len(state.x))), old)
        H = (info.gain @ info.S).T  # P H' with P = I
        state, n = twin.update(state, old)[0], len(state.x)
        blocks.append(np.hstack([H[:, :3] @ Phi, H[:, 3:]]))
        if len(new.landmarks):
            Jp = twin.update(of_the_robot(state, np.eye(3)), new)[0].P[n:, :3]
            blocks.append(np.hstack([-Jp @ Phi, np.zeros((len(Jp), n - 3)), np.eye(len(Jp))]))
            state = twin.update(state, new)[0]
    width = len(state.x)
    return np.vstack([np.pad(block, ((0, 0), (0, width - block.shape[1]))) for block in blocks])


def unobserved(name, scenario):
    """How many directions of robot and map M leaves at zero; all others are clearly not."""
    M = observability_matrix(cs.get_filter(name).textbook, cs.simulate(scenario, run=3), scenario.belief)
    assert M.shape[0] > M.shape[1] > 30
    values = np.linalg.svd(M, compute_uv=False)
    zero = values < ZERO * values[0]
    assert np.all(zero | (values > CLEAR * values[0]))
    return int(zero.sum())


@pytest.mark.parametrize("method, directions", [("ekf", 2), ("fej-ekf", 3), ("oc-ekf", 3), ("ideal-ekf", 3)])
@pytest.mark.parametrize("sensor", ["xyz", "uvd"])
def test_unobserved_directions(small, tilted, method, sensor, directions):
    """Three where the filter is a remedy; the EKF believes that it sees the heading."""
    scenario = small(WORLDS[sensor], truth__sensor__mount=tilted, belief__sensor__mount=tilted)
    assert unobserved(f"{method}-{sensor}", scenario) == directions
