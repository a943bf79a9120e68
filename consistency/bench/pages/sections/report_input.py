"""What the sections of a report read: the results of every filter in every study, and the verdicts on them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from consistency.referee.diagnostics.record import Record
from consistency.referee.pages.verdicts import Estimator, Judged
from consistency.referee.types import Array

if TYPE_CHECKING:
    from consistency.bench.store.results import Tables

STEREO = "herath2007-stereo"  # the sensor of the paper, with its baseline of 9 cm


@dataclass(frozen=True)
class Track(Estimator):
    """One filter of the bench in one study; R runs of T steps."""

    shown: Record  # of the shown run alone; NaN where the filter had no estimate
    nis_ratio: Array  # (T,), NIS of the runs of the verdict over their degrees of freedom
    record: Callable[[], Record]  # all R runs, read at each call: a report holds those of one filter at a time, if any


@dataclass(frozen=True)
class Study(Judged):
    """Filters on one scenario or one log."""

    tracks: tuple[Track, ...]
    results: Tables

    @property
    def is_log(self) -> bool:
        return self.results.scenario is None


@dataclass(frozen=True)
class Report:
    """A folder of ``consistency run`` or ``consistency reproduce``."""

    folder: Path
    manifest: dict[str, Any]
    studies: tuple[Study, ...]
    findings: tuple[dict[str, Any], ...]

    @property
    def title(self) -> str:
        if "studies" in self.manifest:
            return "Stereo vision based SLAM: which filter tells the truth about its uncertainty?"
        return f"Filter consistency: {self.studies[0].name}"

    @property
    def main(self) -> Study | None:
        """The study of the paper's stereo sensor, where there is one."""
        return next((study for study in self.studies if study.name == STEREO), None)
