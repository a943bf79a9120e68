"""Hints on mix-ups in files whose errors do not fit: a unit, order, side or frame that makes the covariance fit.

Each cause transforms estimates and covariance (:mod:`consistency.referee.readers.mix_ups.known`). The errors that this
leaves are judged in the same way for all causes, and a cause is named if they come near.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from consistency.referee.diagnostics.records.validity import Validity, classify
from consistency.referee.diagnostics.statistics import distributions
from consistency.referee.readers.truth_matching import Poses
from consistency.referee.types import Array

if TYPE_CHECKING:
    from consistency.referee.readers.mix_ups.known import Guess

MOST = 1000  # estimates that are looked at, of all runs together
MOST_RUNS = 200  # that are looked at, evenly over all
WRONG = 1.0  # decades that the NEES is off, from which on causes are named that look like a bias or a drift
APART = 2.0  # the same of a single component: one run that is off by a constant says little of it
RIGHT = 0.4  # decades that components may differ by with the mix-up undone
SCALE = 1.0  # decades that all may be off by with the mix-up undone: a filter's own fault beside it
SAID = 0.2  # decades from which on this is said
LEAST_GAIN = float(np.log(1e4))  # log likelihood that a cause gains over simple faults, and as much as it has rivals
ENOUGH = 30.0  # independent estimates that show a scale to be the one that a cause makes
ROUNDING, NEGLIGIBLE, NEARLY_ALL = 1e-6, 1e-3, 0.99  # of values, of sigma, of estimates: errors of a file with itself
NEAR, SHARP, LEAST = 5.0, 0.5, 3  # sigmas, rad, steps: an error of an angle, but for whole turns


def hints(
    name: str,
    axes: Sequence[str],
    runs: Sequence[Poses],
    shift: float = 0.0,
    judged: Sequence[int] | None = None,
) -> list[str]:
    """Hints on a probable mix-up, where the covariance does not fit and one other reading of the files does; or none.

    A cause that changes directions or single components is named where no simple fault of a filter explains the errors
    nearly as well, up to a factor of 10 that all components share. One that only scales is named beside the plain
    wrong scale.

    Parameters
    ----------
    axes : names of the components of the error, ``judged`` are the indices of those that count
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
    part = list(range(len(axes)) if judged is None else judged)

    def errors_of(p: Poses, old: Poses | None = None, known: Array | None = None) -> tuple[Array, Array]:
        """Errors of a run with their covariances; ``known`` are those of ``old``, before a cause was undone."""
        if old is not None and known is not None and _same_poses(p, old):
            return known, p.covariance[:, part][:, :, part]
        error, P = p.errors(), p.covariance
        kept = part if error.shape[1] == len(axes) else list(range(error.shape[1]))  # of a quaternion as a rotation
        return error[:, kept], P[:, kept][:, :, kept]

    before = [errors_of(p) for p in some]
    declared = fit_of(before)
    if declared is None or declared.size * declared.fault() < LEAST_GAIN:
        return []
    from consistency.referee.readers.mix_ups.known import guesses_of  # few files need them

    found = [
        (guess, fit_of([errors_of(guess.change(p), p, e)
                        for p, (e, _) in zip(some, before, strict=True)]))
        for guess in guesses_of(some, axes, part)
    ]  # fmt: skip
    cause = _cause(found, declared)
    if cause is None:
        return []
    off = declared.decades
    worst = int(np.argmax(np.abs(off)))
    of = [axes[i] for i in part]
    return [f"{name}: the NEES{_of(of, worst)} is {_times(off[worst])}, but about right if {cause}"]


def _same_poses(p: Poses, old: Poses) -> bool:
    return p.estimate is old.estimate and p.truth is old.truth and p.convention == old.convention


def _cause(found: Sequence[tuple[Guess, ReadingFit | None]], declared: ReadingFit) -> str | None:
    """The likeliest cause in words, if any is confirmed."""
    off = np.abs(declared.decades)
    gross = bool(off[0] > WRONG or (off > APART).any())
    bar, simple = LEAST_GAIN + np.log(max(len(found), 1)), declared.simple()
    named: list[tuple[float, Guess, ReadingFit]] = []
    scaled: list[tuple[Guess, ReadingFit]] = []
    for guess, fit in found:
        if fit is None or len(fit.w) < NEARLY_ALL * len(declared.w) or not (gross or guess.fine):
            continue
        nearer = fit.near() - simple if fit.n == declared.n else -np.inf
        gain = min(fit.size, declared.size) * nearer if nearer > 0 else -np.inf
        if gain >= bar and fit.right(gross) and _status(fit) <= _status(declared):
            named.append((gain, guess, fit))
        elif (gross or guess.exact) and fit.is_shown():
            scaled.append((guess, fit))
    first = [each for each in named if not each[1].last]
    named = first or named
    if named:
        most = max(gain for gain, *_ in named)
        guess, fit = next(
            (guess, fit) for gain, guess, fit in named if gain >= most - 1.0
        )  # nearly as likely: the first
        rest = fit.decades[0]
        return guess.text + (f"; the NEES is then {_times(rest)} in all components" if abs(rest) > SAID else "")
    if not scaled:
        return None
    guess, fit = scaled[0]
    return guess.text + "; a covariance of a wrong scale looks the same" * (fit.n == declared.n)


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


