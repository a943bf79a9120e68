"""
Coverage: how many errors lie within k sigma
============================================

Errors of three estimators with the same stated covariance. The curve of an honest one follows that of a Gaussian; a
covariance too small leaves too many errors outside; of heavy tails many are inside small bounds and a few outside large
ones.
"""

import matplotlib.pyplot as plt
import numpy as np
from scipy import stats

from consistency.diagnostics import coverage

rng = np.random.default_rng(101)
shape = (40, 200, 2)  # runs, steps, axes
P = np.broadcast_to(np.diag([0.04, 0.01]), (*shape, 2))
sigma = np.sqrt([0.04, 0.01])
estimators = {
    "honest": sigma * rng.normal(size=shape),
    "covariance too small by x2": sigma * np.sqrt(2) * rng.normal(size=shape),
    "heavy tails": sigma * rng.standard_t(3, shape) / np.sqrt(3),  # of the stated variance
}

figure, axes = plt.subplots(figsize=(7.2, 3.2), layout="constrained")
bounds = np.linspace(0, 4, 41)
axes.plot(bounds, 2 * stats.norm.cdf(bounds) - 1, color="0.6", lw=6, label="Gaussian")
for (name, errors), dashes in zip(estimators.items(), ("-", "--", ":"), strict=True):
    share = [coverage(errors, P, bound)[0] for bound in bounds]  # of the first axis
    axes.plot(bounds, share, dashes, lw=1.5, label=name)
axes.set(xlabel="bound, stated standard deviations", ylabel="share of errors inside", xlim=(0, 4), ylim=(0, 1.02))
axes.legend(loc="lower right")
