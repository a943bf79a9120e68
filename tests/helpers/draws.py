"""Errors whose stated covariance is the identity, drawn in worlds that differ in how steps depend on each other."""

import numpy as np
from scipy import stats

from consistency.diagnostics import Settings, judge, make_record


def independent(rng, runs, steps, n):
    return rng.standard_normal((runs, steps, n))


def autoregression(rng, runs, steps, n, coefficient=0.95):
    white = rng.standard_normal((runs, steps, n))
    error = white.copy()
    for k in range(1, steps):
        error[:, k] = coefficient * error[:, k - 1] + np.sqrt(1.0 - coefficient**2) * white[:, k]
    return error


def fully_dependent(rng, runs, steps, n):
    """One error in all steps of a run: the worst case."""
    return np.repeat(rng.standard_normal((runs, 1, n)), steps, axis=1)


def slow_axis(rng, runs, steps, n):
    """The first component is one error in all steps of a run, the others are independent."""
    error = rng.standard_normal((runs, steps, n))
    error[..., 0] = rng.standard_normal((runs, 1))
    return error


def identities(error):
    n = error.shape[-1]
    return np.broadcast_to(np.eye(n), (*error.shape, n))


def verdict_on(error, covariance=None, **settings):
    """The verdict on errors with covariance I, or the one given."""
    return judge(make_record("f", error, identities(error) if covariance is None else covariance), Settings(**settings))


def errs_at_most(rate, draws, errs, sure=1e-5):
    """Whether errors are as rare as stated: each of the kinds that a draw of ``errs`` tells of is counted.

    A rate as stated is refused with a chance of at most ``sure`` a kind. Ends after a fifth of the draws, or after two,
    three or four, where no count lies above its expectation. That refuses nothing, and lets a rate of 13 % for the 5 %
    that are stated pass 7 times in 1,000 more often, with 500 draws.
    """
    count = np.zeros(1)
    for done in range(1, draws + 1):
        count = count + np.atleast_1d(errs())
        if done % (draws // 5) == 0 and count.max() <= rate * done:
            return True
    return bool(count.max() <= stats.binom.isf(sure, draws, rate))
