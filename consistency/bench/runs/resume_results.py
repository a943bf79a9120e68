"""The place of results, and what of a study is there already, for a resume."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from consistency.bench.store.journal import Journal, Unfinished
from consistency.bench.store.results import StoredResults, Tables, open_results
from consistency.referee.errors import InputError
from consistency.referee.system.folders import NewFolder
from consistency.referee.system.progress import say
from consistency.referee.system.provenance import in_words, this_machine

PLAN = "until_decided"


KEYS = {
    "scenario_hash": "scenario", "log_sha256": "log", "filters": "filter", "error": "error of a filter", "seed": "seed",
    "screening": "--screen", PLAN: "plan of looks",
}  # fmt: skip


@dataclass(frozen=True)
class ResultsPlace:
    """Place of the results, with the runs ``kept`` of previous results, and those in the journal.

    ``machines`` are those that computed a part of the results, this one last.
    """

    new: NewFolder | None
    journal: Journal | None
    previous: Tables | None
    kept: frozenset[int]
    machines: list[dict[str, str]]

    @property
    def is_complete(self) -> bool:
        """Whether the place holds complete results and nothing else."""
        more = self.journal is not None and self.journal.runs
        return self.previous is not None and bool(self.previous.manifest["complete"]) and not more


@contextmanager
def place_for(
    study: Mapping[str, Any], out: Path | None, previous: Tables | None, resume: bool, overwrite: bool
) -> Iterator[ResultsPlace]:
    """The place of the results of a ``study``, which is known by :data:`KEYS`; nothing but memory without ``out``.

    With ``resume``, or where ``previous`` are the results in ``out``, what is in ``out`` and in its journal is gone on
    with, and whatever else is in the folder stays.

    Raises
    ------
    InputError
        What is there is of another study; ``out`` cannot be written, or is taken; unfinished work is in the way.
    """
    if out is None:
        yield _place(study, None, None, previous)
        return
    resume = resume or (isinstance(previous, StoredResults) and previous.folder.resolve() == out.resolve())
    with Unfinished(out, resume, overwrite) as unfinished:
        before = unfinished.journal.study
        replaces = bool(before.get("overwrite", overwrite and not resume))
        if resume and not out.exists() and unfinished.is_new:
            raise InputError(f"--out {out}: there is nothing to resume; leave --resume out")
        if resume and previous is None and not replaces and out.exists():
            previous = open_results(out)
        goes_on = resume and not replaces and out.exists()
        with NewFolder(out, "results", replaces or goes_on, goes_on, within=unfinished.path) as new:
            place = _place(study, new, unfinished.journal, previous)
            unfinished.journal.begin(dict(study) | {"overwrite": replaces, "machines": place.machines})
            try:
                yield place
            except InputError as error:
                finished = len(place.kept | unfinished.journal.runs)
                if new.is_placed or not finished or not isinstance(error.__cause__, OSError):
                    raise
                raise InputError(
                    f"{error}; {finished} finished runs are kept, and the same command with --resume continues"
                ) from error.__cause__
            finally:
                unfinished.is_over = new.is_placed


def _place(
    study: Mapping[str, Any], new: NewFolder | None, journal: Journal | None, previous: Tables | None
) -> ResultsPlace:
    sources = [{}] if previous is None else [previous.manifest]
    sources += [] if journal is None or not journal.runs else [journal.study]
    machines: list[dict[str, str]] = []
    for source in sources:
        _require_same(study, source)
        machines += [machine for machine in source.get("machines", []) if machine not in machines]
    this = this_machine()
    if others := [machine for machine in machines if machine != this]:
        say(
            f"consistency: {in_words(others)} computed the runs that are there, this is {in_words([this])}: "
            "the last digits of the others may differ from those of one machine"
        )
    kept = frozenset() if previous is None else frozenset(previous.finished_runs(study["filters"]))
    return ResultsPlace(new, journal, previous, kept, [*others, this])


def _require_same(study: Mapping[str, Any], before: Mapping[str, Any]) -> None:
    """Refuse to continue from runs of something else; a study with a fixed number of runs has no plan to differ."""
    for key, what_differs in KEYS.items() if before else ():
        value_now, value_before = study.get(key), before.get(key, {} if key == "error" else None)
        if value_now != value_before and not (key == PLAN and None in (value_now, value_before)):
            raise InputError(f"the results to resume have another {what_differs}; use the same command as before")
