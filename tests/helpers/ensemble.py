"""An ensemble Kalman filter with the gain of the Kalman filter: right in a linear world, for any number of members."""

from dataclasses import replace

import numpy as np

import consistency as cs
from consistency.bench.filters.textbook import basics

MEMBERS = 2


class Ensemble:
    """Each member is a Kalman filter on controls and observations to which noise of their covariance is added.

    A member is then a draw from N(m, P), where m and P are those of the Kalman filter. The mean of n members has errors
    of covariance P + P / n. With ``own_seed`` the filter brings a generator of its own, as one without ``problem.rng``.
    """

    name = "my-enkf"

    def __init__(self, own_seed=None):
        self.member = cs.get_filter("kf").textbook
        self.own = None if own_seed is None else np.random.default_rng(own_seed)

    def init(self, problem):
        return [self.member.init(problem)] * MEMBERS, self.own or problem.rng

    def predict(self, state, control):
        members, rng = state
        believed = members[0].problem.belief.motion
        _, G = basics.motion_jacobians(members[0].points, control)
        moved = []
        for member in members:
            after = self.member.predict(member, control)
            after.x[:3] += G @ (rng.normal(size=2) * [believed.sigma_v, believed.sigma_omega])
            moved.append(after)
        return moved, rng

    def update(self, state, observation):
        members, rng = state
        sigma = np.array(members[0].problem.belief.sensor.sigma)
        noisy = (replace(observation, z=observation.z + sigma * rng.normal(size=observation.z.shape)) for _ in members)
        return ([self.member.update(one, z)[0] for one, z in zip(members, noisy, strict=True)], rng), None

    def pose(self, state):
        members, _ = state
        mean = np.mean([member.x[:3] for member in members], axis=0)
        return cs.Gaussian(mean, members[0].P[:3, :3] * (1 + 1 / MEMBERS))
