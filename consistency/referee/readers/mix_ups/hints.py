"""Hints on mix-ups in files with impossible errors: a unit, order, side or frame that makes the covariance fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from consistency.referee.diagnostics.records.validity import Validity, classify
from consistency.referee.diagnostics.records.whitening import whiten
from consistency.referee.diagnostics.statistics import distributions
from consistency.referee.readers.truth_matching import Poses
from consistency.referee.types import Array

if TYPE_CHECKING:
    from consistency.referee.readers.mix_ups.known import Guess

MOST = 4000  # estimates that are looked at, of all runs together
MOST_RUNS = 200  # that are looked at, evenly over all
MOST_FITTED = 1000  # of which so many are, where less than a decade is wrong
WRONG = 1.0  # decades that the NEES is off, from which a mix-up is looked for
APART = 2.0  # the same of a single component: one run that is off by a constant says little of it
RIGHT = 0.4  # decades that it may be off with the mix-up undone
LEAST_GAIN = float(np.log(1e4))  # log likelihood that a reading gains over simple faults, and as much as it has rivals
ROUNDING, NEGLIGIBLE, NEARLY_ALL = 1e-6, 1e-3, 0.99  # of values, of sigma, of estimates: errors of a file with itself
ALIKE = 0.01  # decades between guesses of which the likelier is named
NEAR, SHARP, LEAST = 5.0, 0.5, 3  # sigmas, rad, steps: an error of an angle, but for whole turns


def hints(name: str, axes: Sequence[str], runs: Sequence[Poses], shift: float = 0.0) -> list[str]:
    """Hints on a probable mix-up, where the covariance does not fit and one other reading of the files does; or none.

    Where the NEES of a median estimate is off by a decade or more, the guess that brings it nearest to a right one is
    named. Where it is off by less, a guess is named if all errors then agree with the covariance, and no simple fault
    of a filter explains as much (:mod:`consistency.referee.readers.mix_ups.hints`).
    """
    if not runs:
        return []
    runs = runs[:: -(-len(runs) // MOST_RUNS)]
    some = [poses.later(shift).some(max(MOST // len(runs), 20)).sound() for poses in runs]
    if _same(some):
        return [
            f"{name}: the errors are 0 to rounding, so that truth and estimates seem to be the same file or copies of "
            "one; give the true poses as the truth"
        ]
    off = decades(some)
    limit = np.append(WRONG, np.full(len(off) - 1, APART))
    worst = int(np.argmax(np.abs(off) / limit))
    gross = bool(abs(off[worst]) > limit[worst])
    if gross and (best := _gross(_guesses(some, axes), some)) is not None:
        return [f"{name}: the NEES{_of(axes, worst)} is {_times(off[worst])}, but about right if {best.text}"]
    some = [poses.some(max(MOST_FITTED // len(runs), 20)) for poses in some]
    declared = fit_of(some)
    if declared is None:
        return []
    if not gross and declared.size * declared.fault() < LEAST_GAIN:
        return []
    guesses = _guesses(some, axes)
    best = _fine(guesses, some, declared)
    if best is None:
        return []
    worst = int(np.argmax(np.abs(off)))
    return [
        f"{name}: the NEES{_of(axes, worst)} is {_times(off[worst])}, and no single factor explains the errors, but "
        f"all would be consistent if {best.text}"
    ]


def _guesses(runs: Sequence[Poses], axes: Sequence[str]) -> list[Guess]:
    from consistency.referee.readers.mix_ups.known import guesses_of  # few files need them

    return guesses_of(runs, axes)


def _of(axes: Sequence[str], worst: int) -> str:
    return "" if worst == 0 else f" of {axes[worst - 1]} by itself"


def _times(off: float) -> str:
    return f"{10.0 ** abs(off):.2g} times too {'large' if off > 0 else 'small'}"


def _same(runs: Sequence[Poses]) -> bool:
    """Whether the errors are rounding in nearly all estimates, in values and beside their standard deviations."""
    same = total = 0
    for p in runs:
        error, known = np.abs(p.errors()), p.known().rows
        with np.errstate(invalid="ignore"):
            sigma = np.sqrt(np.diagonal(p.covariance, axis1=1, axis2=2))[known]
            rounding = ROUNDING * max(1.0, float(np.abs(p.truth).max(initial=0.0)))
            same += int(((error[known] <= rounding) & (error[known] <= NEGLIGIBLE * sigma)).all(axis=1).sum())
        total += len(known)
    return total >= LEAST and same >= NEARLY_ALL * total


def _gross(guesses: Sequence[Guess], some: Sequence[Poses]) -> Guess | None:
    """The guess with which the NEES of a median estimate is nearest to a right one, if it is near."""
    left = np.array([np.abs(decades([guess.change(poses) for poses in some])).max() for guess in guesses])
    first = np.where([guess.last for guess in guesses], np.nan, left)
    left = first if np.nanmin(first) < RIGHT else left
    if not np.nanmin(left) < RIGHT:
        return None
    return guesses[int(np.flatnonzero(left <= np.nanmin(left) + ALIKE)[0])]


def _fine(guesses: Sequence[Guess], some: Sequence[Poses], declared: ReadingFit) -> Guess | None:
    """The likeliest guess with which everything is right, where no simple fault is nearly as likely."""
    guesses = [guess for guess in guesses if guess.fine]
    bar, simple, found = LEAST_GAIN + np.log(max(len(guesses), 1)), declared.simple(), []
    errors = np.concatenate([poses.errors() for poses in some])
    for guess in guesses:
        read = [guess.change(poses) for poses in some]
        if any(new.truth is not old.truth for new, old in zip(read, some, strict=True)):
            continue  # a density of the truth in another unit is no likelier
        same = all(
            new.estimate is old.estimate and new.convention == old.convention
            for new, old in zip(read, some, strict=True)
        )
        fit = fit_of(read, errors if same else None)
        if fit is None or len(fit.w) < len(declared.w) or declared.size * (fit.likelihood - simple) < bar:
            continue
        gain = min(fit.size, declared.size) * (fit.likelihood - simple)
        if gain >= bar and fit.right():
            found.append((gain, guess))
    most = max((gain for gain, _ in found), default=0.0)
    return next((guess for gain, guess in found if gain >= most - 1.0), None)  # nearly as likely: the first


def turns(name: str, axes: Sequence[str], error: Array, covariance: Array, remedy: str) -> list[str]:
    """Components of errors (runs, steps, n) that look like angles: their large errors are whole turns."""
    found = []
    in_degrees = 360.0, "360", np.rad2deg(SHARP), "wrap it to [-180, 180]"
    for turn, by, sharp, how in ((2.0 * np.pi, "2 pi", SHARP, remedy), in_degrees):
        with np.errstate(invalid="ignore"):
            sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
            far = (np.abs(error) > 0.5 * turn) & (np.abs(error) > 2.0 * NEAR * sigma) & (NEAR * sigma < sharp)
            home = np.abs(error - turn * np.round(error / turn)) <= NEAR * sigma
        for k, axis in enumerate(axes):
            jumps = int(far[..., k].sum())
            if jumps >= LEAST and home[..., k][far[..., k]].all():
                steps = f"{jumps} of {int(np.isfinite(error[..., k]).sum())} steps"
                found.append(f"{name}: the error of {axis} is off by {by} in {steps}, as that of an angle; {how}")
    return found


def decades(runs: Sequence[Poses]) -> Array:
    """log10 of the median NEES over that of chi-square, of all n components and of each alone, (1 + n,).

    NaN without any.
    """
    n = runs[0].covariance.shape[-1]
    found = []
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for poses in runs:
            error, P = poses.errors(), poses.covariance
            own = np.square(error) / np.diagonal(P, axis1=1, axis2=2)
            found.append(np.column_stack([np.square(whiten(error, P)).sum(axis=1), own]))
    nees = np.concatenate(found)
    nees = nees[np.isfinite(nees).all(axis=1)]
    if not len(nees):
        return np.full(1 + n, np.nan)
    right = distributions.chi2.ppf(0.5, np.append(n, np.ones(n)))
    return np.asarray(np.log10(np.maximum(np.median(nees, axis=0), 1e-300) / right))


FACTOR = 6.0  # by which a wrong filter's covariance is off without a mix-up: the table of benchmarks/hints.py has 4
ODD = 1e-3  # chance that errors with the stated covariance are not taken for such
GROUPS = {3: ([0, 1],), 6: ([0, 1, 2], [3, 4, 5])}  # position and attitude, of poses


@dataclass(frozen=True)
class ReadingFit:
    """Errors of K estimates in n components under one reading; those that cannot be whitened are left out."""

    whitened: Sequence[Array]  # of each run, (k, n)
    root: Array  # (K, n, n), L^-1 of P = L L'
    error: Array  # (K, n)
    own: Array  # (K, n), errors over their standard deviations
    log_det: float  # of P, the mean

    @property
    def n(self) -> int:
        return int(self.error.shape[1])

    @cached_property
    def w(self) -> Array:
        """(K, n)."""
        return np.concatenate(self.whitened)

    @cached_property
    def likelihood(self) -> float:
        """Mean log likelihood of an estimate, but for a constant."""
        return -0.5 * (float(np.square(self.w).sum(axis=1).mean()) + self.log_det)

    @cached_property
    def size(self) -> float:
        """Effective number of independent estimates, for the scale.

        Squares of Gaussian errors with the autocorrelation rho have that of rho^2, so that K of them say as much as
        K / (1 + 2 sum (1 - l / k) rho_l^2) independent ones; the mean is 0 by assumption, and an error that is constant
        over a run counts once. Chance in the rho of a single run leaves down to a third of that. It is no more than the
        spread of the NEES over estimates, and over 8 or more runs, allows.
        """
        K, n = self.w.shape
        size = K / max(_memory(self.whitened, j) for j in range(n))
        nees = np.square(self.w).sum(axis=1) / n
        size *= min(1.0, 2.0 * float(nees.mean()) ** 2 / (n * max(float(nees.var()), 1e-300)))
        means = np.array([np.square(w).mean() for w in self.whitened])
        if len(means) >= 8 and means.std() > 0:
            size = min(size, 2.0 * float(means.mean()) ** 2 * len(means) / (n * float(means.var(ddof=1))))
        return max(float(size), 1.0)

    def right(self) -> bool:
        n, size = self.n, self.size
        ratios = np.append(np.square(self.own).mean(axis=0), np.square(self.w).mean())
        pairs = np.triu_indices(n, 1)
        asked = n + 1 + n + len(pairs[0]) + 1
        scale = np.append(np.full(n, size), n * size) * (ratios - np.log(np.maximum(ratios, 1e-300)) - 1.0)
        products = (self.w.T @ self.w / len(self.w))[pairs]
        below = float((np.square(self.w).sum(axis=1) < distributions.chi2.ppf(0.5, n)).mean())
        normal = np.concatenate([self.w.mean(axis=0), products, [2.0 * below - 1.0]]) * np.sqrt(size)
        limit = distributions.chi2.isf(ODD / asked, 1)
        return bool((scale <= limit).all() and (np.square(normal) <= limit).all())

    def fault(self) -> float:
        """Log likelihood of an estimate that another covariance, the same for all whitened errors, would gain."""
        M = self.w.T @ self.w / len(self.w)
        sign, log_det = np.linalg.slogdet(M)
        return 0.5 * float(np.trace(M) - (log_det if sign > 0 else -np.inf) - self.n)

    def simple(self) -> float:
        """Log likelihood of an estimate with the simple fault that explains the errors best.

        That is a bias, or a factor of at most ``FACTOR`` on the covariance of all components, of one, of position or of
        attitude.
        """
        n, w = self.n, self.w
        before = float(np.square(w).sum(axis=1).mean())
        shift = self.root @ self.error.mean(axis=0)
        best = 0.5 * float((2.0 * w * shift - shift**2).sum(axis=1).mean())
        f = np.exp(np.linspace(-np.log(FACTOR), np.log(FACTOR), 61))
        for group in [list(range(n)), *([j] for j in range(n)), *GROUPS.get(n, ())]:
            part = (self.root[:, :, group] @ self.error[:, group, None])[..., 0]
            a = f**-0.5 - 1.0
            after = before + 2.0 * a * float((w * part).sum(axis=1).mean()) + a**2 * float((part**2).sum(axis=1).mean())
            best = max(best, float((0.5 * (before - after - len(group) * np.log(f))).max()))
        return self.likelihood + best


def fit_of(runs: Sequence[Poses], errors: Array | None = None) -> ReadingFit | None:
    """Errors of some runs; None without any that can be whitened.

    ``errors`` (K, n) are those of all estimates, where they are known.
    """
    errors = np.concatenate([p.errors() for p in runs]) if errors is None else errors
    P = np.concatenate([p.covariance for p in runs])
    ends = np.cumsum([len(p.t) for p in runs])[:-1]
    with np.errstate(invalid="ignore"):
        variance = np.diagonal(P, axis1=1, axis2=2)
        good = np.isfinite(errors).all(axis=1) & np.isfinite(P).all(axis=(1, 2)) & (variance > 0).all(axis=1)
    if not good.any():
        return None
    sigma = np.sqrt(variance[good])
    R = P[good] / sigma[:, :, None] / sigma[:, None, :]
    try:
        L = np.linalg.cholesky(R)
    except np.linalg.LinAlgError:
        definite = classify(R) == Validity.VALID
        if not definite.any():
            return None
        good[good], sigma = definite, sigma[definite]
        L = np.linalg.cholesky(R[definite])
    error, root = errors[good], np.linalg.inv(L) / sigma[:, None, :]
    w = np.full(errors.shape, np.nan)
    w[good] = (root @ error[..., None])[..., 0]
    whitened = [part[np.isfinite(part).all(axis=1)] for part in np.split(w, ends)]
    log_det = 2.0 * (np.log(np.diagonal(L, axis1=1, axis2=2)).sum(axis=1) + np.log(sigma).sum(axis=1))
    return ReadingFit([part for part in whitened if len(part)], root, error, error / sigma, float(log_det.mean()))


def _memory(runs: Sequence[Array], axis: int) -> float:
    """1 + 2 sum over lags l of (1 - l / k) rho_l^2 of one component, over all runs; k is the longest of them."""
    k = max(map(len, runs))
    total, pairs = np.zeros(k), np.zeros(k)
    for run in runs:
        x, own = run[:, axis], len(run)
        transform = np.fft.rfft(x, 2 * own)
        total[:own] += np.fft.irfft(transform * transform.conj(), 2 * own)[:own]
        pairs[:own] += own - np.arange(own)
    if not total[0] > 0:
        return float(k)
    rho = total / np.maximum(pairs, 1) * (pairs[0] / total[0])
    square = rho**2 - 1.0 / np.maximum(pairs, 1)  # less what chance makes
    return max(1.0, float(1.0 + 2.0 * ((1.0 - np.arange(1, k) / k) * square[1:]).sum()))
