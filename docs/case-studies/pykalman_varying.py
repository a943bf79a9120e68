"""Have the errors of pykalman's filter and smoother the stated covariance, where each step has a Q of its own?"""

from dataclasses import replace

import numpy as np
from linear import AXES, H, Model
from pykalman import KalmanFilter
from study import Case

DT = np.where(np.arange(59) % 5 == 4, 2.0, 0.2)  # s
F = np.array([[[1, dt], [0, 1]] for dt in DT])
Q = np.array([0.1 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]) for dt in DT])
MODEL = Model(F, Q, 0.5, np.eye(2))
KF = KalmanFilter(
    transition_matrices=F, transition_covariance=Q, observation_matrices=H, observation_covariance=[[MODEL.R]],
    initial_state_mean=np.zeros(2), initial_state_covariance=MODEL.P0,
)  # fmt: skip


def step_by_step(z):
    """The library's filter_update with F and Q of each step, after a first measurement."""
    K = MODEL.P0 @ H.T / (H @ MODEL.P0 @ H.T + MODEL.R)
    steps = [((K * z[0]).ravel(), MODEL.P0 - K @ H @ MODEL.P0)]
    for each, F_k, Q_k in zip(z[1:], F, Q, strict=True):
        steps.append(KF.filter_update(*steps[-1], each, F_k, None, Q_k))
    return zip(*steps, strict=True)


def rows(data, estimate):
    means, covariances = zip(*(map(np.array, estimate(run)) for run in data[1]), strict=True)
    return data[0] - means, np.array(covariances)


def simulate(rng, runs):
    return (*MODEL.simulate(rng, runs), rng.integers(2**31, size=runs))


def judged(data):
    samples = [KF.sample(MODEL.steps, random_state=int(seed)) for seed in data[2]]
    sampled = np.array([x for x, _ in samples]), np.array([z.ravel() for _, z in samples])
    return {"filter": rows(data, KF.filter), "smooth": rows(data, KF.smooth), "sample": rows(sampled, step_by_step)}


def control(data):
    return {"filter_update": rows(data, step_by_step)}


def second():
    first = replace(MODEL, Q=np.array([Q[0]] * len(Q)))  # the first matrix in all steps
    return [
        *MODEL.exact("filter", lambda data: rows(data, KF.filter)),
        *MODEL.exact("smooth", lambda data: rows(data, KF.smooth)),
        *first.exact("sample", lambda data: rows(data, step_by_step)),
    ]


CASE = Case("pykalman", AXES, 117, simulate, judged, control, second)

if __name__ == "__main__":
    CASE.main()
