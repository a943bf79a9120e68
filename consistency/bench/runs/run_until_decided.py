"""Run until the verdict is clear: a few trials, a look, more trials where it is still open."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from itertools import count
from pathlib import Path
from typing import Any

from consistency.bench.protocols import Filter
from consistency.bench.runs.montecarlo import studied, workers_for
from consistency.bench.runs.results_to_records import record_of
from consistency.bench.runs.rounds_of_runs import StudyRounds
from consistency.bench.scenario import Scenario
from consistency.bench.store.journal import Journal
from consistency.bench.store.results import Results, StoredResults, Tables
from consistency.referee.column_names import POSE
from consistency.referee.defaults import DETECT, FALSE_ALARM, POWER
from consistency.referee.diagnostics.judge_record import looks, progress_text
from consistency.referee.diagnostics.planning.early_stopping import Design, sequential_design
from consistency.referee.diagnostics.records.record import Record
from consistency.referee.diagnostics.verdict.verdict import Verdict
from consistency.referee.errors import InputError
from consistency.referee.system.progress import say
from consistency.referee.verdicts.judge_sources import refused


def run_until_decided(
    scenario: Scenario,
    filters: Sequence[str | Filter],
    *,
    detect: float = DETECT,
    false_alarm: float = FALSE_ALARM,
    power: float = POWER,
    max_runs: int | None = None,
    lost: float | None = None,
    seed: int = 0,
    jobs: int = -1,
    timeout: float | None = None,
    previous: Tables | None = None,
    memory: float | None = None,
    out: str | Path | None = None,
    resume: bool = False,
    overwrite: bool = False,
    executor: Executor | None = None,
    journal: Journal | None = None,
) -> tuple[Results | StoredResults, dict[str, Verdict]]:
    """Simulate and judge at the inspections of a :class:`Design` until every filter is decided.

    A filter is decided at the first inspection that finds a fault, or shows the ratio of true to stated covariance to
    lie in [1 / detect, detect] and, where ``lost`` is given, the share of lost runs to be that at most. This verdict is
    final, however many runs other filters take. With ``max_runs``, a filter still open after that many is undecided.
    Which runs are drawn does not depend on the looks.

    Parameters
    ----------
    seed, jobs, timeout, previous, memory, out, resume, overwrite, executor : as for :func:`run_trials`. A look then
        holds the arrays of one filter in memory, and nothing else grows with the runs.
    journal : in place of ``out``: what keeps the finished runs while the results stay in memory. It may hold runs of
        the same scenario, filters and seed.

    Returns
    -------
    Results of all runs, with the plan in their manifest, and the verdict of each filter at the look that decided it

    Raises
    ------
    InputError, Interrupted
        As :func:`run_trials`; a plan that cannot be, or is not that of the results to resume.
    """
    plan: dict[str, Any] = {
        "dof": len(POSE), "detect": detect, "false_alarm": false_alarm, "power": power, "max_runs": max_runs,
    }  # fmt: skip
    plan |= {} if lost is None else {"lost": lost}
    design, decided = plan_of(plan), dict[str, Verdict]()
    with studied(
        scenario, filters, seed, workers_for(jobs, executor), timeout, memory,
        out=out, previous=previous, resume=resume, overwrite=overwrite, plan=plan, journal=journal,
    ) as study_rounds:  # fmt: skip
        _require_less(study_rounds, max_runs)
        names = study_rounds.gathered.filters

        def read(runs: int, name: str) -> Record:
            return record_of(study_rounds.so_far(runs), name, scenario.truth.steps)

        results = study_rounds.finish(
            _runs_up_to_looks(study_rounds, looks(design, names, read, decided), decided, names)
        )
    return results, {name: decided[name] for name in names}


def _runs_up_to_looks(
    study_rounds: StudyRounds, counts: Iterator[int], decided: dict[str, Verdict], names: list[str]
) -> Iterator[range]:
    """Runs up to each look; says how it stands after those that were new."""
    is_new, runs = False, 0
    for runs_at_look in counts:
        if is_new:
            say(f"{runs} runs: {progress_text(decided, names)}")
        runs, is_new = runs_at_look, not study_rounds.gathered.finished.issuperset(range(runs_at_look))
        yield range(runs)
    if is_new:
        say(f"{runs} runs: {progress_text(decided, names)}")
    elif study_rounds.gathered.is_complete:
        done = len(study_rounds.gathered.finished)
        raise InputError(f"the {done} runs of the results to resume have decided every filter")


def _require_less(study_rounds: StudyRounds, max_runs: int | None) -> None:
    """Refuse results to which no run can be added."""
    finished_runs = study_rounds.gathered.finished
    runs = next(run for run in count() if run not in finished_runs)
    if max_runs is not None and (runs > max_runs or (runs == max_runs and study_rounds.gathered.is_complete)):
        raise InputError(f"the results to resume have {runs} runs; the plan looks for the last time at {max_runs}")


def plan_of(plan: dict[str, Any]) -> Design:
    """The design of a plan; raises InputError where it cannot be."""
    try:
        return sequential_design(**plan)
    except ValueError as error:
        raise refused(error) from None


# --- pilots: runs that tell how steps depend on each other, from which a number of runs is planned ----------------
