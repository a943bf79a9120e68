"""Relative poses over windows: how often a right log is found at fault, and how often a wrong covariance is found.

    python benchmarks/relative_poses.py                # 500 logs a row, some five minutes
    python benchmarks/relative_poses.py --draws 100    # quicker

Logs are simulated: a robot drives, its motions err independently (in SE(2) and in SE(3)), or its poses err by a
stationary process whose cross-covariances are known. They are judged as ``consistency analyse --relative`` judges them.
The last table has the mean NEES of right motions with ever more noise: where a covariance to first order ends.
Exit status 1 if a promise is broken (binomial, 1 % for all rows together).
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.linalg import expm
from script_options import options_of

from consistency.diagnostics import Record, Verdict
from consistency.referee.diagnostics.number_of_runs import power_of
from consistency.referee.diagnostics.verdict_parts import MAIN, SHARES
from consistency.referee.geometry import composed, propagated, to_left, vectors
from consistency.referee.readers.pipeline.relative_motions import relative_recording
from consistency.referee.readers.places import Places
from consistency.referee.readers.runs_to_record import relative_of
from consistency.referee.readers.truth_matching import Manifold, Poses, make_poses
from consistency.referee.types import Array
from consistency.referee.verdicts.judge_sources import judge_all

DT, SPEED = 0.1, 1.5  # s, m/s
TURN = 0.03  # rad a step, and its spread
SIGMA = {"SE(2)": (0.02, 0.03, 0.004), "SE(3)": (0.02, 0.03, 0.02, 0.002, 0.003, 0.004)}  # m, rad: of one motion
DECLARED = {"SE(2)": "so2", "SE(3)": "so3"}
AXES = {"SE(2)": ("x", "y", "heading"), "SE(3)": ("x", "y", "z", "roll", "pitch", "yaw")}
MEMORY = 0.9  # correlation of the errors of neighbouring poses
RATE, SURE = 0.05, 0.01  # false-alarm rate of a verdict; probability that rates exactly as stated are called broken
NOISES = (0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.8)  # rad: heading over a window, stated


@dataclass(frozen=True)
class Log:
    """Matrices (N, d + 1, d + 1) of one simulated drive; the first pose is the origin."""

    group: str
    motions: Array  # (N, ...), estimated
    truth: Array  # (N + 1, ...), poses
    covariance: Array  # (N, n, n), of the motions' left errors


def hat(twist: Array) -> Array:
    """Matrices (N, d + 1, d + 1) of the Lie algebra, of twists (N, 3) or (N, 6)."""
    d = 2 if twist.shape[-1] == 3 else 3
    out = np.zeros((len(twist), d + 1, d + 1))
    out[:, :d, d] = twist[:, :d]
    turn = twist[:, d:]
    if d == 2:
        out[:, 0, 1], out[:, 1, 0] = -turn[:, 0], turn[:, 0]
        return out
    out[:, 2, 1], out[:, 0, 2], out[:, 1, 0] = turn.T
    return out - np.swapaxes(out * (np.arange(4) < 3), 1, 2)


def exp(twist: Array) -> Array:
    """Exp by SciPy's matrix exponential, (N, n) -> (N, d + 1, d + 1)."""
    return np.asarray(expm(hat(twist)))


