"""How well errors fit their covariance under one reading of the files, or with a simple fault of a filter."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from consistency.referee.diagnostics import distributions
from consistency.referee.diagnostics.whitening import ROUNDED
from consistency.referee.readers.truth_matching import Poses, finite_rows, submatrices
from consistency.referee.types import Array, Indices

MOST = 1000  # estimates that are looked at, of all runs together
MOST_NUMBERS = 4_000_000  # of their covariances
MOST_RUNS = 200  # that are looked at, evenly over all
LEAST_EACH = 20  # estimates of each
LEAST_GAIN = float(np.log(1e3))  # log likelihood that a cause gains over simple faults, and as much as it has rivals
ROUNDING = 1e-6  # of values: errors of a file with itself
NEGLIGIBLE = 1e-3  # of sigma
NEARLY_ALL = 0.99  # of the estimates
LEAST = 3  # estimates that show two files to be the same
RIGHT = 0.4  # decades that components may differ by with the mix-up undone, or more where chance allows it
SCALE = 1.3  # decades that all may be off by with the mix-up undone: a filter's own fault beside it
ENOUGH = 100.0  # independent estimates that show a scale to be the one that a cause makes
BIAS = 6.0  # standard deviations that a filter is off by without a mix-up
FACTOR = 6.0  # by which a wrong filter's covariance is off without a mix-up: the table of benchmarks/hints.py has 4
ANY = 1e8  # the same of a number that stands for all variances
WIDE = 1e3  # the same of a fault in some steps or runs, or of any size that is rarer
PIECES = 10  # of the steps, and of the runs, in which a fault may have sizes of its own
COST = 1.5  # log likelihood of each number that is fitted to such a fault
RARE = 10.0  # the same of such a fault of one component, which is as rare as one of some 20 mix-ups
POWERS = (1.0, 0.5, 0.0)  # of the size of the stated covariance: what it varies by may mean nothing
ODD = 1e-3  # probability that errors with the stated covariance are not taken for such
GROUPS = {3: ([0, 1],), 6: ([0, 1, 2], [3, 4, 5])}  # position and attitude, of poses
SMALL = 30  # components up to which all matrices are solved at once, which is slower for larger ones
FEW = 12  # components up to which a factor on one of them is a fault that others can be told from


@dataclass(frozen=True)
class ReadingFit:
    """Errors of K estimates in n components under one reading; those that cannot be whitened are left out."""

    whitened: Sequence[Array]  # of each run, (k, n)
    factor: Array  # (K, n, n), L of the correlations R = L L'
    sigma: Array  # (K, n)
    error: Array  # (K, n)

    @property
    def n(self) -> int:
        return int(self.error.shape[1])

    @cached_property
    def w(self) -> Array:
        """(K, n)."""
        return np.concatenate(self.whitened)

    @cached_property
    def nees(self) -> Array:
        """(K,)."""
        return np.asarray(np.square(self.w).sum(axis=1))

    @property
    def scale(self) -> float:
        """Mean NEES over its degrees of freedom."""
        return float(self.nees.mean()) / self.n

    @cached_property
    def own(self) -> Array:
        """Errors over their standard deviations, (K, n)."""
        return np.asarray(self.error / self.sigma)

    @cached_property
    def decades(self) -> Array:
        """log10 of the median NEES over that of chi-square, of all n components and of each alone, (1 + n,)."""
        squares = np.column_stack([self.nees, np.square(self.own)])
        medians = np.median(squares, axis=0)
        dof = np.append(self.n, np.ones(self.n))
        right = distributions.chi2.ppf(0.5, dof)
        return np.asarray(np.log10(np.maximum(medians, 1e-300) / right))

    @cached_property
    def likelihood(self) -> float:
        """Mean log likelihood of an estimate, but for a constant."""
        diagonal = np.diagonal(self.factor, axis1=1, axis2=2)
        log_det = np.log(diagonal).sum(axis=1) + np.log(self.sigma).sum(axis=1)
        log_det *= 2.0
        return -0.5 * float(self.nees.mean() + log_det.mean())

    @cached_property
    def size(self) -> float:
        """Effective number of independent estimates, for the scale.

        Squares of Gaussian errors with the autocorrelation rho have that of rho^2, so that K of them say as much as
        K / (1 + 2 sum (1 - l / k) rho_l^2) independent ones; the mean is 0 by assumption, and an error that is constant
        over a run counts once. Chance in the rho of a single run leaves down to a third of that. It is no more than the
        spread of the NEES over estimates, and over 8 or more runs, allows.
        """
        K, n = self.w.shape
        size = K / _memory(self.whitened)
        variance = max(float((self.nees / n).var()), 1e-300)
        size *= min(1.0, 2.0 * self.scale**2 / (n * variance))
        means = np.array([np.square(w).mean() for w in self.whitened])
        if len(means) >= 8 and means.std() > 0:
            of_runs = 2.0 * float(means.mean()) ** 2 * len(means)
            size = min(size, of_runs / (n * float(means.var(ddof=1))))
        return max(float(size), 1.0)

    def right(self, roughly: bool) -> bool:
        """Whether all is right but for a factor that all components share, at a rate of ``ODD``.

        ``roughly`` is within decades, or by chance in few estimates.
        """
        ratio = np.square(self.own).mean(axis=0) / self.scale
        if roughly:
            within = np.abs(self.decades[1:] - self.decades[0]) < RIGHT
            chance = self.size * _deviance(ratio) <= distributions.chi2.isf(ODD / self.n, 1)
            return bool((within | chance).all())
        w = self.w / np.sqrt(self.scale)
        pairs = np.triu_indices(self.n, 1)
        products = (w.T @ w / len(w))[pairs]
        middle = distributions.chi2.ppf(0.5, self.n)
        below = float((self.nees / self.scale < middle).mean())
        normal = np.concatenate([w.mean(axis=0), products, [2.0 * below - 1.0]])
        of_axes = _deviance(ratio)
        limit = distributions.chi2.isf(ODD / (len(normal) + len(of_axes)), 1)
        deviances = self.size * np.append(of_axes, np.square(normal))
        return bool((deviances <= limit).all())

    def is_better(self, declared: ReadingFit) -> bool:
        """Whether the scale is nearly right, and no further off than anything as declared."""
        off = abs(float(self.decades[0]))
        return off < min(SCALE, float(np.abs(declared.decades).max()))

    def is_shown(self, scale: float = 0.0) -> bool:
        """Whether enough independent estimates show that all is right, the common factor too, within decades."""
        factor = 10.0 ** max(abs(float(np.log10(max(self.scale, 1e-300)))) - scale, 0.0)
        off = self.n * self.size * _deviance(factor if self.scale > 1.0 else 1.0 / factor)
        limit = distributions.chi2.isf(ODD, 1)
        return self.size >= ENOUGH and self.right(False) and bool(off <= limit)

    def near(self) -> float:
        """Mean log likelihood with the best factor on the covariance, of at most ``SCALE``.

        Pieces of the steps, or of the runs, may have factors of their own beside it.
        """
        f = _common_factor(self.scale)
        gain = self.scale - self.scale / f - float(np.log(f))
        whole = self.scale - 1.0 - float(np.log(max(self.scale, 1e-300)))
        of_pieces = self._in_pieces(self._squares([]), 0, POWERS[:1]) - 0.5 * self.n * whole
        return self.likelihood + 0.5 * self.n * gain + max(of_pieces, 0.0)

    def is_off(self) -> bool:
        """Whether another covariance explains the errors better by what a mix-up has to gain at least."""
        return self.size * self.fault() >= LEAST_GAIN

    def fault(self) -> float:
        """Log likelihood of an estimate that another covariance, the same for all whitened errors, would gain."""
        M = self.w.T @ self.w / len(self.w)
        sign, log_det = np.linalg.slogdet(M)
        if not sign > 0:
            return np.inf
        return 0.5 * float(np.trace(M) - log_det - self.n)

    def simple(self) -> float:
        """Log likelihood of an estimate with the simple fault that explains the errors best.

        That is any factor on the covariance of all components, with one of at most ``FACTOR`` on that of a single one,
        of position or of attitude, or of any size there where one number was written for all variances; or a bias of
        at most ``BIAS`` standard deviations of each component with a factor within ``SCALE``. Faults in some steps or
        runs, factors of one component up to ``WIDE``, and covariances whose changes of size mean less than stated
        cost ``COST`` for each of their numbers; such a wide factor is as rare as a mix-up.
        """
        singles = [[j] for j in range(self.n)] if self.n <= FEW else []
        groups = [[], *singles, *GROUPS.get(self.n, ())]
        constant = self.error.mean(axis=0) / self.sigma
        growing = np.tile(self.own.mean(axis=0), (len(self.own), 1))
        gains = [self._with_bias(bias) for bias in (constant, growing)]
        for group in groups:
            squares = self._squares(group)
            gains += [self._with_factor(squares, len(group)), self._in_pieces(squares, len(group), POWERS)]
        return self.likelihood + max(gains)

    def _with_bias(self, bias: Array) -> float:
        """Log likelihood that an estimate gains by a bias (K, n), over the standard deviations."""
        size = float(np.sqrt(np.square(bias).mean(axis=0)).max())
        shift = _solved(self.factor, bias * min(1.0, BIAS / max(size, 1e-300)))
        squares = np.square(self.w - shift).sum(axis=1)
        after = float(squares.mean()) / self.n
        f = _common_factor(after)
        return 0.5 * self.n * (self.scale - after / f - float(np.log(f)))

    def _with_factor(self, squares: Array, size: int) -> float:
        """Log likelihood that an estimate gains by a factor on ``size`` components, beside one on all.

        ``squares`` are those of :meth:`_squares`.
        """
        most = np.log(FACTOR)
        if np.ptp(self.sigma) <= 1e-9 * self.sigma.max():
            most = np.log(ANY)
        f = np.exp(np.linspace(-most, most, 61))
        mean = squares.mean(axis=0, keepdims=True)
        return 0.5 * (self.n * (self.scale - 1.0) - float(_least(mean, f, size, self.n)[0]))

    def _in_pieces(self, squares: Array, size: int, powers: Sequence[float]) -> float:
        """Log likelihood that an estimate gains by such factors in each piece of the steps or of the runs.

        The size of the stated covariance counts by one of the ``powers`` of itself. What the numbers cost is taken off.
        """
        f = np.exp(np.linspace(-1.0, 1.0, 61) * np.log(WIDE)) if size else np.ones(1)
        best = -np.inf
        for power, pieces in itertools.product(powers, self._pieces):
            count = np.bincount(pieces)
            share = count / len(pieces)
            weighed = squares.T * np.exp((1.0 - power) * self._log_size)
            means = np.array([np.bincount(pieces, column) for column in weighed]).T / count[:, None]
            left = float(share @ _least(means, f, size, self.n))
            fitted = len(count) * (1 + bool(size)) - (power == 1.0)
            cost = COST * fitted + RARE * bool(size)
            best = max(best, 0.5 * (self.n * (self.scale - 1.0) - left) - cost / self.size)
        return best

    def _squares(self, group: list[int]) -> Array:
        """w'w, w'p and p'p of the whitened errors w and their part p that is of some components, (K, 3)."""
        if not group:
            return np.column_stack([self.nees, np.zeros((len(self.nees), 2))])
        of_group = np.zeros_like(self.own)
        of_group[:, group] = self.own[:, group]
        part = _solved(self.factor, of_group)
        return np.column_stack([self.nees, (self.w * part).sum(axis=1), np.square(part).sum(axis=1)])

    @cached_property
    def _log_size(self) -> Array:
        """log of the n-th root of the determinant of each covariance, (K,), less its mean."""
        diagonal = np.diagonal(self.factor, axis1=1, axis2=2)
        size = 2.0 * (np.log(diagonal) + np.log(self.sigma)).mean(axis=1)
        return np.asarray(size - size.mean())

    @cached_property
    def _pieces(self) -> list[Indices]:
        """Where each estimate belongs, (K,) of int: to all, to a piece of its run, to runs of a like NEES."""
        lengths = [len(w) for w in self.whitened]
        steps = np.concatenate([np.arange(k) * PIECES // k for k in lengths])
        rank = np.argsort(np.argsort([np.square(w).mean() for w in self.whitened]))
        runs = np.repeat(rank * PIECES // len(rank), lengths)
        pieces = [np.zeros(len(steps), int), steps, runs]
        return [np.unique(labels, return_inverse=True)[1] for labels in pieces]


def _least(squares: Array, f: Array, size: int, n: int) -> Array:
    """n log of what a common factor leaves beside the best of factors ``f`` on ``size`` components, (B,).

    ``squares`` are means of those of :meth:`ReadingFit._squares`, (B, 3).
    """
    a = f**-0.5 - 1.0
    total = squares[:, :1] + 2.0 * a * squares[:, 1:2] + a**2 * squares[:, 2:]
    left = n * np.log(np.maximum(total, 1e-300) / n) + size * np.log(f)
    return np.asarray(left.min(axis=1))


def fit_of(runs: Sequence[tuple[Array, Array]]) -> ReadingFit | None:
    """Errors (k, n) of some runs with their covariances (k, n, n); None without any that can be whitened."""
    if not runs:
        return None
    errors = np.concatenate([error for error, _ in runs])
    P = np.concatenate([covariance for _, covariance in runs])
    with np.errstate(invalid="ignore"):
        variance = np.diagonal(P, axis1=1, axis2=2)
        good = finite_rows(errors) & finite_rows(P)
        good &= (variance > ROUNDED.zero).all(axis=1)
    sigma = np.sqrt(variance[good])
    R = P[good]
    R /= sigma[:, :, None] * sigma[:, None, :]
    L, definite = _factors(R)
    good[good] = definite
    if not good.any():
        return None
    if not definite.all():
        L = L[definite]
        sigma = sigma[definite]
    error = errors[good]
    w = np.full(errors.shape, np.nan)
    w[good] = _solved(L, error / sigma)
    whitened = []
    start = 0
    for own, _ in runs:
        part = w[start : start + len(own)]
        part = part[finite_rows(part)]
        if len(part):
            whitened.append(part)
        start += len(own)
    return ReadingFit(whitened, L, sigma, error)


def _common_factor(scale: float) -> float:
    """The best factor on the covariance of all components, of at most ``SCALE``."""
    return float(np.clip(scale, 10.0**-SCALE, 10.0**SCALE))


def _deviance(ratio: Array | float) -> Array:
    """Twice the log likelihood that a variance loses to one that is off by a ratio, per estimate."""
    return np.asarray(ratio - np.log(np.maximum(ratio, 1e-300)) - 1.0)


def _factors(R: Array) -> tuple[Array, Indices]:
    """Lower Cholesky factors (K, n, n), and which of the matrices have one, (K,) of bool."""
    try:
        return np.linalg.cholesky(R), np.ones(len(R), bool)
    except np.linalg.LinAlgError:
        L = np.full_like(R, np.nan)
        for own, matrix in zip(L, R, strict=True):
            with suppress(np.linalg.LinAlgError):
                own[:] = np.linalg.cholesky(matrix)
        return L, np.isfinite(L[:, 0, 0])


def _solved(L: Array, x: Array) -> Array:
    """L^-1 x of lower factors (K, n, n) and vectors (K, n)."""
    if L.shape[-1] <= SMALL:
        return np.asarray(np.linalg.solve(L, x[..., None])[..., 0])
    from scipy.linalg import solve_triangular

    solved = []
    for one, vector in zip(L, x, strict=True):
        solved.append(solve_triangular(one, vector, lower=True))
    return np.array(solved)


def _memory(runs: Sequence[Array]) -> float:
    """1 + 2 sum over lags l of (1 - l / k) rho_l^2 of a component, over all runs, the largest; k is the longest run."""
    k = max(map(len, runs))
    n = runs[0].shape[1]
    total = np.zeros((k, n))
    pairs = np.zeros((k, 1))
    for run in runs:
        own = len(run)
        transform = np.fft.rfft(run, 2 * own, axis=0)
        products = np.fft.irfft(transform * transform.conj(), 2 * own, axis=0)
        total[:own] += products[:own]
        pairs[:own, 0] += own - np.arange(own)
    if not (total[0] > 0).all():
        return float(k)
    rho = total / np.maximum(pairs, 1) * (pairs[0] / total[0])
    square = rho**2 - 1.0 / np.maximum(pairs, 1)  # less what chance makes
    share = 1.0 - np.arange(1, k) / k
    longer = share[:, None] * square[1:]
    memory = 1.0 + 2.0 * longer.sum(axis=0)
    return max(1.0, float(memory.max()))


# --- the files as they were declared -----------------------------------------------------------------


@np.errstate(invalid="ignore")  # of poses that are not finite
def is_plausible(runs: Sequence[Poses], judged: Sequence[int]) -> bool:
    """Whether the errors fit as the files were declared, so that no mix-up is to be looked for."""
    some = thinned(runs)
    if is_same(some):
        return False
    pairs = []
    for p in some:
        pairs.append((p.errors()[:, judged], submatrices(p.own.covariance, judged)))
    declared = fit_of(pairs)
    return declared is not None and not declared.is_off()


def thinned(runs: Sequence[Poses]) -> list[Poses]:
    """Some estimates of some runs, without those that are not finite."""
    most = max(MOST_NUMBERS // runs[0].own.covariance.shape[-1] ** 2, 1)
    runs = runs[:: math.ceil(len(runs) / min(MOST_RUNS, most))]
    share = most // len(runs)
    each = max(min(MOST, most) // len(runs), min(LEAST_EACH, share))
    return [p.some(each).sound() for p in runs]


def is_same(runs: Sequence[Poses]) -> bool:
    """Whether the errors are rounding in nearly all estimates, in values and beside their standard deviations."""
    same = total = 0
    for p in runs:
        largest = float(np.abs(p.true.values).max(initial=0.0))
        rounding = ROUNDING * max(1.0, largest)
        p = p.matched()
        error = np.abs(p.errors())
        with np.errstate(invalid="ignore"):
            sigma = np.sqrt(p.variances)
            equal = (error <= rounding) & (error <= NEGLIGIBLE * sigma)
        same += int(equal.all(axis=1).sum())
        total += len(error)
    return total >= LEAST and same >= NEARLY_ALL * total
