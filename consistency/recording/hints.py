"""Errors that no estimator makes: a unit, order, side or frame with which they are as large as the covariance says."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from consistency.diagnostics.whitening import whiten
from consistency.geometry import wrap
from consistency.geometry.conventions import PLANAR, SPATIAL
from consistency.recording.frames import fitted_frame, moved, spread
from consistency.recording.poses import Poses
from consistency.types import Array

MOST = 4000  # estimates that are looked at, of all runs together
WRONG = 1.0  # decades that the NEES is off, from which a mix-up is looked for
APART = 2.0  # the same of a single component: one run that is off by a constant says little of it
RIGHT = 0.4  # decades that it may be off with the mix-up undone
ALIKE = 0.01  # decades between guesses of which the likelier is named
DEGREE = np.pi / 180.0
MILLI = 1e-3
TURN, SHIFT = 3.0, 0.05  # degrees, and of the size of the path: frames that differ by less are not named

NEAR, SHARP, LEAST = 5.0, 0.5, 3  # sigmas, rad, steps: an error of an angle, but for whole turns

Change = Callable[[Poses], Poses]


@dataclass(frozen=True)
class Guess:
    """What the files may be, in words, and how they read then."""

    text: str
    change: Change
    last: bool = False  # named only where nothing else fits: it has a fit of its own for each run


def hints(name: str, axes: Sequence[str], runs: Sequence[Poses], shift: float = 0.0) -> list[str]:
    """What the error may really be, where the NEES is off by a decade or more and one guess brings it right; or none.

    The NEES of a median estimate is compared with that of a right one. The best guess is named.
    """
    some = [poses.later(shift).some(max(MOST // len(runs), 20)).sound() for poses in runs]
    off = decades(some)
    limit = np.append(WRONG, np.full(len(off) - 1, APART))
    worst = int(np.argmax(np.abs(off) / limit))
    if not abs(off[worst]) > limit[worst]:
        return []
    guesses = _guesses(some)
    left = np.array([np.abs(decades([guess.change(poses) for poses in some])).max() for guess in guesses])
    first = np.where([guess.last for guess in guesses], np.nan, left)
    left = first if np.nanmin(first) < RIGHT else left
    if not np.nanmin(left) < RIGHT:
        return []
    best = int(np.flatnonzero(left <= np.nanmin(left) + ALIKE)[0])
    of = "" if worst == 0 else f" of {axes[worst - 1]} by itself"
    size = f"{10.0 ** abs(off[worst]):.2g} times too {'large' if off[worst] > 0 else 'small'}"
    return [f"{name}: the NEES{of} is {size}, but about right if {guesses[best].text}"]


def turns(name: str, axes: Sequence[str], error: Array, covariance: Array, remedy: str) -> list[str]:
    """Components of errors (runs, steps, n) that are angles: where they are far off, it is by whole turns."""
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
        far = (np.abs(error) > np.pi) & (np.abs(error) > 2.0 * NEAR * sigma) & (NEAR * sigma < SHARP)
        home = np.abs(wrap(error)) <= NEAR * sigma
    found = []
    for k, axis in enumerate(axes):
        jumps = int(far[..., k].sum())
        if jumps >= LEAST and home[..., k][far[..., k]].all():
            steps = f"{jumps} of {int(np.isfinite(error[..., k]).sum())} steps"
            found.append(f"{name}: the error of {axis} is off by 2 pi in {steps}, as that of an angle; {remedy}")
    return found


def decades(runs: Sequence[Poses]) -> Array:
    """log10 of the median NEES over that of chi-square, of all n components and of each by itself, (1 + n,).

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
    right = stats.chi2.median(np.append(n, np.ones(n)))
    return np.asarray(np.log10(np.maximum(np.median(nees, axis=0), 1e-300) / right))


# --- guesses ----------------------------------------------------------------------------------------


def _guesses(runs: Sequence[Poses]) -> list[Guess]:
    """What may be, the likelier first."""
    kind = runs[0].manifold
    guesses = [*_covariances()]
    if kind == "spatial":
        guesses = [*_orders(runs[0].convention), *_quaternions(), *guesses, *_units(3, slice(3, 6)), *_frames(runs)]
    elif kind == "planar":
        guesses = [*_sides(runs[0].convention), *_headings(), *guesses, *_units(2, slice(2, 3)), *_frames(runs)]
    return guesses


def _orders(convention: str) -> Iterator[Guess]:
    swap = [3, 4, 5, 0, 1, 2]
    for other in SPATIAL:
        for turned in (False, True):
            if (other, turned) != (convention, False):
                words = [] if other == convention else [f"the error is '{other}' (--error {other})"]
                words += ["the covariance has its two blocks in the other order (--covariance-order)"] if turned else []
                yield Guess(" and ".join(words), _read_as(other, swap if turned else [0, 1, 2, 3, 4, 5]))


def _read_as(convention: str, order: list[int]) -> Change:
    return lambda p: replace(p, convention=convention, covariance=p.covariance[:, order][:, :, order])


