"""Have the errors of GTSAM's iSAM2 the size of its marginals with default thresholds? The last of 56 planar poses."""

import functools
import operator

import gtsam
import numpy as np
from planar_scene import FIRST, LANDMARKS, MARK, STEPS, simulate
from study import Case


def graph(factors):
    out = gtsam.NonlinearFactorGraph()
    for factor in factors:
        out.add(factor)
    return out


def estimated(draws, more=0, batch=False):
    errors, covariances = [], []
    for true, steps in draws:
        isam, last = gtsam.ISAM2(), FIRST
        for k, factors in enumerate(steps):
            values = gtsam.Values()
            values.insert(k, last.compose(factors[0].measured()) if k else FIRST)
            for j, mark in enumerate(LANDMARKS if k == 0 else ()):
                values.insert(MARK + j, mark)
            isam.update(graph(factors), values)
            last = isam.calculateEstimatePose2(k)
        for _ in range(more):
            isam.update()
        found, marginals = isam.calculateEstimate(), isam
        if batch:
            whole = graph(functools.reduce(operator.iadd, steps, []))
            found = gtsam.LevenbergMarquardtOptimizer(whole, found).optimize()
            marginals = gtsam.Marginals(whole, found)
        errors.append(found.atPose2(STEPS - 1).localCoordinates(true))
        covariances.append(marginals.marginalCovariance(STEPS - 1))
    return np.array(errors), np.array(covariances)


def control(draws):
    return {"14 more updates": estimated(draws, more=14), "batch": estimated(draws, batch=True)}


AXES = "forward", "left", "heading"
CASE = Case("gtsam", AXES, 200, simulate, lambda draws: {"one update a step": estimated(draws)}, control)

if __name__ == "__main__":
    CASE.main()
