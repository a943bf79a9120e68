"""Maximum likelihood of the covariances of Gaussian errors, by scoring."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import optimize

from consistency.referee.types import Array

STEPS, SHORTEST = 100, 5e-4  # of scoring, and the part of a step that is tried last


class Score(NamedTuple):
    """Log likelihood of p parameters but for its constant, and its derivatives."""

    value: float
    gradient: Array  # (p,)
    information: Array  # (p, p), expected


def solved(A: Array, b: Array) -> Array:
    """x of A x = b, of matrices A (..., n, n) and vectors b (..., n)."""
    return np.linalg.solve(A, b[..., None])[..., 0]


def nees_of(error: Array, C: Array) -> Array:
    """e' C^-1 e of errors (K, n) and covariances (K, n, n), (K,)."""
    return np.asarray((error * solved(C, error)).sum(axis=1))


def log_densities(error: Array, C: Array) -> Array:
    """Log density of each error (K, n) with its covariance (K, n, n), (K,)."""
    _, log_determinant = np.linalg.slogdet(2.0 * np.pi * C)
    return np.asarray(-0.5 * (nees_of(error, C) + log_determinant))


def score_of(error: Array, C: Array, F: Array) -> Score:
    """Score of Gaussian errors (K, n) with covariances C (K, n, n), whose derivatives are F (K, p, n, n)."""
    inverse = np.linalg.inv(C)
    u = (inverse @ error[..., None])[..., 0]
    G = inverse[:, None] @ F
    flat = G.reshape(*G.shape[:2], -1)
    turned = np.swapaxes(G, -1, -2).reshape(flat.shape)
    _, log_determinant = np.linalg.slogdet(C)
    value = -0.5 * float((error * u).sum() + log_determinant.sum())
    squares = np.einsum("ki,kpij,kj->p", u, F, u, optimize=True)
    gradient = 0.5 * (squares - np.einsum("kpii->p", G))
    information = 0.5 * np.tensordot(flat, turned, ((0, 2), (0, 2)))
    return Score(value, gradient, information)


def maximise(
    score: Callable[[Array], Score],
    theta: Array,
    least: Array | float,
    close: float,
) -> Array:
    """Parameters (p,) of at least ``least``, at least 0, with the largest likelihood.

    Each step solves the equations of the score with theta >= 0 (Lawson & Hanson 1974), and is halved until the
    likelihood grows. It ends where that gains less than ``close``.
    """
    here = score(theta)
    for _ in range(STEPS):
        target = np.maximum(nonnegative(here.information, here.gradient + here.information @ theta), least)
        step, gain = 1.0, -np.inf
        while gain < 0 and step >= SHORTEST:
            trial = theta + step * (target - theta)
            there = score(trial)
            gain = there.value - here.value
            step *= 0.5
        if gain > 0:
            theta, here = trial, there
        if gain < close:
            break
    return theta


def nonnegative(H: Array, g: Array) -> Array:
    """The minimum of x'Hx / 2 - g'x with x >= 0."""
    scale = np.sqrt(np.maximum(np.diag(H), 1e-300))
    values, vectors = np.linalg.eigh(H / np.outer(scale, scale))
    root = np.sqrt(np.maximum(values, 1e-9))
    target = (vectors.T @ (g / scale)) / root
    least, _ = optimize.nnls(root[:, None] * vectors.T, target)
    return np.asarray(least / scale)
