"""Sources of records: records themselves, and results of the bench, whose code is loaded when it is needed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from consistency.referee.diagnostics import Record
from consistency.referee.errors import InputError
from consistency.referee.outside import outside

if TYPE_CHECKING:
    from consistency.referee.diagnostics import Design


class Results(Protocol):
    """Results of filters of the bench, in memory or in a folder, as ``consistency.run_trials`` returns them."""

    @property
    def filters(self) -> list[str]:
        """Names."""

    @property
    def batches(self) -> Callable[..., Any]:
        """Reads the rows of a table, some at a time."""


@dataclass(frozen=True)
class Source:
    """Records of several estimators on the same trials, each read when it is asked for."""

    filters: Sequence[str]
    record: Callable[[str], Record]  # by name; raises InputError of a name that is not there
    design: Callable[[], Design | None] = lambda: None  # looks at growing numbers of runs, if they were run by one
    has_truth: bool = True  # False: no record has a NEES
    scenario: str | None = None
    trials: tuple[Any, Any] = (None, None)  # scenario hash and seed, or what a log holds: equal for the same trials
    unfinished: str = ""  # number of runs, where some are missing


def source_of(of: Source | Sequence[Record] | Results | str | Path) -> Source:
    """Records, or results of the bench, in memory or in a folder, as a source."""
    if isinstance(of, Source):
        return of
    if not isinstance(of, list | tuple):
        source: Source = outside("results")(of)
        return source
    named: dict[str, Record] = {record.name: record for record in of}

    def record(name: str) -> Record:
        if name not in named:
            raise InputError(f"--filter {name}: is not in these files; there are: {', '.join(named)}")
        return named[name]

    return Source(list(named), record)
