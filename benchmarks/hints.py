"""Mix-ups that are named, from which factor on, and honest logs that get a hint.

    python benchmarks/hints.py                # 1,200 honest logs, 20 logs a cell
    python benchmarks/hints.py --logs 200 --cells 5

A mix-up is made worse step by step; the first column has the smallest factor (of the variance of one axis to that of
another, or of a variance to 1 in its unit) from which on at least 9 of 10 logs are told so. Honest logs are of filters
that are right, and of filters that are wrong: a covariance 1/4 to 4 times as large in all axes or in one, a bias, heavy
tails, a drift. Several kinds of state, sizes, units, numbers of runs, and correlations of neighbouring steps. Exit
status 1 if more than 6 of 1,200 honest logs get a hint (as large a share of another number).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from calibration_gates import stationary
from scipy.spatial.transform import Rotation
from script_options import options_of

from consistency.referee.geometry import wrap
from consistency.referee.readers.formats.sheet import Places
from consistency.referee.readers.mix_ups.hints import hints
from consistency.referee.readers.truth_matching import Poses
from consistency.referee.types import Array

AXES = {
    "spatial": ("x", "y", "z", "roll", "pitch", "yaw"), "planar": ("x", "y", "heading"),
    "vector": ("a", "b", "c", "d"), "scalar": ("a",),
}  # fmt: skip
SIZES = ((1, 200), (1, 1500), (5, 100), (20, 50), (40, 30))  # runs, steps
MEMORY = (0.0, 0.5, 0.9, 0.98, 0.999)
WRONG = ("right", "all", "axis", "bias", "tails", "drift")
PROMISE = 6 / 1200
SPREAD = 4.0  # of variances among axes of one kind, at most, where a log does not say otherwise
Mess = Callable[[Poses], Poses]


def log(
    rng: np.random.Generator, kind: str, runs: int, steps: int, rho: float, wrong: str = "right",
    sigma: Array | None = None, convention: str | None = None, correlated: bool = True,
) -> list[Poses]:  # fmt: skip
    """Runs of an estimator whose errors have the stated covariance, but for what is ``wrong``.

    Parameters
    ----------
    sigma : (n,), standard deviations; drawn where None
    rho : correlation of the errors of neighbouring steps
    """
    n = len(AXES[kind])
    convention = convention or {"spatial": "so3", "planar": "so2"}.get(kind, "vector")
    P = covariance(rng, sizes(rng, kind) if sigma is None else sigma, correlated)
    L, factor, bias = np.linalg.cholesky(P), np.ones(n), np.zeros(n)
    odd = rng.integers(n)
    if wrong in ("all", "axis"):
        factor[slice(None) if wrong == "all" else odd] = np.exp(rng.uniform(-np.log(4.0), np.log(4.0)))
    if wrong == "bias":
        bias[odd] = rng.uniform(0.5, 3.0)
    found = []
    for _ in range(runs):
        w = noise(rng, steps, n, rho, wrong == "tails")
        if wrong == "drift":
            w = w * np.sqrt(np.linspace(0.3, 4.0, steps))[:, None]
        grown = np.exp(0.5 * np.sin(np.linspace(0.0, rng.uniform(1.0, 9.0), steps)))
        e = (w @ L.T * np.sqrt(factor) + bias * np.sqrt(np.diag(P))) * grown[:, None]
        found.append(run_of(rng, kind, convention, e, P * np.square(grown)[:, None, None]))
    return found


def sizes(rng: np.random.Generator, kind: str) -> Array:
    """Standard deviations: positions 1 mm to 10 m, angles 0.05 to 5 degrees, states of any unit."""

    def block(n: int, low: float, high: float) -> Array:
        return np.asarray(
            np.exp(rng.uniform(np.log(low), np.log(high)) + rng.uniform(-0.5, 0.5, n) * 0.5 * np.log(SPREAD))
        )

    if kind == "spatial":
        return np.concatenate([block(3, 1e-3, 10.0), block(3, 1e-3, 0.1)])
    if kind == "planar":
        return np.concatenate([block(2, 1e-3, 10.0), block(1, 1e-3, 0.1)])
    return np.concatenate([block(1, 1e-3, 30.0) for _ in AXES[kind]])


def covariance(rng: np.random.Generator, sigma: Array, correlated: bool) -> Array:
    n = len(sigma)
    root = np.eye(n) + (0.3 * rng.normal(size=(n, n)) if correlated else 0.0)
    R = root @ root.T
    scale = sigma / np.sqrt(np.diag(R))
    return np.asarray(R * np.outer(scale, scale))


def noise(rng: np.random.Generator, steps: int, n: int, rho: float, tails: bool) -> Array:
    w = rng.standard_t(4, (steps, n)) / np.sqrt(2.0) if tails else rng.normal(size=(steps, n))
    return stationary(w, rho)


def run_of(rng: np.random.Generator, kind: str, convention: str, e: Array, P: Array) -> Poses:
    """A drive, or states, whose truth is the estimate and the error ``e`` (steps, n)."""
    steps, n = e.shape
    t = 0.1 * np.arange(steps)
    heading = rng.uniform(-3.0, 3.0) + np.cumsum(rng.normal(0.0, 0.1, steps))
    at = np.cumsum(0.5 * np.column_stack([np.cos(heading), np.sin(heading), 0.1 * np.sin(t)]), axis=0)
    manifold = kind
    if kind == "spatial":
        turn = Rotation.from_euler("ZYX", np.column_stack([heading, 0.1 * np.sin(t), 0.1 * np.cos(2 * t)]))
        small = Rotation.from_rotvec(e[:, 3:])
        true = turn * small if convention == "so3-body" else small * turn
        own, truth = np.hstack([at, turn.as_quat()]), np.hstack([at + e[:, :3], true.as_quat()])
    elif kind == "planar":
        own = np.column_stack([at[:, :2], wrap(heading)])
        truth = own + e
        truth[:, 2] = wrap(truth[:, 2])
    else:
        manifold = "vector"
        own = np.cumsum(rng.normal(size=(steps, n)), axis=0)
        truth = own + e
    place = Places("line {}".format, np.arange(steps))
    return Poses(place, t, own, P, np.ones(steps, bool), t, truth, manifold, convention, 0.01)  # type: ignore[arg-type]


def honest(rng: np.random.Generator, number: int) -> tuple[str, list[str]]:
    """What is wrong with a log, and the hints that it gets."""
    kind, wrong = list(AXES)[number % len(AXES)], WRONG[number // len(AXES) % len(WRONG)]
    runs, steps = SIZES[rng.integers(len(SIZES))]
    poses = log(rng, kind, runs, steps, MEMORY[rng.integers(len(MEMORY))], wrong)
    return f"{kind}, {wrong}", hints("est", AXES[kind], poses)


# --- mix-ups ----------------------------------------------------------------------------------------


def reordered(order: list[int]) -> Mess:
    return lambda p: replace(p, covariance=p.covariance[:, order][:, :, order])


def states_reordered(order: list[int]) -> Mess:
    return lambda p: replace(reordered(order)(p), estimate=p.estimate[:, order])


def read_as(convention: str) -> Mess:
    return lambda p: replace(p, convention=convention)


def deviations(p: Poses) -> Poses:
    sigma = np.sqrt(np.diagonal(p.covariance, axis1=1, axis2=2))
    return replace(p, covariance=sigma[:, :, None] * np.eye(sigma.shape[1]))


def information(p: Poses) -> Poses:
    return replace(p, covariance=np.linalg.inv(p.covariance))


def alone(p: Poses) -> Poses:
    return replace(p, true_t=p.t, truth=p.estimate.copy())


def one_axis(kind: str, axis: int, base: float = 0.05) -> Callable[[float], Array]:
    """One standard deviation larger than the others by the root of a factor."""
    return lambda factor: base * np.sqrt(np.where(np.arange(len(AXES[kind])) == axis, factor, 1.0))


def all_axes(kind: str) -> Callable[[float], Array]:
    """All variances smaller than 1 by a factor, alike."""
    return lambda factor: np.full(len(AXES[kind]), factor**-0.5)


def unlike_axes(kind: str) -> Callable[[float], Array]:
    """Variances from 1 down to a factor below it."""
    return lambda factor: np.geomspace(1.0, factor**-0.5, len(AXES[kind]))


SMALL, LARGE = (1.2, 1.5, 2.0, 3.0, 5.0), (4.0, 8.0, 12.0, 20.0, 50.0, 100.0, 200.0)
# name: kind, true convention, sizes by factor, mix-up, factors, what the hint says
MIXED: dict[str, tuple[str, str | None, Callable[[float], Array], Mess, tuple[float, ...], str]] = {
    "covariance x, y swapped (planar)": (
        "planar", None, one_axis("planar", 0), reordered([1, 0, 2]), SMALL, "order y, x",
    ),
    "covariance heading first (planar)": (
        "planar", None, one_axis("planar", 2), reordered([2, 0, 1]), SMALL, "components of the covariance",
    ),
    "covariance a, b swapped (state)": (
        "vector", None, one_axis("vector", 0), reordered([1, 0, 2, 3]), SMALL, "components of the covariance",
    ),
    "covariance x, y swapped (space)": (
        "spatial", None, one_axis("spatial", 0), reordered([1, 0, 2, 4, 3, 5]), SMALL, "order y, x, z",
    ),
    "blocks in the other order": (
        "spatial", None, lambda f: 0.05 * np.repeat([np.sqrt(f), 1.0], 3), reordered([3, 4, 5, 0, 1, 2]), SMALL,
        "--covariance-order",
    ),
    "so3-body read as so3": (
        "spatial", "so3-body", one_axis("spatial", 3), read_as("so3"), SMALL, "--error so3-body",
    ),
    "so3 read as so3-body": ("spatial", "so3", one_axis("spatial", 4), read_as("so3-body"), SMALL, "(--error so3)"),
    "states in another order": (
        "vector", None, lambda _: np.full(4, 0.05), states_reordered([1, 0, 2, 3]), (1.0,),
        "components of the estimates",
    ),
    "deviations, axes alike (planar)": ("planar", None, all_axes("planar"), deviations, LARGE, "standard deviations"),
    "deviations, axes unlike (planar)": (
        "planar", None, unlike_axes("planar"), deviations, LARGE, "standard deviations",
    ),
    "deviations, axes unlike (space)": (
        "spatial", None, unlike_axes("spatial"), deviations, LARGE, "standard deviations",
    ),
    "information, axes alike (planar)": ("planar", None, all_axes("planar"), information, LARGE, "information"),
    "information, axes unlike (state)": ("vector", None, unlike_axes("vector"), information, LARGE, "information"),
    "truth and estimates one file": ("spatial", None, lambda _: np.full(6, 0.05), alone, (1.0,), "the same file"),
}  # fmt: skip


def named(
    rng: np.random.Generator, name: str, factor: float, runs: int = 10, steps: int = 60, rho: float = 0.5
) -> bool:
    """Whether a log with this mix-up is told so."""
    kind, convention, sigma, mess, _, words = MIXED[name]
    plain = name.startswith("deviations")
    right = log(rng, kind, runs, steps, rho, sigma=sigma(factor), convention=convention, correlated=not plain)
    return any(words in hint for hint in hints("est", AXES[kind], [mess(p) for p in right]))


def smallest(rng: np.random.Generator, name: str, cells: int) -> str:
    shares = {f: sum(named(rng, name, f) for _ in range(cells)) / cells for f in MIXED[name][4]}
    least = next((f for f in shares if all(shares[g] >= 0.9 for g in shares if g >= f)), None)
    text = ", ".join(f"x{f:g} {100 * share:.0f} %" for f, share in shares.items())
    return f"{'-' if least is None else f'x{least:g}':>6}  {text}"


def main() -> int:
    given = options_of(
        __doc__.splitlines()[0] if __doc__ else "",
        logs=(1200, "Honest logs."),
        cells=(20, "Logs of each mix-up and factor; 0 for none."),
        seed=(5, None),
    )
    for number, name in enumerate(MIXED if given.cells else ()):
        print(f"{name:<36} {smallest(np.random.default_rng((given.seed, number)), name, given.cells)}", flush=True)
    found: dict[str, int] = dict.fromkeys((f"{k}, {w}" for k, w in itertools.product(AXES, WRONG)), 0)
    for number in range(given.logs):
        label, said = honest(np.random.default_rng((given.seed, 99, number)), number)
        found[label] += bool(said)
        for hint in said:
            print(f"  honest ({label}): {hint}", flush=True)
    total = sum(found.values())
    print(f"honest logs with a hint: {total} of {given.logs}")
    return int(total > PROMISE * given.logs)


if __name__ == "__main__":
    raise SystemExit(main())
