"""Errors that all estimates share, as of calibration, mounting and clock of the truth: no number averages them out.

Each error is e = J theta + n: theta, the same for all, has a prior, and n the stated covariance plus a floor, the
scatter of the truth. Both are fitted to some data by maximum likelihood, with theta integrated out, and predicted for
other data.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import optimize

from consistency.referee.errors import InputError
from consistency.referee.types import Array

LEAST, MOST = 1e-7, 1.0  # m and rad, standard deviations of the floor that are looked at


@dataclass(frozen=True, eq=False)
class SharedError:
    """What some data tell about the errors that all share."""

    mean: Array  # (m,), of theta
    covariance: Array  # (m, m)
    floor: Array  # (n,), standard deviations of the truth, in the units of the error

    def predict(self, J: Array, S: Array) -> tuple[Array, Array]:
        """Expected errors (N, n) of other estimates, and their covariances (N, n, n).

        Parameters
        ----------
        J : (N, n, m), derivative of each error by theta
        S : (N, n, n), stated covariances
        """
        shared = J @ self.covariance @ np.swapaxes(J, 1, 2)
        return J @ self.mean, S + shared + np.diag(self.floor**2)


def fit_shared(errors: Array, J: Array, S: Array, prior: Array) -> SharedError:
    """Shared errors and floor of highest likelihood.

    Parameters
    ----------
    errors : (N, n), against truth
    J : (N, n, m), derivative of each by what is shared
    S : (N, n, n), stated covariances
    prior : (m,), standard deviations of theta, whose mean is 0

    Raises
    ------
    InputError
        Fewer than 2 n errors, or shapes that do not fit.
    """
    N = errors.shape[0]
    n = errors.shape[-1]
    if errors.shape != (N, n) or J.shape != (N, n, len(prior)) or S.shape != (N, n, n):
        raise InputError(f"errors, J, S: shapes {errors.shape}, {J.shape}, {S.shape} do not fit")
    if 2 * n > N:
        raise InputError(f"errors: of {N} motions, at least {2 * n} are needed for a floor of {n} numbers")
    start = np.log(np.clip(errors.std(axis=0), 10.0 * LEAST, 0.1 * MOST))
    bounds = optimize.Bounds(np.full(n, np.log(LEAST)), np.full(n, np.log(MOST)))
    best = optimize.minimize(  # type: ignore[call-overload]  # the stubs do not know jac=True
        lambda x: posterior(np.exp(x), errors, J, S, prior)[2:], start, jac=True, method="L-BFGS-B", bounds=bounds
    )
    floor = np.exp(best.x)
    mean, covariance, *_ = posterior(floor, errors, J, S, prior)
    return SharedError(mean, covariance, floor)


def posterior(floor: Array, errors: Array, J: Array, S: Array, prior: Array) -> tuple[Array, Array, float, Array]:
    """Mean and covariance of what is shared; minus twice the log-likelihood, and its derivative by log floor.

    The errors (N, n) have the covariance V = C + J Pi J', with C that of each alone and Pi the prior.

    Parameters
    ----------
    floor : (n,), standard deviations
    J : (N, n, m)
    S : (N, n, n)
    prior : (m,), standard deviations
    """
    C = S + np.diag(floor**2)
    W = np.linalg.inv(C)
    WJ = W @ J
    H = np.einsum("nia,nib->ab", J, WJ) + np.diag(prior**-2.0)
    covariance = np.linalg.inv(H)
    mean = covariance @ np.einsum("nia,ni->a", WJ, errors)
    weighted = np.einsum("nij,nj->ni", W, errors - J @ mean)  # V^-1 e
    diagonal = np.einsum("nii->ni", W) - np.einsum("nia,ab,nib->ni", WJ, covariance, WJ)  # of V^-1
    volume = np.linalg.slogdet(C)[1].sum() + np.linalg.slogdet(H * np.outer(prior, prior))[1]
    slope = 2.0 * floor**2 * (diagonal - weighted**2).sum(axis=0)
    return mean, covariance, float((errors * weighted).sum() + volume), slope