def drive(rng: np.random.Generator, group: str, steps: int, ratio: float = 1.0, sigma: Array | None = None) -> Log:
    """A drive whose motions err independently, with ``ratio`` times the covariance that they state."""
    n = len(SIGMA[group])
    mixing = np.diag(SIGMA[group] if sigma is None else sigma) @ (
        np.eye(n) + 0.3 * rng.normal(size=(n, n)) / np.sqrt(n)
    )
    covariance = mixing @ mixing.T
    twist = np.zeros((steps, n))
    twist[:, 0] = SPEED * DT
    twist[:, n // 2 if n == 6 else 2 :] = TURN * rng.normal(size=(steps, n - 3 if n == 6 else 1))
    motions = exp(twist)
    errors = np.sqrt(ratio) * rng.normal(size=(steps, n)) @ mixing.T
    truth = composed(np.concatenate([np.eye(motions.shape[-1])[None], motions @ exp(errors)]))
    return Log(group, motions, truth, np.broadcast_to(covariance, (steps, n, n)))


def motion_stretch(log: Log, run: int = 0) -> Poses:
    """The log as a file of motions, with their covariances in the default convention."""
    kind, start = DECLARED[log.group], np.eye(log.truth.shape[-1])[None]
    P = propagated(np.linalg.inv(to_left(log.motions, kind)), log.covariance)
    estimate = vectors(np.concatenate([start, log.motions]))
    covariance = np.concatenate([np.zeros((1, *P.shape[1:])), P])
    return _run("motions", DT * np.arange(len(log.truth)), estimate, covariance, vectors(log.truth), kind, run)


def _run(
    file: str, t: Array, estimate: Array, P: Array, truth: Array, kind: str, run: int, cross: Array | None = None
) -> Poses:
    """Rows with their truth beside them."""
    place = Places(lambda row: f"row {row}", np.arange(len(t)))
    manifold: Manifold = "planar" if P.shape[-1] == 3 else "spatial"
    stated = np.ones(len(t), bool)
    of_run = {"cross": cross, "run": run, "files": (file, file)}
    return make_poses(place, t, estimate, P, stated, t, truth, manifold, kind, 0.0, **of_run)


def pose_stretch(rng: np.random.Generator, group: str, poses: int, apart: int, ratio: float, run: int) -> Poses:
    """A log of poses ``apart`` steps from each other that err by a stationary process, with cross-covariances."""
    log = drive(rng, group, poses * apart)
    T, S = log.truth[apart::apart], log.covariance[0]
    root, left = np.linalg.cholesky(S), np.empty((poses, len(S)))
    left[0] = rng.normal(size=len(S))
    for k in range(1, poses):
        left[k] = MEMORY * left[k - 1] + np.sqrt(1.0 - MEMORY**2) * rng.normal(size=len(S))
    truth = T @ exp(np.sqrt(ratio) * left @ root.T)
    J = np.linalg.inv(to_left(T, DECLARED[group]))
    cross = np.full((poses, *S.shape), np.nan)
    cross[1:] = J[:-1] @ (MEMORY * S) @ np.swapaxes(J[1:], 1, 2)
    t = DT * apart * np.arange(poses)
    return _run("poses", t, vectors(T), propagated(J, S), vectors(truth), DECLARED[group], run, cross)


def recorded(stretches: list[Poses], size: str, motions: bool) -> Record:
    """Windows as ``consistency analyse --relative`` takes them."""
    axes = AXES["SE(2)" if stretches[0].d == 2 else "SE(3)"]
    relative = relative_of(size, motions)
    assert relative is not None
    return relative_recording("log", "log", stretches, axes, range(len(axes)), relative)


def verdict_on(record: Record) -> Verdict:
    return judge_all([record])["log"]


@dataclass(frozen=True)
class Row:
    """One kind of log and what became of its verdicts."""

    what: str
    windows: int
    ratio: float
    found: int
    draws: int
    stated: float

    @property
    def p_value(self) -> float:
        """Of the promise: at most the rate, or at least the power."""
        if self.ratio == 1.0:
            return float(stats.binom.sf(self.found - 1, self.draws, self.stated))
        return float(stats.binom.cdf(self.found, self.draws, self.stated))

    def line(self) -> str:
        low, high = stats.binomtest(self.found, self.draws).proportion_ci(0.95, "exact")
        bound = "≤" if self.ratio == 1.0 else "≥"
        share = f"{self.found / self.draws:.1%} [{low:.1%}, {high:.1%}]"
        return f"| {self.what} | {self.windows} | x{self.ratio:g} | {bound} {self.stated:.1%} | {share} |"


def rows(draws: int, seed: int) -> Iterator[Row]:
    """False alarms of any question, then power of the scale, of independent motions; then of poses."""
    cases = [(g, size, 600) for g in SIGMA for size in ("10", "2s", "9m")] + [
        ("SE(2)", "1", 100),
        ("SE(3)", "100", 3000),
    ]
    ratios = (1.0, 1.5, 0.6)
    for number, (group, size, steps) in enumerate(cases):
        for ratio in ratios if (group, size) in (("SE(2)", "10"), ("SE(3)", "2s"), ("SE(2)", "9m")) else (1.0,):
            found, windows = 0, 0
            for k in range(draws):
                rng = np.random.default_rng((seed, number, round(100 * ratio), k))
                record = recorded([motion_stretch(drive(rng, group, steps, ratio))], size, True)
                verdict = verdict_on(record)
                windows = verdict.runs
                found += bool(verdict.faults) if ratio == 1.0 else MAIN in verdict.faults
            n = len(SIGMA[group])
            power = RATE if ratio == 1.0 else power_of(n, windows, ratio, SHARES[MAIN] * RATE)
            yield Row(f"{group} motions, windows of {size}", windows, ratio, found, draws, power)
    for number, group in enumerate(SIGMA):
        found = 0
        for k in range(draws):
            rng = np.random.default_rng((seed, 77, number, k))
            runs = [pose_stretch(rng, group, 21, 5, 1.0, run) for run in range(30)]
            found += bool(verdict_on(recorded(runs, "1", False)).faults)
        yield Row(f"{group} poses with cross-covariances, 30 runs", 20, 1.0, found, draws, RATE)


def first_order(draws: int, seed: int) -> Iterator[str]:
    """Mean NEES over its dimension of windows of 100 right motions, by the stated sigma of a rotation over one."""
    for number, noise in enumerate(NOISES):
        cells = []
        for group in SIGMA:
            values = []
            for k in range(draws):
                rng = np.random.default_rng((seed, 78, number, k))
                n = len(SIGMA[group])
                sigma = np.array(SIGMA[group])
                sigma[n // 2 if n == 6 else 2 :] = noise / 10.0  # of each of 100 motions
                record = recorded([motion_stretch(drive(rng, group, 1000, 1.0, sigma))], "100", True)
                assert record.errors.nees is not None
                values += list(record.errors.nees.ravel() / n)
            error = np.std(values) / np.sqrt(len(values))
            cells.append(f"{np.mean(values):.3f} ± {error:.3f}")
        yield f"| {noise:g} | {' | '.join(cells)} |"


def main() -> None:
    options = options_of(
        __doc__,
        draws=(500, "logs a row"),
        seed=(60607, None),
    )
    print("| log | windows | ratio | promised | found |\n| --- | --- | --- | --- | --- |", flush=True)
    measured = []
    for row in rows(options.draws, options.seed):
        measured.append(row)
        print(row.line(), flush=True)
    print("\n| sigma of a rotation over a window, rad | SE(2) | SE(3) |\n| --- | --- | --- |", flush=True)
    for line in first_order(max(options.draws // 5, 2), options.seed):
        print(line, flush=True)
    broken = [row for row in measured if row.p_value * len(measured) <= SURE]
    print(f"\npromises broken: {len(broken)}", *(row.line() for row in broken), sep="\n")
    sys.exit(1 if broken else 0)


if __name__ == "__main__":
    main()
