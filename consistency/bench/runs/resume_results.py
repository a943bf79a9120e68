"""What of a study is there already, in a folder of results and in a journal, and may be continued."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from consistency.bench.runs.outcomes_to_results import Gathered
from consistency.bench.store.journal import IN_MEMORY, Journal, Unfinished
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


@contextmanager
def gathered_in(
    study: Mapping[str, Any],
    out: Path | None,
    previous: Tables | None,
    resume: bool,
    overwrite: bool,
    journal: Journal | None = None,
) -> Iterator[Gathered]:
    """Yield what there is of a ``study``, which is known by :data:`KEYS`, to be continued.

    Results go to ``out``, or stay in memory. A ``journal`` in its place keeps the finished runs of results in memory.
    With ``resume``, or where ``previous`` are the results in ``out``, what is in ``out`` and in its journal is
    continued, and whatever else is in the folder stays.

    Raises
    ------
    InputError
        What is there is of another study; ``out`` cannot be written, or is taken; unfinished work is in the way.
    """
    if journal is not None:
        yield Gathered(study["filters"], study["error"], journal)
        return
    if out is None:
        with closing(Journal(IN_MEMORY)) as in_memory:
            yield _gathered(study, in_memory, None, previous)
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
            gathered = _gathered(study, unfinished.journal, new, previous)
            machines = [*gathered.other_machines, this_machine()]
            unfinished.journal.begin(dict(study) | {"overwrite": replaces, "machines": machines})
            try:
                yield gathered
            except InputError as error:
                finished = len(gathered.finished)
                if new.is_placed or not finished or not isinstance(error.__cause__, OSError):
                    raise
                raise InputError(
                    f"{error}; {finished} finished runs are kept, and the same command with --resume continues"
                ) from error.__cause__
            finally:
                unfinished.is_over = new.is_placed


def _gathered(study: Mapping[str, Any], journal: Journal, new: NewFolder | None, previous: Tables | None) -> Gathered:
    sources = [{}] if previous is None else [previous.manifest]
    sources += [journal.study] if journal.runs else []
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
    return Gathered(study["filters"], study["error"], journal, new, previous, others)


def _require_same(study: Mapping[str, Any], before: Mapping[str, Any]) -> None:
    """Refuse to continue from runs of something else; a study with a fixed number of runs has no plan to differ."""
    for key, what_differs in KEYS.items() if before else ():
        value_now, value_before = study.get(key), before.get(key, {} if key == "error" else None)
        if value_now != value_before and not (key == PLAN and None in (value_now, value_before)):
            raise InputError(f"the results to resume have another {what_differs}; use the same command as before")
