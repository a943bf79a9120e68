"""Commands that run filters: ``simulate``, ``run`` and ``reproduce``; they parse, call and print."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from consistency.commands.shared_options import (
    DETECT_HELP,
    LOST_HELP,
    SCENARIO,
    BackendName,
    Jobs,
    Out,
    Overwrite,
    Runs,
    Scheduler,
    SchedulerWait,
    Seed,
    SlurmOptions,
    given_options,
    print_next,
)
from consistency.referee.errors import InputError


def simulate_command(
    scenario: Annotated[str, typer.Argument(metavar="SCENARIO", help=SCENARIO)],
    out: Out,
    runs: Runs = 1,
    seed: Seed = 0,
    form: Annotated[str, typer.Option("--format", help="Format of the tables: parquet or csv.")] = "parquet",
    overwrite: Overwrite = False,
) -> None:
    """Simulate a scenario, and write it as a log. A log has truth, controls and observations, for any filter."""
    from consistency.bench.runs.montecarlo import simulate_log
    from consistency.bench.scenario import load_scenario
    from consistency.referee.diagnostics.words.numbers import plural

    simulate_log(load_scenario(scenario), runs, seed, out, overwrite, form)
    count = plural(runs, "run")
    print(f"{count} of {scenario} in {out}; filter them with: consistency run --log {out} --filter F")


def run_command(
    out: Out,
    filters: Annotated[
        list[str],
        typer.Option("--filter", metavar="NAME", help="Filter (see 'list'), or FILTER+gate; may be repeated."),
    ],
    scenario: Annotated[str | None, typer.Argument(metavar="SCENARIO", help=SCENARIO)] = None,
    log: Annotated[Path | None, typer.Option("--log", help="Folder of a recorded log, instead of a scenario.")] = None,
    screen: Annotated[
        str | None,
        typer.Option(
            "--screen",
            metavar="U,V,D",
            help="Restart a landmark's track when it deviates from the common motion by more than this (px).",
        ),
    ] = None,
    runs: Annotated[int | None, typer.Option("--runs", help="Number of Monte Carlo runs [default: 50].")] = None,
    until_decided: Annotated[
        bool, typer.Option("--until-decided", help="Run until the verdict is clear, instead of --runs.")
    ] = False,
    max_runs: Annotated[
        int | None, typer.Option("--max-runs", help="Maximum number of runs for --until-decided.")
    ] = None,
    detect: Annotated[float | None, typer.Option("--detect", help=f"For --until-decided: {DETECT_HELP} [1.5]")] = None,
    false_alarm: Annotated[
        float | None,
        typer.Option("--false-alarm", help="For --until-decided: probability of rejecting a correct filter [0.05]."),
    ] = None,
    lost: Annotated[float | None, typer.Option("--lost", help=f"For --until-decided: {LOST_HELP}.")] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Seed of the noise [default: 0].")] = None,
    jobs: Jobs = -1,
    timeout: Annotated[
        float | None,
        typer.Option("--timeout", help="Time limit of a run, s, for filters that are not compiled."),
    ] = None,
    memory: Annotated[
        float | None,
        typer.Option("--memory", metavar="GIB", help="Memory that such a filter may allocate in a run, GiB."),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue an interrupted run in --out.")] = False,
    overwrite: Overwrite = False,
    backend: BackendName = "local",
    scheduler: Scheduler = None,
    scheduler_wait: SchedulerWait = None,
    slurm: SlurmOptions = None,
) -> None:
    """Run filters on simulated trials or a recorded log."""
    from consistency.bench.filters.resolve_filters import resolve_filters
    from consistency.bench.runs.analyse_results import analyse
    from consistency.bench.runs.backends.choose_executor import executor_for
    from consistency.bench.runs.montecarlo import run_log, run_trials
    from consistency.bench.runs.run_until_decided import run_until_decided
    from consistency.bench.scenario import load_scenario
    from consistency.bench.store.recorded_log import read_log
    from consistency.bench.store.results import Results, StoredResults
    from consistency.referee.document.judged_filters import document
    from consistency.referee.show import terminal
    from consistency.referee.system.progress import say

    if (scenario is None) == (log is None):
        raise InputError("give either a SCENARIO or --log DIR")
    if screen is not None and log is None:
        raise InputError("--screen goes with --log: a scenario says which of its observations are spurious")
    planned = given_options(max_runs=max_runs, detect=detect, false_alarm=false_alarm, lost=lost)
    if planned and not until_decided:
        raise InputError(f"--{next(iter(planned)).replace('_', '-')} goes with --until-decided")
    if until_decided and runs is not None:
        raise InputError("--until-decided finds the number of runs; give --max-runs instead of --runs")
    results: Results | StoredResults
    verdicts = None
    if resume and overwrite:
        raise InputError("--resume continues with what --overwrite would replace; give one of them")
    if log is not None and (runs is not None or seed is not None or until_decided):
        raise InputError("--runs, --seed and --until-decided do not go with --log: a log has the runs it has")
    with executor_for(backend, jobs, scheduler, slurm or (), scheduler_wait, out) as executor:
        if log is not None:
            recorded = read_log(log)
            if screen is not None:
                from consistency.stereo.visual_odometry.common_motion import screened_log, screening_line

                recorded = screened_log(recorded, screen)
                say(screening_line(recorded))
            resolve_filters(filters, recorded.belief, recorded.name)
            if out.resolve() == log.resolve() or log.resolve() in out.resolve().parents:
                raise InputError(f"--out {out}: lies in the log; choose another folder")
            results = run_log(
                recorded, filters, jobs, timeout, memory, executor, out=out, resume=resume, overwrite=overwrite
            )  # fmt: skip
        else:
            world = load_scenario(str(scenario))
            runs, seed = 50 if runs is None else runs, 0 if seed is None else seed
            resolve_filters(filters, world.belief)
            if until_decided:
                results, verdicts = run_until_decided(
                    world, filters, seed=seed, jobs=jobs, timeout=timeout, memory=memory, executor=executor,
                    out=out, resume=resume, overwrite=overwrite, **planned,
                )  # fmt: skip
            else:
                results = run_trials(
                    world, filters, runs, seed, jobs, timeout,
                    out=out, overwrite=overwrite, resume=resume, memory=memory, executor=executor,
                )  # fmt: skip
    terminal.show(*document(verdicts or analyse(results), reasons=False).opening)
    print_next("results", out)


def reproduce_command(
    only: Annotated[
        list[str] | None,
        typer.Option("--only", metavar="NAME", help="Finding or experiment to re-run; may be repeated."),
    ] = None,
    long: Annotated[bool, typer.Option("--all", help="Include experiments that take minutes to hours.")] = False,
    runs: Runs = 50,
    seed: Seed = 0,
    jobs: Jobs = -1,
    out: Out = Path("reports/reproduce"),
    overwrite: Overwrite = False,
) -> None:
    """Re-run the published findings and compare. Exit with status 1 if one is not reproduced or refuted."""
    from consistency.bench.pages import write_reports
    from consistency.bench.runs.reproduce_findings import NOT_SHOWN, findings_table, left_out, not_run_table
    from consistency.bench.runs.reproduce_findings import reproduce as reproduce_findings
    from consistency.bench.types import OURS, outcome
    from consistency.referee.show import terminal

    findings = reproduce_findings(only, runs, seed, jobs, out, overwrite, long)
    terminal.show(findings_table(findings))
    if not only and (not_run := left_out(findings)):
        print("Not run:")
        terminal.show(not_run_table(not_run))
    for path in (out / "findings.json", *write_reports(out, out / "report.html", out / "report.pdf", overwrite=True)):
        print(path)
    missed = [finding for finding in findings if finding.verdict != "reproduced"]
    for word in ("not reproduced", "refuted", "not shown"):
        names = [finding.id for finding in missed if outcome(finding.source, finding.verdict) == word]
        if names:
            print(f"{word}: {', '.join(names)}", file=sys.stderr)
    if not all(finding.source.startswith(OURS) or finding.verdict == NOT_SHOWN for finding in missed):
        raise typer.Exit(1)