def _sides(convention: str) -> Iterator[Guess]:
    for other in PLANAR:
        if other not in (convention, "vector"):
            yield Guess(f"the error is '{other}' (--error {other})", _read_as(other, [0, 1, 2]))


def _quaternions() -> Iterator[Guess]:
    first = [0, 1, 2, 4, 5, 6, 3]
    yield Guess(
        "the quaternions of both files are w x y z; write them x y z w",
        lambda p: replace(p, estimate=p.estimate[:, first], truth=p.truth[:, first]),
    )
    yield Guess(
        "the quaternions of the estimates are w x y z; write them x y z w",
        lambda p: replace(p, estimate=p.estimate[:, first]),
    )
    yield Guess(
        "the quaternions of the truth are w x y z; write them x y z w", lambda p: replace(p, truth=p.truth[:, first])
    )
    back = np.array([1.0, 1.0, 1.0, -1.0, -1.0, -1.0, 1.0])
    yield Guess(
        "the quaternions of the estimates turn world into body; invert them",
        lambda p: replace(p, estimate=p.estimate * back),
    )


def _headings() -> Iterator[Guess]:
    degrees = np.array([1.0, 1.0, DEGREE])
    yield Guess("the headings of both files are in degrees", lambda p: _scaled(p, degrees, degrees))
    yield Guess("the headings of the estimates are in degrees", lambda p: _scaled(p, degrees, None))
    yield Guess("the headings of the truth are in degrees", lambda p: _scaled(p, None, degrees))
    both = "the headings of both files and their variances are in degrees"
    yield Guess(both, lambda p: _weighed(_scaled(p, degrees, degrees), slice(2, 3), DEGREE))


def _scaled(p: Poses, estimate: Array | None, truth: Array | None) -> Poses:
    ones = np.ones(p.estimate.shape[1])
    p = replace(p, estimate=p.estimate * (ones if estimate is None else estimate))
    p = replace(p, truth=p.truth * (ones if truth is None else truth))
    for values in (p.estimate, p.truth):
        values[:, 2] = wrap(values[:, 2])
    return p


def _units(width: int, angles: slice) -> Iterator[Guess]:
    """Millimetres and degrees; the first ``width`` components are metres."""
    part = slice(0, width)

    def shrunk(values: Array) -> Array:
        out = values.copy()
        out[:, part] *= MILLI
        return out

    yield Guess("its angles are in degrees (deg^2 for rad^2)", lambda p: _weighed(p, angles, DEGREE))
    yield Guess("its positions are in millimetres (mm^2 for m^2)", lambda p: _weighed(p, part, MILLI))
    yield Guess(
        "the positions of the estimates and their covariance are in millimetres",
        lambda p: _weighed(replace(p, estimate=shrunk(p.estimate)), part, MILLI),
    )
    yield Guess("the positions of the truth are in millimetres", lambda p: replace(p, truth=shrunk(p.truth)))
    yield Guess("the positions of the estimates are in millimetres", lambda p: replace(p, estimate=shrunk(p.estimate)))


def _weighed(p: Poses, part: slice, factor: float) -> Poses:
    scale = np.ones(p.covariance.shape[-1])
    scale[part] = factor
    return replace(p, covariance=p.covariance * scale[:, None] * scale)


def _covariances() -> Iterator[Guess]:
    yield Guess("its diagonal holds standard deviations; square them", _squared)
    yield Guess("it is an information matrix; invert it", _inverted)


def _squared(p: Poses) -> Poses:
    n = p.covariance.shape[-1]
    return replace(p, covariance=np.square(np.diagonal(p.covariance, axis1=1, axis2=2))[:, :, None] * np.eye(n))


def _inverted(p: Poses) -> Poses:
    P = np.full_like(p.covariance, np.nan)
    regular = np.abs(np.linalg.det(p.covariance)) > 0
    P[regular] = np.linalg.inv(p.covariance[regular])
    return replace(p, covariance=P)


# --- frames -----------------------------------------------------------------------------------------


def _frames(runs: Sequence[Poses]) -> Iterator[Guess]:
    """The worlds of the files differ by a turn about z and a shift, the same in all runs, or another in each."""
    frame = fitted_frame(runs)
    if frame is None or not (size := spread(runs)) > 0:
        return
    angle = np.rad2deg(frame.heading)
    if abs(angle) >= TURN or np.linalg.norm(frame.shift) >= SHIFT * size:
        turn = f"turned by {angle:.1f} degrees about z and " if abs(angle) > TURN else ""
        where = ", ".join(f"{value:.3g}" for value in frame.shift[: 3 if runs[0].manifold == "spatial" else 2])
        words = (
            f"the world of the estimates is {turn}shifted by ({where}) m to meet that of the truth; "
            f"write both in one world, or add --align posyaw{'-all' * (len(runs) > 1)}"
        )
        yield Guess(words, lambda p: moved(p, frame))
    if len(runs) > 1:
        words = "each run is turned about z and shifted by itself to meet the truth; add --align posyaw"
        yield Guess(words, lambda p: moved(p, fitted_frame([p]) or frame), last=True)
