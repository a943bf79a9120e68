"""What a report says: every number in it, apart from how it is shown."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from consistency.diagnostics import Verdict
from consistency.reporting.calibration import Calibration
from consistency.types import Array, Failure, Gaussian, Indices

SINGLE_RUN = 1


@dataclass(frozen=True)
class Track:
    """One filter in one study; T steps. Rows are NaN where the filter had no estimate."""

    name: str
    style: int  # the same number for the same filter in the whole report
    verdict: Verdict
    path: Array  # (T, 2), m, of the shown run
    error: Array | None  # (T, 3), m, m, deg, truth minus estimate of the shown run
    sigma: Array  # (T, 3), m, m, deg, stated standard deviation
    anees: Array | None  # (T,)
    band: Array | None  # (T, 2), where the ANEES of a consistent filter lies in one step
    simultaneous: Array | None  # (T, 2), where it lies in all steps at once
    own_band: bool  # failed runs have made the bands differ from those of the study
    nis_ratio: Array  # (T,), NIS of all runs over their degrees of freedom
    nis_log: bool
    failures: tuple[Failure, ...]  # of all runs, also of those after the look that decided

    @property
    def expected(self) -> float:
        """Mean NEES of a right filter; NaN where the truth is not known."""
        return float("nan") if self.verdict.scale is None else float(self.verdict.scale.dof)

    @property
    def innovations_judged(self) -> bool:
        """Whether the filter declares an optimal gain; innovations of any other are reported only."""
        return self.verdict.innovations is not None and self.verdict.innovations.judged


@dataclass(frozen=True)
class Study:
    """Filters on one scenario or one log."""

    name: str
    summary: str
    runs: int
    shown_run: int
    steps: Indices  # (T,), 1..T
    tracks: tuple[Track, ...]
    true_path: Array | None  # (T + 1, 2), m
    odometry: Array | None  # (T + 1, 2), m
    landmarks: Array | None  # (N, 2), m
    anees_log: bool
    nis_log: bool
    is_log: bool
    until_decided: bool  # each verdict is that of the look that decided it
    provenance: tuple[tuple[str, str], ...]
    resolved: str  # the scenario, or the log's belief, as JSON

    @property
    def has_truth(self) -> bool:
        return any(track.anees is not None for track in self.tracks)

    @property
    def single(self) -> bool:
        """One run: the curve is a NEES, no average."""
        return self.runs == SINGLE_RUN

    @property
    def statistic(self) -> str:
        return "NEES" if self.single else "ANEES"

    @property
    def common_band(self) -> Track | None:
        """The filter whose bands are those of the study."""
        return next((t for t in self.tracks if t.band is not None and not t.own_band), None)

    @property
    def failures(self) -> list[tuple[str, int, int, str]]:
        """Filter, run, step and reason of every failed run."""
        return [
            (track.name, int(failure.run), int(failure.step), failure.reason)
            for track in self.tracks
            for failure in track.failures
        ]


@dataclass(frozen=True)
class Distribution:
    """Eq. 21 applied to Gaussian (u, d) for one baseline, as Herath et al. (2007) fig. 12."""

    baseline: float  # m
    samples: int
    points: Array  # (n, 2), m, the samples drawn
    window: tuple[tuple[float, float], tuple[float, float]]  # drawn range of x and y, m
    outside: float  # share of samples beyond the drawn range
    edges: Array  # (b + 1,), m
    density: Array  # (b,), 1/m
    grid: Array  # (g,), m
    linear: Gaussian  # J diag(sigma^2) J' at the true point
    fitted: Gaussian  # moments of the samples
    linear_ellipse: Array  # (m, 2), 2 sigma
    fitted_ellipse: Array
    linear_density: Array  # (g,), 1/m
    fitted_density: Array


@dataclass(frozen=True)
class Shares:
    """Repetitions inside the 95 % region against depth, as Valencia & Andrade-Cetto (2018) fig. 2.2; n depths."""

    depth: Array  # (n,), m
    share: Array  # (n,), of the repetitions
    expected: float
    accepted: tuple[float, float]  # least and greatest share that the binomial test accepts
    false_alarm: float  # of that test at one depth
    noise: float  # px
    samples: int  # of a repetition
    repetitions: int


@dataclass(frozen=True)
class Scene:
    """N times the mean NEES of one scene over its degrees of freedom, as Valencia & Andrade-Cetto (2018) fig. 2.3."""

    far: float  # m
    noise: float  # px
    repetitions: int
    ratio: float  # mean of the repetitions; 1 is right
    spread: tuple[float, float]  # of the middle 95 % of the repetitions

    @property
    def label(self) -> str:
        """Depth, noise and number of repetitions."""
        return f"{self.far:g} m, {self.noise:g} px ({self.repetitions}×)"


@dataclass(frozen=True)
class Scenes:
    """All scenes, and what is the same in them."""

    scenes: tuple[Scene, ...]
    region: tuple[float, float]  # where one repetition lies, of the degrees of freedom
    confidence: float  # of the region
    near: float  # m
    points: int
    samples: int  # of a repetition
    dof: int

    @property
    def window(self) -> tuple[float, float]:
        """Drawn range: all values, the region and some room."""
        ends = [end for scene in self.scenes for end in (scene.ratio, *scene.spread)]
        return min(self.region[0], *ends) - 0.03, max(self.region[1], *ends) + 0.03


@dataclass(frozen=True)
class Cells:
    """One estimator over n cells of depth, baseline and pixel noise."""

    estimator: str
    ratio: Array  # (n,), noise of the disparity over the disparity
    nees: Array  # (n,), mean NEES over its degrees of freedom, NaN where no run was left
    accepted: Array  # (n,), bool: the verdict is consistent

    @property
    def title(self) -> str:
        """Name, and how many cells are accepted."""
        return f"{self.estimator}: {int(self.accepted.sum())} of {len(self.accepted)} accepted"


@dataclass(frozen=True)
class FirstOrder:
    """Where first order breaks, estimator by estimator."""

    estimators: tuple[Cells, ...]
    runs: int  # of a cell
    failed: int  # of all runs of all cells
    points: int  # of a registration
    false_alarm: float  # of a verdict
    holds: float  # noise over disparity up to which first order is asked to hold


@dataclass(frozen=True)
class FrontEnd:
    """What was measured of the stereo front-end on synthetic matches; None where a table is not there."""

    shares: Shares | None
    scenes: Scenes | None
    first_order: FirstOrder | None

    def __bool__(self) -> bool:
        return any(part is not None for part in (self.shares, self.scenes, self.first_order))


@dataclass(frozen=True)
class Report:
    """All of it."""

    title: str
    answer: str
    studies: tuple[Study, ...]
    findings: tuple[dict[str, Any], ...]
    distributions: tuple[Distribution, ...]
    front_end: FrontEnd
    calibration: Calibration | None
    provenance: tuple[tuple[str, str], ...]

    @property
    def filters(self) -> list[tuple[str, int]]:
        """Names and style numbers, each filter once."""
        return list(dict.fromkeys((track.name, track.style) for study in self.studies for track in study.tracks))
