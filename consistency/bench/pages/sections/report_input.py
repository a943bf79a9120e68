"""What the sections of a report read: the results of every filter in every study, and the verdicts on them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from consistency.referee.diagnostics.records.record import Record
from consistency.referee.pages.judged import Estimator, Judged
from consistency.referee.types import Array

if TYPE_CHECKING:
    from consistency.bench.store.results import Tables


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
        name = "reproduction" if "studies" in self.manifest else self.studies[0].name
        return f"Filter consistency: {name}"
