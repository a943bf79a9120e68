"""Hints on mix-ups in files whose errors do not fit: a unit, order, side or frame that makes the covariance fit.

Each cause transforms estimates and covariance (:mod:`consistency.referee.readers.mix_ups.known`). The errors that this
leaves are judged in the same way for all causes, and a cause is named if they come near.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from consistency.referee.readers.mix_ups.known import Guess, guesses_of, turns_of, worlds_of
from consistency.referee.readers.mix_ups.reading_fit import LEAST_GAIN, SCALE, ReadingFit, fit_of, is_same, thinned
from consistency.referee.readers.truth_matching import Change, Poses, submatrices
from consistency.referee.types import Array

WRONG = 1.0  # decades that the NEES is off, from which on causes are named that look like a bias or a drift
APART = 2.0  # the same of a single component: one run that is off by a constant says little of it
SAID = 0.2  # decades from which on the scale that remains is stated
MOST_SAID = 3  # causes
LIKE = 1.0  # log likelihood by which two causes may differ that are equally likely
NEARLY_ALL = 0.99  # of the estimates that can be whitened as declared
NEAR = 5.0  # sigmas: an error of an angle, but for whole turns
SHARP = 0.5  # rad
LEAST = 3  # steps
FEWEST = 10  # runs and steps from which on swapped arrays are looked for
ENOUGH = 200  # errors, whose correlation then is known to 0.07 where they are independent
ALIKE = 0.5  # correlation from run to run
UNLIKE = 0.2  # of it, from step to step

Pairs = Sequence[tuple[Array, Array]]
ErrorsWithout = Callable[[Change], Pairs]


@dataclass(frozen=True)
class Candidate:
    """A possible mix-up, and how the errors fit without it."""

    guess: Guess
    fit: ReadingFit
    size: float  # independent estimates
    gain: float  # log likelihood of each over the simple faults of the errors as declared; -inf where it is none


@np.errstate(invalid="ignore")  # of poses that are not finite, which no reading makes fit
def hints(
    name: str,
    axes: Sequence[str],
    runs: Sequence[Poses],
    judged: Sequence[int] | None = None,
    errors_without: ErrorsWithout | None = None,
) -> list[str]:
    """Hints on a probable mix-up, where the covariance does not fit and one other reading of the files does; or none.

    A cause that changes directions or single components is named where no simple fault of a filter explains the errors
    nearly as well, up to a factor of 10 that all components share. One that only scales is named beside the plain
    wrong scale.

    Parameters
    ----------
    axes : names of the components of the error, ``judged`` are the indices of those that count
    errors_without : errors (k, n) of the motions of each run over windows, with their covariances, after a change of
        the motions that ``runs`` are; none where no window is left
    """
    if not runs:
        return []
    part = list(range(len(axes)) if judged is None else judged)
    some = runs
    worlds = errors_without is None
    if errors_without is None:
        some = thinned(runs)
        errors_without = partial(_errors_without, some, [p.errors() for p in some])
        if is_same(some):
            return [
                f"{name}: the errors are 0 to rounding, so that truth and estimates seem to be the same file or copies "
                "of one; give the true poses as the truth"
            ]
    fit_without = partial(_fit_without, errors_without, part, len(axes))
    declared = fit_without(lambda p: p)
    if declared is not None and not declared.is_off():
        return []
    guesses = guesses_of(some, axes, part)
    if worlds:
        guesses += [*turns_of(some, axes), *worlds_of(some)]
    fits = [(guess, fit_without(guess.change)) for guess in guesses]
    if declared is None:
        shown = [guess.text for guess, fit in fits if fit is not None and fit.is_shown(SCALE)]
        return [f"{name}: the covariance is not positive definite, but right if {_either(shown)}"] if shown else []
    cause = _cause(fits, declared)
    if cause is None:
        return []
    worst = int(np.argmax(np.abs(declared.decades)))
    of_axis = f" of {axes[part[worst - 1]]} by itself" if worst > 0 else ""
    return [f"{name}: the NEES{of_axis} is {_times(declared.decades[worst])}, but about right if {cause}"]


def _errors_without(runs: Sequence[Poses], errors: Sequence[Array], change: Change) -> Pairs:
    """Errors after a change, or the ``errors`` before it where it leaves them as they are, and covariances."""
    pairs = []
    for p, error in zip(runs, errors, strict=True):
        other = change(p)
        is_moved = other.own.estimate is not p.own.estimate or other.true.values is not p.true.values
        same = not is_moved and other.convention == p.convention
        pairs.append((error if same else other.errors(), other.own.covariance))
    return pairs


def _fit_without(errors_without: ErrorsWithout, part: list[int], n: int, change: Change) -> ReadingFit | None:
    """Fit of the components that are judged; of all of a state whose quaternion became a rotation of three."""
    pairs = errors_without(change)
    if len(part) == n or not all(error.shape[1] == n for error, _ in pairs):
        return fit_of(pairs)
    return fit_of([(error[:, part], submatrices(P, part)) for error, P in pairs])


def _cause(fits: Sequence[tuple[Guess, ReadingFit | None]], declared: ReadingFit) -> str | None:
    """The likeliest cause in words, if any is confirmed."""
    off = np.abs(declared.decades)
    gross = bool(off[0] > WRONG or (off > APART).any())
    candidates = list(_candidates(fits, declared, gross))
    like = _likeliest(candidates, declared, gross, LEAST_GAIN + np.log(max(len(fits), 1)))
    if like:
        text = _either([one.guess.text for one in like])
        rest = like[0].fit.decades[0]
        if abs(rest) <= SAID:
            return text
        return f"{text}; the NEES is then {_times(rest)} in all components"
    for one in candidates:
        if (gross or one.guess.exact) and one.fit.is_shown():
            if one.fit.n != declared.n:
                return one.guess.text
            return f"{one.guess.text}; a covariance of a wrong scale looks the same"
    return None


def _candidates(
    fits: Sequence[tuple[Guess, ReadingFit | None]], declared: ReadingFit, gross: bool
) -> Iterator[Candidate]:
    """Possible mix-ups without which nearly all errors can be whitened."""
    simple = declared.simple()
    for guess, fit in fits:
        if fit is None or len(fit.w) < NEARLY_ALL * len(declared.w) or not (gross or guess.fine):
            continue
        size = max(min(fit.size, declared.size), len(declared.whitened))  # runs are independent
        gain = -np.inf
        if fit.n == declared.n:
            gain = fit.near() + guess.volume - simple
        yield Candidate(guess, fit, size, gain)


def _likeliest(candidates: Sequence[Candidate], declared: ReadingFit, gross: bool, bar: float) -> Sequence[Candidate]:
    """The likeliest candidates that are right but for a common factor, which are equally likely; at need the last."""
    right = []
    at_need = []
    for one in candidates:
        if one.size * one.gain < bar or not one.fit.right(gross) or not one.fit.is_better(declared):
            continue
        if _status(one.fit) > _status(declared):
            continue
        if one.guess.last:
            at_need.append(one)
        else:
            right.append(one)
    right = right or at_need
    most = max((one.gain for one in right), default=0.0)
    return [one for one in right if one.size * (most - one.gain) <= LIKE]


def _either(texts: Sequence[str]) -> str:
    """Causes between which the errors do not decide, the likelier first."""
    said = "; or if ".join(texts[:MOST_SAID])
    if len(texts) > MOST_SAID:
        said += f" ({len(texts)} causes fit equally)"
    return said


def _status(fit: ReadingFit) -> int:
    """0 where the NEES is shown to be consistent, 1 where it may be, 2 where it is not."""
    from consistency.referee.diagnostics.judge_record import judge
    from consistency.referee.diagnostics.record import make_record

    longest = max(map(len, fit.whitened))
    nees = np.full((len(fit.whitened), longest), np.nan)
    for row, w in zip(nees, fit.whitened, strict=True):
        row[: len(w)] = np.square(w).sum(axis=1)
    verdict = judge(make_record("", nees=nees, dof=fit.n))
    return {"consistent": 0, "undecided": 1}.get(verdict.status, 2)


def _times(off: float) -> str:
    if off > 0:
        return f"{10.0**off:.2g} times too large"
    return f"{10.0**-off:.2g} times too small"


def turns(name: str, axes: Sequence[str], error: Array, covariance: Array, remedy: str) -> list[str]:
    """Components of errors (runs, steps, n) that look like angles: their large errors are whole turns."""
    found = []
    in_degrees = 360.0, "360", np.rad2deg(SHARP), "wrap it to [-180, 180]"
    for turn, by, sharp, how in ((2.0 * np.pi, "2 pi", SHARP, remedy), in_degrees):
        with np.errstate(invalid="ignore"):
            sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
            far = np.abs(error) > np.maximum(0.5 * turn, 2.0 * NEAR * sigma)
            far &= NEAR * sigma < sharp
            home = np.abs(error - turn * np.round(error / turn)) <= NEAR * sigma
        for k, axis in enumerate(axes):
            jumps = int(far[..., k].sum())
            if jumps >= LEAST and home[..., k][far[..., k]].all():
                steps = f"{jumps} of {int(np.isfinite(error[..., k]).sum())} steps"
                found.append(f"{name}: the error of {axis} is off by {by} in {steps}, as that of an angle; {how}")
    return found


def swapped(name: str, errors: Array) -> list[str]:
    """A hint where errors (runs, steps, n) correlate from run to run, and not from step to step; none elsewhere."""
    runs, steps, _ = errors.shape
    if runs < FEWEST or steps < FEWEST or runs * steps < ENOUGH:
        return []
    e = np.where(np.isfinite(errors), errors, 0.0)
    of_runs, of_steps = (_lag(e - e.mean(axis=axis, keepdims=True), axis) for axis in (0, 1))
    if of_runs < ALIKE or abs(of_steps) > UNLIKE * of_runs:
        return []
    return [
        f"{name}: errors correlate by {of_runs:.2f} from one run to the next and by {of_steps:.2f} from one step to "
        "the next, as in arrays (steps, runs, n); the order is (runs, steps, n): np.swapaxes(array, 0, 1) of each"
    ]


def _lag(e: Array, axis: int) -> float:
    """Mean correlation of errors (runs, steps, n) with their neighbours along an axis, over components."""
    e = np.moveaxis(e, axis, 0)
    size = np.square(e).mean(axis=(0, 1))
    together = (e[1:] * e[:-1]).mean(axis=(0, 1))
    return float(np.mean(together / np.where(size > 0, size, 1.0)))
