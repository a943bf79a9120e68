"""Errors that all estimates share: fitted to some, and predicted for others."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import block_diag

from consistency.referee.diagnostics.uncertain_truth import fit_shared_error
from consistency.referee.errors import InputError

N, SIZE = 480, 3
P = np.array([[0.04, 0.01, 0.0], [0.01, 0.09, -0.01], [0.0, -0.01, 0.02]])
FLOOR = np.array([0.1, 0.2, 0.05])
THETA = np.array([0.5, -0.3, 0.2])
PRIOR = np.full(SIZE, 30.0)


def drawn(rng, count=N):
    """Errors with a shared part that grows, of the covariance P and a floor; its derivatives, and P of each."""
    J = np.linspace(0.5, 2.0, count)[:, None, None] * np.eye(SIZE)
    noise = rng.normal(size=(count, SIZE)) @ np.linalg.cholesky(P + np.diag(FLOOR**2)).T
    return J @ THETA + noise, J, np.tile(P, (count, 1, 1))


def test_what_is_shared_is_found_and_predicted(rng):
    """6 standard deviations of theta (3 numbers: chance 1e-8); a floor of 480 errors to 6 x 3 %."""
    fit = fit_shared_error(*drawn(rng), PRIOR)
    off = fit.mean - THETA
    assert off @ np.linalg.solve(fit.covariance, off) < 45.0
    assert_allclose(np.diag(P) + fit.floor**2, np.diag(P) + FLOOR**2, rtol=0.4)
    _, J, S = drawn(rng, 1)
    bias, covariance = fit.predict(J, S)
    assert_allclose(bias[0], 0.5 * fit.mean)
    assert_allclose(covariance[0], P + 0.25 * fit.covariance + np.diag(fit.floor**2))


def test_the_fit_is_that_of_the_whole_gaussian(rng):
    """Theta given all errors by the joint covariance of everything, with the fitted floor."""
    errors, J, S = drawn(rng, 20)
    fit = fit_shared_error(errors, J, S, PRIOR)
    root = np.linalg.inv(np.linalg.cholesky(block_diag(*(S + np.diag(fit.floor**2)))))
    Q, R = np.linalg.qr(np.vstack([root @ J.reshape(-1, SIZE), np.diag(1.0 / PRIOR)]))
    mean = np.linalg.solve(R, Q[: errors.size].T @ root @ errors.ravel())
    assert_allclose(fit.mean, mean, rtol=1e-7, atol=1e-9)
    inverse = np.linalg.inv(R)
    assert_allclose(fit.covariance, inverse @ inverse.T, rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("count, size, said", [(5, SIZE, "of 5 motions, at least 6 are needed"), (8, 2, "do not fit")])
def test_too_few_errors_and_wrong_shapes_are_refused(rng, count, size, said):
    errors, J, S = drawn(rng, count)
    with pytest.raises(InputError, match=said):
        fit_shared_error(errors, J, S[:, :size, :size], PRIOR)
