"""Frozen records that worlds, filters and runs share, with the shape of each field."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from consistency.referee.types import Array, Failure, Indices

# guards, which say which observations a filter is given
GUARDS = {
    "gate": "chi-square gate of each observation by its own innovation",
    "joint": "largest set of observations that is jointly compatible",
    "ransac": "one-point RANSAC: the observations that agree with the best hypothesis from one of them",
}


@dataclass(frozen=True)
class Gaussian:
    """A mean and its covariance, SI units and radians."""

    mean: Array  # (n,)
    covariance: Array  # (n, n)


@dataclass(frozen=True)
class Control:
    """Odometry of one step, as given to the filter."""

    dt: float  # s
    v: float  # m/s, along the heading
    omega: float  # rad/s, counter-clockwise


@dataclass(frozen=True)
class Observation:
    """All landmarks seen in one step; association is known."""

    landmarks: Indices  # (m,)
    z: Array  # (m, s): (x, y, z) in m, (u, v, d) in px, (dx, dy) in m, or range in m and bearing in rad


@dataclass(frozen=True)
class Info:
    """Innovation of an update; diagnostics read this and never the internals of a filter."""

    innovation: Array  # (k,), z minus predicted z of the landmarks already in the state
    S: Array  # (k, k), innovation covariance
    gain: Array  # (n, k)

    @property
    def nis(self) -> float:
        """Normalized innovation squared, innovation' S^-1 innovation."""
        return float(self.innovation @ np.linalg.solve(self.S, self.innovation))

    @property
    def log_det(self) -> float:
        """log det S."""
        return float(np.linalg.slogdet(self.S)[1])


@dataclass(frozen=True)
class Trial:
    """One data set, simulated or recorded: the input of a filter, and the truth where known.

    Step k = 1..T moves the robot from k-1 to k, then observes. The observations of step k are the
    rows ``first[k-1]:first[k]``.

    A filter gets the ids in ``landmark``. Row i of ``landmarks`` is the position of landmark i; ids from N on are false
    landmarks. ``source`` is for scoring alone: the true landmark of a row, -1 if there is none. If it is None, each row
    is of its ``landmark``.
    """

    run: int
    start: Array  # (3,), pose at step 0, known exactly
    controls: Array  # (T, 3): dt, v, omega
    first: Indices  # (T + 1,)
    landmark: Indices  # (M,), id in 0..n_landmarks-1
    z: Array  # (M, s)
    n_landmarks: int  # number of ids, those of things that are not landmarks included: at least N
    truth: Array | None = None  # (T + 1, 3): x, y, heading (not wrapped)
    landmarks: Array | None = None  # (N, 3), true positions in the world
    source: Indices | None = None  # (M,), in 0..N-1 or -1
    labels: Indices | None = None  # (n_landmarks,), numbers in the files; the ids themselves where None
    seed: int = 0  # of the study; 0 for a recorded log

    def __post_init__(self) -> None:
        # read-only views: one filter cannot change what the next one is given
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                view = value.view()
                view.flags.writeable = False
                object.__setattr__(self, name, view)

    @property
    def steps(self) -> int:
        return len(self.controls)

    @property
    def t(self) -> Array:
        """Time of steps 0..T in seconds, shape (T + 1,)."""
        return np.concatenate([[0.0], np.cumsum(self.controls[:, 0])])

    @property
    def step(self) -> Indices:
        """Step 1..T of a row, shape (M,)."""
        return np.repeat(np.arange(1, self.steps + 1), np.diff(self.first))

    @property
    def spurious(self) -> Array:
        """Whether a row is not of the landmark that it states, shape (M,)."""
        return np.zeros(len(self.landmark), bool) if self.source is None else self.source != self.landmark

    @property
    def things(self) -> Indices:
        """Ids (things,) that are not landmarks in any of their rows, sorted: what a score of the map leaves out."""
        if self.source is None:
            return np.zeros(0, np.int64)
        return np.setdiff1d(self.landmark, self.source)

    def control(self, step: int) -> Control:
        """Control of step 1..T."""
        return Control(*(float(value) for value in self.controls[step - 1]))

    def observation(self, step: int) -> Observation:
        """Observation of step 1..T."""
        rows = slice(self.first[step - 1], self.first[step])
        return Observation(self.landmark[rows], self.z[rows])


@dataclass(frozen=True)
class Map:
    """Landmarks that a filter has estimated, as points in the world, m."""

    landmarks: Indices  # (K,), sorted
    mean: Array  # (K, 3)
    covariance: Array  # (K, 3, 3)
    joint: Array | None = None  # (3 + 3 K, 3 + 3 K), of the additive errors of pose and landmarks; None if not given


@dataclass(frozen=True)
class Estimates:
    """What a filter said in one run; rows from the step of a failure on are NaN."""

    filter: str
    run: int
    pose: Array  # (T, 3)
    covariance: Array  # (T, 3, 3)
    nis: Array  # (T,), NaN where no known landmark was seen
    nis_dof: Indices  # (T,)
    failure: Failure | None = None
    error: str = "so2"  # convention of the error that ``own`` is the covariance of
    own: Array | None = None  # (T, 3, 3), where that error is not the additive one of the world
    map: Map | None = None  # after the last step; None where the filter gives none or the run failed
    rejected: Array | None = None  # (M,), observations that a guard kept from the filter; None without a guard
    log_det: Array | None = None  # (T,), log det S of the innovations of ``nis``, NaN where there is none


OURS = "this project"  # how the source of a question begins that no paper asks


def outcome(source: str, verdict: str) -> str:
    """The verdict on a finding in words: a conjecture of ours holds, is refuted, or is not shown."""
    if not source.startswith(OURS):
        return verdict
    return {"reproduced": "holds", "refuted": "refuted"}.get(verdict, "not shown")


@dataclass(frozen=True)
class Finding:
    """One published claim and what was measured; ``accept`` was written before the run."""

    id: str
    source: str  # paper and place
    claim: str
    statistic: str  # what is measured
    published: str
    measured: str
    accept: str  # numeric rule and its reason
    verdict: str  # reproduced | not reproduced | not shown (the runs decide neither) | refuted
    runs: int
    seed: int
    scenario: str
