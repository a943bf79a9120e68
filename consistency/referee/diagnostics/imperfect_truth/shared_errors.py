"""Errors that all estimates share, as of calibration, mounting and clock of the truth: no number averages them out.

Each error is e = J theta + n: theta, the same for all, has a prior, and n the stated covariance plus a floor, the
scatter of the truth. Both are fitted to some data by maximum likelihood, with theta integrated out, and predicted for
other data.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import optimize

from consistency.referee.diagnostics.records.record import Record, arrays_of
from consistency.referee.diagnostics.verdict.answers import BIAS
from consistency.referee.errors import InputError
from consistency.referee.types import Array

LEAST, MOST = 1e-7, 1.0  # m and rad, standard deviations of the floor that are looked at
KINDS = ("by-vector", "by-time", "by-distance")
VAGUE = 100.0  # prior deviation of what is shared, over what explains all of the errors


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
    N, n = errors.shape[0], errors.shape[-1]
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


# --- records ----------------------------------------------------------------------------------------------


def growth(record: Record, kind: str) -> Array:
    """What the shared vector is multiplied by in each step, (runs, steps): 1, or s or m since the run began.

    Raises
    ------
    InputError
        The record has no errors, no times, or no true path.
    """
    if record.error is None or record.covariance is None or record.parts:
        raise InputError(f"--shared: needs errors with covariances of all components; {record.name} has none")
    shape = record.error.shape[:2]
    if kind == "by-vector":
        return np.ones(shape)
    if record.window is not None:
        raise InputError(
            f"--shared {kind}: windows of {record.window} are alike; take by-vector, a vector for each window"
        )
    if kind == "by-time":
        t = np.broadcast_to(record.t, shape) if record.times is None else record.times
        if not np.isfinite(t).any():
            raise InputError(f"--shared by-time: {record.name} has no times")
        return np.asarray(t - np.nanmin(t, axis=1, keepdims=True))
    if record.path is None:
        raise InputError(f"--shared by-distance: {record.name} has no positions")
    steps = np.linalg.norm(np.diff(record.path[:, :, 0], axis=1), axis=-1)
    return np.concatenate([np.zeros((shape[0], 1)), np.cumsum(np.nan_to_num(steps), axis=1)], axis=1)


def fit_record(record: Record, kind: str) -> SharedError:
    """What the errors of a record share: one vector, times :func:`growth`.

    Steps of a run depend on each other: its mean is as certain as one of them is, unless they are independent.

    Raises
    ------
    InputError
        As :func:`growth` and :func:`fit_shared`.
    """
    e, P, g = _steps(record, kind)
    n = e.shape[1]
    prior = VAGUE * np.maximum(np.sqrt((e**2).mean(axis=0)), LEAST) / np.sqrt((g**2).mean())
    fit = fit_shared(e, g[:, None, None] * np.eye(n), P, prior)
    together = 1.0 if record.independent else len(e) / max(len(record.run_numbers), 1)
    return replace(fit, covariance=together * fit.covariance)


def without_shared(record: Record, fit: SharedError, kind: str) -> Record:
    """The record without the errors that another shares with it, and with what they leave uncertain in its covariance.

    What is left of them is in all runs, so that a bias is not asked.
    """
    g = growth(record, kind)
    n = len(fit.floor)
    error, P = np.asarray(record.error, float), np.asarray(record.covariance, float)
    if error.shape[-1] != n:
        raise InputError(f"--shared: {record.name} has {error.shape[-1]} components, what is shared has {n}")
    added = np.square(g)[..., None, None] * fit.covariance + np.diag(fit.floor**2)
    return replace(
        record, error=error - g[..., None] * fit.mean, covariance=P + added, nees=None,
        unavailable=(*record.unavailable, *BIAS),
    )  # fmt: skip


def halves(record: Record) -> tuple[Record, Record]:
    """Two records, of the first and the last runs, or steps where there is one run.

    Raises
    ------
    InputError
        The only run failed.
    """
    runs = len(record.run_numbers)
    if runs > 1:
        return record.of_runs(slice(runs // 2)), record.of_runs(slice(runs // 2, None))
    if record.failures:
        raise InputError(f"--shared: {record.name} failed in step {record.failures[0].step}; give --shared-from")
    assert record.error is not None
    middle = record.error.shape[1] // 2
    return _some(record, slice(middle)), _some(record, slice(middle, None))


def _some(record: Record, steps: slice) -> Record:
    """Some steps of the arrays that are judged."""
    arrays: dict[str, Any] = {name: np.asarray(array)[:, steps] for name, array in arrays_of(record).items()}
    return replace(record, **arrays, t=record.t[steps] if len(record.t) else record.t)


def _steps(record: Record, kind: str) -> tuple[Array, Array, Array]:
    """Errors (N, n), covariances and growth of the steps that are judged."""
    g = growth(record, kind)
    error, P = np.asarray(record.error, float), np.asarray(record.covariance, float)
    there = np.isfinite(error).all(axis=-1) & np.isfinite(P).all(axis=(-2, -1)) & (g > 0)
    if not there.any():
        raise InputError(f"--shared {kind}: {record.name} has no step in which anything has grown")
    return error[there], P[there], g[there]
