"""A target whose process noise jumps between two sizes, and the textbook's filters for it."""

import numpy as np
from linear import STEADY, STEPS

F, R, KNOWN = STEADY.F[0], STEADY.R, (np.zeros(2), np.eye(2))
MODES = np.array([1.0, 9.0])[:, None, None] * STEADY.Q[0]  # Q of each
M, START = np.array([[0.97, 0.03], [0.03, 0.97]]), np.array([0.5, 0.5])  # of the chain of modes


def simulate(rng, runs):
    """Modes of the noise that leads to each step, states, and measurements of the position."""
    switch = np.column_stack([rng.random(runs) < START[1], rng.random((runs, STEPS - 1)) < M[0, 1]])
    modes, x, truth = np.cumsum(switch, axis=1) % 2, rng.normal(size=(runs, 2)), []
    for mode in modes.T:
        x = x @ F.T + np.einsum("rij,rj->ri", np.linalg.cholesky(MODES)[mode], rng.normal(size=(runs, 2)))
        truth.append(x)
    truth = np.swapaxes(truth, 0, 1)
    return modes, truth, truth[..., 0] + rng.normal(0, R**0.5, modes.shape)


def step(m, P, z, Q):
    """Mean and covariance of a Kalman filter, and the likelihood of z up to a constant."""
    m, P = F @ m, F @ P @ F.T + Q
    S, r = P[0, 0] + R, z - m[0]
    return m + P[:, 0] / S * r, P - np.outer(P[:, 0], P[0]) / S, np.exp(-0.5 * r * r / S) / S**0.5


def merged(w, xs, Ps):
    """Mean and covariance of a mixture of two Gaussians with weights ``w``."""
    return w @ xs, np.tensordot(w, Ps, 1) + np.cov(xs.T, aweights=w, ddof=0)


def told(modes, run):
    """A filter that is told the modes, which is exact; means and covariances of each step."""
    m, P = KNOWN
    for mode, z in zip(modes, run, strict=True):
        m, P, _ = step(m, P, z, MODES[mode])
        yield m, P


def interacting(_, run):
    """Interacting multiple models, Blom & Bar-Shalom (1988)."""
    w, xs, Ps = START, *(np.array([each] * 2) for each in KNOWN)
    for z in run:
        c = w @ M
        found = [step(*merged(M[:, j] * w / c[j], xs, Ps), z, Q) for j, Q in enumerate(MODES)]
        xs, Ps, likelihood = (np.array(each) for each in zip(*found, strict=True))
        w = c * likelihood / (c @ likelihood)
        yield merged(w, xs, Ps)
