"""Sources of records, whatever they are: their verdicts, and the runs that a verdict takes."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from consistency.referee.diagnostics.judge_record import judge
from consistency.referee.diagnostics.record import Record, Skip, skip_of
from consistency.referee.diagnostics.verdict import Verdict
from consistency.referee.diagnostics.verdict_parts import Settings
from consistency.referee.errors import InputError
from consistency.referee.readers.pipeline.read_files import is_program_runs
from consistency.referee.types import Array

if TYPE_CHECKING:
    from consistency.referee.diagnostics.planning import Design

OPTION = {"ratio": "detect", "false_alarm": "false-alarm", "max_runs": "max-runs"}  # as commands call settings


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
    settings: Settings | None = None  # by which they were judged when they were run; the defaults if None
    skip: Skip | None = None  # first steps that were left out then
    optimal_gain: bool = False  # declared then


def source_of(of: Source | Sequence[Record]) -> Source:
    """Return records as a source."""
    if isinstance(of, Source):
        return of
    named: dict[str, Record] = {record.name: record for record in of}

    def record(name: str) -> Record:
        if name not in named:
            raise InputError(f"--filter {name}: is not in these files; there are: {', '.join(named)}")
        return named[name]

    return Source(list(named), record)


def files_source(path: Path, records: Sequence[Record]) -> Source:
    """Return records of files as a source; runs of a program are judged as they were when they were run."""
    source = source_of(records)
    if not is_program_runs(path):
        return source
    from consistency.referee.readers.pipeline.program_runs import study_in

    study = study_in(path)
    return replace(
        source, design=lambda: study.design, unfinished=study.unfinished, settings=study.settings,
        skip=skip_asked(study.manifest["skip"]), optimal_gain=study.manifest["optimal_gain"],
    )  # fmt: skip


def judge_all(
    results: Source | Sequence[Record],
    filters: Sequence[str] | None = None,
    confidence: float | None = None,
    settings: Settings | None = None,
    skip: str | float | Skip | None = None,
    optimal_gain: bool = False,
) -> dict[str, Verdict]:
    """Judge every filter of the records, or those named; :func:`consistency.analyse` has the parameters."""
    source = source_of(results)
    design = None
    if settings is None:
        settings = settings_of(confidence)
        if confidence is None:
            settings = source.settings or settings
            design = source.design()
    first = skip_asked(skip) or source.skip
    verdicts = {}
    for name in filters or source.filters:
        record = source.record(name)
        if first is not None and record.runs.skipped is None:
            record = record.without_first(first)
        if optimal_gain or source.optimal_gain:
            record = record.with_optimal_gain()
        verdicts[name] = judge(record, settings, design)
    return verdicts


# --- what the options of a command ask for -----------------------------------------------------------


def settings_of(confidence: float | None = None, **given: Any) -> Settings:
    """Settings of a verdict from the options of a command; those that are None keep their defaults.

    Raises
    ------
    InputError
        A value out of its range, or both a confidence and a false-alarm rate.
    """
    given = {name: value for name, value in given.items() if value is not None}
    if confidence is not None:
        if "false_alarm" in given:
            raise InputError("--confidence is 1 less --false-alarm; give one of them")
        if not 0.0 < confidence < 1.0:
            raise InputError(f"confidence must lie between 0 and 1, got {confidence}")
        given["false_alarm"] = 1.0 - confidence
    try:
        return Settings(**given)
    except ValueError as error:
        raise refused(error) from None


def skip_asked(given: str | float | Skip | None) -> Skip | None:
    """The first steps or seconds that an option asks to leave out.

    Raises
    ------
    InputError
        It is neither a number of steps nor of seconds.
    """
    if given is None:
        return None
    try:
        return skip_of(given)
    except ValueError as error:
        raise refused(error) from None


def refused(error: ValueError) -> InputError:
    """What a plan refuses, with the option of the command in place of the argument."""
    name, rest = str(error).split(" ", 1)
    return InputError(f"--{OPTION.get(name, name)} {rest}")


def plan_runs(
    dof: int,
    detect: float,
    false_alarm: float,
    power: float,
    allow: str | None = None,
    pilots: Mapping[str, tuple[Array, int]] | None = None,
    lost: float | None = None,
    pilot_dof: int = 3,
    groups: int | None = None,
) -> dict[str, Any]:
    """Runs that a verdict takes (``runs``, 30 or more), those of one chi-square test (``one_step``), and first looks.

    Parameters
    ----------
    pilots : of each filter, mean NEES over ``dof`` of a few runs (N,), and their steps; ``like`` then has the runs that
        filters take whose steps depend on each other as theirs do
    lost : share of lost runs that is to be excluded
    pilot_dof : dimension of the errors of the pilots
    groups : number of groups, in one of which the covariance may be wrong; ``runs_in_group`` is then what each takes

    Raises
    ------
    InputError
        A number out of its range, or pilots without truth.
    """
    from consistency.referee.diagnostics.number_of_runs import (
        FEWEST_PLANNED,
        gate_runs,
        group_runs,
        lost_runs,
        required_runs,
    )
    from consistency.referee.diagnostics.planning import Design, pilot_plan

    if allow not in (None, "conservative"):
        raise InputError(f"--allow must be 'conservative', got '{allow}'")
    if pilots is not None and dof != pilot_dof:
        raise InputError(f"--dof {dof}: results of the bench have {pilot_dof} dimensions; leave it out")
    try:
        runs = max(FEWEST_PLANNED, gate_runs(dof, detect, false_alarm, power, allow, lost))
        inspections = itertools.takewhile(lambda one: one[0] < runs, Design(dof).inspections())
        looks = [count for count, spent in inspections if spent]
        planned: dict[str, Any] = {
            "dof": dof, "detect": detect, "false_alarm": false_alarm, "power": power, "allow": allow, "runs": runs,
            "one_step": required_runs(dof, detect, false_alarm, power, two_sided=allow is None), "looks": looks,
        }  # fmt: skip
        if lost is not None:
            planned |= {"lost": lost, "lost_runs": lost_runs(lost, power)}
        if groups is not None:
            each = group_runs(dof, detect, groups, false_alarm, power, allow)
            planned |= {"groups": groups, "runs_in_group": each, "group_runs": groups * each}
        if pilots is not None:
            planned["like"] = {}
            for name, (means, steps) in pilots.items():
                planned["like"][name] = vars(pilot_plan(means, dof, steps, detect, false_alarm, power, allow, lost))
    except InputError:
        raise
    except ValueError as error:
        raise refused(error) from None
    return planned


def plan_of_bounds(level: str | float, detect: float, false_alarm: float, power: float) -> dict[str, Any]:
    """Runs that bounds of a ``level`` take, by what they show; raises InputError for a number out of its range."""
    from consistency.referee.diagnostics.exceedance import bound_runs
    from consistency.referee.readers.formats.bounds import level_of_text

    settings = settings_of(detect=detect, false_alarm=false_alarm, power=power)
    stated = level_of_text(level)
    share = stated.of(stated.dimensions or 1)
    asked = {"level": share, "detect": settings.factor, "false_alarm": false_alarm, "power": power}
    return asked | bound_runs(share, detect, false_alarm, power)._asdict()


def pilots_of_records(
    records: Sequence[Record], filters: Sequence[str] | None = None
) -> tuple[dict[str, tuple[Array, int]], int]:
    """Pilots of :func:`plan` in records of files, and the dimension of their errors.

    Raises
    ------
    InputError
        No such filter, one without truth, or too few runs that did not fail.
    """
    from consistency.referee.diagnostics.nees import FEW
    from consistency.referee.diagnostics.scale import run_means

    named = {record.name: record for record in records}
    pilots = {}
    for name in filters or named:
        if name not in named:
            raise InputError(f"--filter {name}: is not in these runs; there are: {', '.join(named)}")
        record = named[name]
        if record.errors.nees is None or record.errors.parts:
            raise InputError(f"{name}: a pilot needs truth and a whole covariance")
        means, counts = run_means(record.errors.nees)
        failed = np.isin(record.run_numbers, [failure.run for failure in record.failures])
        means = means[(counts > 0) & ~failed] / record.errors.dof
        if len(means) < FEW:
            raise InputError(f"{name}: a pilot needs at least {FEW} runs that did not fail, got {len(means)}")
        pilots[name] = means, record.errors.nees.shape[1]
    return pilots, next(iter(named.values())).errors.dof