BIAS = 6.0  # standard deviations that a filter is off by without a mix-up
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
    def decades(self) -> Array:
        """log10 of the median NEES over that of chi-square, of all n components and of each alone, (1 + n,)."""
        nees = np.median(np.column_stack([np.square(self.w).sum(axis=1), np.square(self.own)]), axis=0)
        right = distributions.chi2.ppf(0.5, np.append(self.n, np.ones(self.n)))
        return np.asarray(np.log10(np.maximum(nees, 1e-300) / right))

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

    def right(self, roughly: bool) -> bool:
        """Whether all is right but for a factor that all components share: within decades, or at a rate of ``ODD``."""
        if roughly:
            off = self.decades
            return bool(abs(off[0]) < SCALE and (np.abs(off[1:] - off[0]) < RIGHT).all())
        n, size, common = self.n, self.size, float(np.square(self.w).mean())
        w = self.w / np.sqrt(common)
        pairs = np.triu_indices(n, 1)
        asked = n + n + len(pairs[0]) + 1
        ratios = np.square(self.own).mean(axis=0) / common
        scale = size * (ratios - np.log(np.maximum(ratios, 1e-300)) - 1.0)
        products = (w.T @ w / len(w))[pairs]
        below = float((np.square(w).sum(axis=1) < distributions.chi2.ppf(0.5, n)).mean())
        normal = np.concatenate([w.mean(axis=0), products, [2.0 * below - 1.0]]) * np.sqrt(size)
        limit = distributions.chi2.isf(ODD / asked, 1)
        return bool((scale <= limit).all() and (np.square(normal) <= limit).all())

    def is_shown(self) -> bool:
        """Whether all is right, the common factor too, with enough independent estimates to show it."""
        ratio = float(np.square(self.w).mean())
        off = self.n * self.size * (ratio - np.log(max(ratio, 1e-300)) - 1.0)
        return self.size >= ENOUGH and self.right(False) and bool(off <= distributions.chi2.isf(ODD, 1))

    def near(self) -> float:
        """Mean log likelihood with the best factor on the covariance, of at most ``SCALE``."""
        mean = float(np.square(self.w).mean())
        f = float(np.clip(mean, 10.0**-SCALE, 10.0**SCALE))
        return self.likelihood + 0.5 * self.n * (mean - mean / f - float(np.log(f)))

    def fault(self) -> float:
        """Log likelihood of an estimate that another covariance, the same for all whitened errors, would gain."""
        M = self.w.T @ self.w / len(self.w)
        sign, log_det = np.linalg.slogdet(M)
        return 0.5 * float(np.trace(M) - (log_det if sign > 0 else -np.inf) - self.n)

    def simple(self) -> float:
        """Log likelihood of an estimate with the simple fault that explains the errors best.

        That is any factor on the covariance of all components, with one of at most ``FACTOR`` on that of a single one,
        of position or of attitude; or a bias of at most ``BIAS`` standard deviations with a factor within ``SCALE``.
        """
        n, w = self.n, self.w
        before = float(np.square(w).sum(axis=1).mean())
        shift = self.root @ self.error.mean(axis=0)
        part = min(1.0, BIAS / max(float(np.sqrt(np.square(shift).sum(axis=1).mean())), 1e-300))
        after = before - float((2.0 * part * w * shift - (part * shift) ** 2).sum(axis=1).mean())
        common = float(np.clip(after / n, 10.0**-SCALE, 10.0**SCALE))
        best = 0.5 * (before - after / common - n * float(np.log(common)))
        f = np.exp(np.linspace(-np.log(FACTOR), np.log(FACTOR), 61))
        for group in [*([j] for j in range(n)), *GROUPS.get(n, ())]:
            own = (self.root[:, :, group] @ self.error[:, group, None])[..., 0]
            a = f**-0.5 - 1.0
            left = before + 2.0 * a * float((w * own).sum(axis=1).mean()) + a**2 * float((own**2).sum(axis=1).mean())
            of_all = n + n * np.log(np.maximum(left, 1e-300) / n)
            best = max(best, float((0.5 * (before - of_all - len(group) * np.log(f))).max()))
        return self.likelihood + best


def _status(fit: ReadingFit) -> int:
    """0 where the NEES is shown to be consistent, 1 where it may be, 2 where it is not."""
    from consistency.referee.diagnostics import judge
    from consistency.referee.diagnostics.records.record import Record

    nees = np.full((len(fit.whitened), max(map(len, fit.whitened))), np.nan)
    for row, w in zip(nees, fit.whitened, strict=True):
        row[: len(w)] = np.square(w).sum(axis=1)
    return {"consistent": 0, "undecided": 1}.get(judge(Record("", nees=nees, dof=fit.n)).status, 2)


def fit_of(runs: Sequence[tuple[Array, Array]]) -> ReadingFit | None:
    """Errors (k, n) of some runs with their covariances (k, n, n); None without any that can be whitened."""
    errors, P = (np.concatenate(each) for each in zip(*runs, strict=True))
    ends = np.cumsum([len(error) for error, _ in runs])[:-1]
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
