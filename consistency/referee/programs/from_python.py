"""Runs of a program from Python: the verdict on them, or their record."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from consistency.referee.diagnostics.records.record import Record
from consistency.referee.diagnostics.verdict.answers import Settings
from consistency.referee.diagnostics.verdict.verdict import Verdict
from consistency.referee.errors import InputError
from consistency.referee.programs.study import Plan, run_study
from consistency.referee.programs.words import inputs_of, program_of
from consistency.referee.readers.options import Reading
from consistency.referee.readers.pipeline.program_runs import PATHS
from consistency.referee.verdicts.judge_sources import settings_of, skip_asked

FOR_PLAN = ("until_decided", "max_runs", "seed", "jobs", "timeout", "check_seed", "keep", "optimal_gain")


def monte_carlo(
    argv: Sequence[str],
    runs: int | None = None,
    *,
    estimates: str = "estimates.csv",
    truth: str | Path | None = None,
    out: str | Path | None = None,
    each: str | None = None,
    filter: str | None = None,
    until_decided: bool = False,
    max_runs: int | None = None,
    seed: int = 0,
    jobs: int = -1,
    timeout: float | None = None,
    cwd: str | Path | None = None,
    check_seed: bool = False,
    keep: str = "all",
    resume: bool = False,
    overwrite: bool = False,
    optimal_gain: bool = False,
    skip: str | float | None = None,
    false_alarm: float | None = None,
    detect: float | None = None,
    power: float | None = None,
    tolerance: float | None = None,
    allow: str | None = None,
    lost: float | None = None,
    **reading: Any,
) -> Verdict:
    """Run any program many times, as ``consistency monte-carlo`` does, and judge the estimates that it writes.

    A filter in Python has :func:`consistency.run_trials`, a simulation :mod:`consistency.testing`.

    Parameters
    ----------
    argv : words of the command, the program first. In each run ``{run}``, ``{seed}`` (an integer from 1 to 2^31 - 1),
        ``{out}`` (the folder of the run, in which the program is started), ``{here}`` (the present folder) and
        ``{worker}`` are replaced; all other braces stay. No shell sees them
    runs : number of runs; as many as a verdict takes for the errors of the first run if not given
    estimates, truth : files that the program writes in the folder of a run; a truth of ``{here}/truth.csv`` serves all
        runs, and a table may have the truth in columns beside the estimates
    out : folder of the runs, which must not exist; a temporary one if not given
    each : pattern of recorded files or folders, with a run for each of them in place of ``runs``: ``{input}`` and, its
        name without suffix, ``{name}``
    filter : which estimator, where the tables hold several
    until_decided, max_runs : as many runs as the verdict takes, at looks whose error rates hold together
    seed : number from which the seeds of all runs follow
    jobs : runs at a time; -1 is one a core
    timeout : s a run, after which it is killed
    cwd : working folder of the program
    check_seed : do run 0 twice, and say whether its tables are the same
    keep : "failed" deletes the files of other runs when their numbers were read
    resume, overwrite : do the runs that are missing in ``out``; replace it
    optimal_gain, skip, false_alarm, detect, power, tolerance, allow, lost : as for :func:`consistency.judge`
    reading : further options of :func:`consistency.read`, as ``state`` or ``error``

    Raises
    ------
    InputError
        There is no such program; ``out`` cannot be used; the first runs all failed alike or wrote the same table; as
        :func:`consistency.read`.
    """
    settings = settings_of(
        false_alarm=false_alarm, detect=detect, power=power, tolerance=tolerance, allow=allow, lost=lost
    )
    options: dict[str, Any] = {
        "each": each, "cwd": cwd, "resume": resume, "overwrite": overwrite, "skip": skip,
        "until_decided": until_decided, "max_runs": max_runs, "seed": seed, "jobs": jobs, "timeout": timeout,
        "check_seed": check_seed, "keep": keep, "optimal_gain": optimal_gain,
    }  # fmt: skip
    records, verdicts = _run(argv, settings, runs, estimates, truth, out, **options, **reading)
    record = _chosen(records, filter)
    return verdicts[record.name]


def record_of_program(
    argv: Sequence[str],
    settings: Settings,
    runs: int | None,
    estimates: str,
    truth: str | Path | None,
    out: str | Path | None,
    filter: str | None,
    **options: Any,
) -> Record:
    """Record of the runs of a program, whose number follows from the settings; as :func:`monte_carlo`."""
    records, _ = _run(argv, settings, runs, estimates, truth, out, **options)
    return _chosen(records, filter)


def _run(
    argv: Sequence[str],
    settings: Settings,
    runs: int | None,
    estimates: str,
    truth: str | Path | None,
    out: str | Path | None,
    *,
    each: str | None = None,
    cwd: str | Path | None = None,
    skip: str | float | None = None,
    resume: bool = False,
    overwrite: bool = False,
    **options: Any,
) -> tuple[list[Record], dict[str, Verdict]]:
    here = Path.cwd()
    of_plan = {name: options.pop(name) for name in FOR_PLAN if name in options}
    for name in options:
        if name not in Reading.__dataclass_fields__:
            raise TypeError(f"monte_carlo: unknown option '{name}'")
    options["truth"] = truth
    for name in PATHS:
        if options.get(name) is not None:
            options[name] = Path(options[name])
    if cwd is not None:
        cwd = Path(cwd)
    program = program_of(argv, here, cwd)
    inputs = () if each is None else inputs_of(each, here)
    plan = Plan(runs, inputs=inputs, settings=settings, skip=skip_asked(skip), **of_plan)
    reading = Reading(**options)
    if out is not None:
        return run_study(program, plan, Path(out), estimates, reading, resume, overwrite)
    with tempfile.TemporaryDirectory(prefix="consistency-") as folder:
        return run_study(program, plan, Path(folder) / "runs", estimates, reading, resume, overwrite)


def _chosen(records: Sequence[Record], name: str | None) -> Record:
    """The record of the estimator of that name, or of the only one."""
    named = {record.name: record for record in records}
    if name is None and len(named) > 1:
        raise InputError(f"the program writes several estimators ({', '.join(named)}); choose one with filter=")
    if name is not None and name not in named:
        raise InputError(f"filter '{name}' is not in the estimates; there are: {', '.join(named)}")
    return named[name or next(iter(named))]
