"""A planar robot on a circle, with odometry, that sees one of three known landmarks in every fifth step."""

import gtsam
import numpy as np

STEPS, FIRST, MOTION = 56, gtsam.Pose2(0, 0, 0), gtsam.Pose2(1.0, 0.0, 0.2)
START, ODOMETRY, SEEN = [0.1] * 3, [0.05] * 3, [0.01, 0.05]  # deviations, m and rad; of bearing and range
MARK, LANDMARKS = 1000, np.array([[0.0, 12.0], [12.0, 3.0], [-8.0, 4.0]])  # key of the first; m, known


def sigmas(values):
    return gtsam.noiseModel.Diagonal.Sigmas(np.array(values, float))


def simulate(rng, runs):
    """The last pose, and the factors of each step: a prior, odometry, and a landmark in every fifth step."""
    draws = []
    for _ in range(runs):
        pose = FIRST.retract(rng.normal(0, START))
        marks = [gtsam.PriorFactorPoint2(MARK + j, mark, sigmas([1e-6] * 2)) for j, mark in enumerate(LANDMARKS)]
        steps = [[gtsam.PriorFactorPose2(0, FIRST, sigmas(START)), *marks]]
        for k in range(1, STEPS):
            pose, measured = pose.compose(MOTION), MOTION.retract(rng.normal(0, ODOMETRY))
            steps.append([gtsam.BetweenFactorPose2(k - 1, k, measured, sigmas(ODOMETRY))])
            if k % 5 == 0:
                j, (b, r) = k // 5 % len(LANDMARKS), rng.normal(0, SEEN)
                seen = gtsam.Rot2(pose.bearing(LANDMARKS[j]).theta() + b), pose.range(LANDMARKS[j]) + r
                steps[-1].append(gtsam.BearingRangeFactor2D(k, MARK + j, *seen, sigmas(SEEN)))
        draws.append((pose, steps))
    return draws
