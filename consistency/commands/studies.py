"""Commands that run filters.

``list``, ``simulate``, ``run``, ``reproduce``, ``sweep``, ``tune`` and ``challenge``; they parse, call and print.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from consistency.commands.shared_options import (
    DETECT_HELP,
    FILTER_NAMES,
    LOST_HELP,
    SCENARIO,
    SCENARIO_NAMES,
    AsJson,
    BackendName,
    FalseAlarm,
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
    require_word,
)
from consistency.referee.defaults import DETECT, FALSE_ALARM
from consistency.referee.errors import InputError
from consistency.referee.extras import missing, remedy


def simulate_command(
    scenario: Annotated[str, typer.Argument(metavar="SCENARIO", help=SCENARIO, autocompletion=SCENARIO_NAMES)],
    out: Out,
    runs: Runs = 1,
    seed: Seed = 0,
    form: Annotated[str, typer.Option("--format", help="Format of the tables: parquet or csv.")] = "parquet",
    overwrite: Overwrite = False,
) -> None:
    """Simulate a scenario, and write it as a log. A log has truth, controls and observations, for any filter."""
    from consistency.bench.runs.montecarlo import simulate_log
    from consistency.bench.scenario import load_scenario
    from consistency.referee.diagnostics.number_words import plural

    simulate_log(load_scenario(scenario), runs, seed, out, overwrite, form)
    count = plural(runs, "run")
    print(f"{count} of {scenario} in {out}; filter them with: consistency run --log {out} --filter F")


def run_command(
    out: Out,
    filters: Annotated[
        list[str],
        typer.Option(
            "--filter",
            metavar="NAME",
            help="Filter (see 'list'), or FILTER+gate; may be repeated.",
            autocompletion=FILTER_NAMES,
        ),
    ],
    scenario: Annotated[
        str | None, typer.Argument(metavar="SCENARIO", help=SCENARIO, autocompletion=SCENARIO_NAMES)
    ] = None,
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
    from consistency.bench.filters.run_filter import resolve_filters
    from consistency.bench.runs.executors import executor_for
    from consistency.bench.runs.montecarlo import run_log, run_trials, run_until_decided
    from consistency.bench.runs.results_to_records import analyse
    from consistency.bench.scenario import load_scenario
    from consistency.bench.store.recorded_log import read_log
    from consistency.bench.store.results import Results, StoredResults
    from consistency.referee.show import terminal
    from consistency.referee.system import say
    from consistency.referee.verdicts.tables import document

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
                from consistency.stereo.visual_odometry.tracks import screened_log, screening_line

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
        said = [finding for finding in missed if outcome(finding.source, finding.verdict) == word]
        if said:
            are_ours = word == "refuted" and all(finding.source.startswith(OURS) for finding in said)
            may = " (conjectures of this project, which may be refuted: no failure)" if are_ours else ""
            print(f"{word}: {', '.join(finding.id for finding in said)}{may}", file=sys.stderr)
    if not all(finding.source.startswith(OURS) or finding.verdict == NOT_SHOWN for finding in missed):
        raise typer.Exit(1)


def sweep_command(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SWEEP", help="Built-in name (see 'list'), a .toml file, or a folder of 'sweep' to report again."
        ),
    ],
    out: Annotated[
        Path | None, typer.Option("--out", help="Output folder; one with part of the same sweep is continued.")
    ] = None,
    filters: Annotated[
        list[str] | None,
        typer.Option(
            "--filter",
            metavar="NAME",
            help="Filter, instead of those in the file; may be repeated.",
            autocompletion=FILTER_NAMES,
        ),
    ] = None,
    jobs: Jobs = -1,
    backend: BackendName = "local",
    scheduler: Scheduler = None,
    scheduler_wait: SchedulerWait = None,
    slurm: SlurmOptions = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Run cells again that were made with other settings or code.")
    ] = False,
) -> None:
    """Run filters over a grid of scenarios; map the verdicts. Each cell is run until decided."""
    from consistency.bench.runs.executors import executor_for
    from consistency.bench.sweeps.regime_map import regime_of, write_regime
    from consistency.bench.sweeps.run_sweep import open_sweep, run_sweep
    from consistency.bench.sweeps.sweep_file import load_sweep

    if out is None and Path(source).is_dir():
        if filters or overwrite:
            raise InputError(f"{source}: a folder is only reported again; give the sweep and --out to run cells")
        folder = open_sweep(Path(source))
    else:
        if out is None:
            raise InputError(f"--out: missing; give a folder for the cells of {source}")
        plan = load_sweep(source, filters)
        with executor_for(backend, jobs, scheduler, slurm or (), scheduler_wait, out) as executor:
            folder = run_sweep(plan, out, overwrite, jobs, executor=executor)
    from consistency.bench.pages import write_regime_reports
    from consistency.bench.sweeps.regime_map import regime_blocks
    from consistency.referee.show import terminal

    regime = regime_of(folder)
    terminal.show(*regime_blocks(regime))
    for path in (*write_regime(regime, folder.path), *write_regime_reports(regime, folder.path)):
        print(path)


def tune_command(
    filter_name: Annotated[
        str, typer.Option("--filter", help="Filter name (see 'list').", autocompletion=FILTER_NAMES)
    ],
    scenario: Annotated[
        str | None, typer.Argument(metavar="SCENARIO", help=SCENARIO, autocompletion=SCENARIO_NAMES)
    ] = None,
    log: Annotated[Path | None, typer.Option("--log", help="Folder of a recorded log, instead of a scenario.")] = None,
    groups: Annotated[
        str,
        typer.Option("--groups", metavar="A,B", help="Noises with one factor each, such as Q.v,Q.omega,R; '+' joins."),
    ] = "Q,R",
    runs: Annotated[
        int | None, typer.Option("--runs", help="Number of runs for the fit, and of new ones for the verdict [50].")
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Seed of the noise [0].")] = None,
    jobs: Jobs = -1,
    timeout: Annotated[
        float | None, typer.Option("--timeout", help="Time limit of a run, s, for filters that are not compiled.")
    ] = None,
    false_alarm: FalseAlarm = FALSE_ALARM,
    detect: Annotated[
        float,
        typer.Option("--detect", help="Say 'consistent' only if the ratio is shown to lie in [1/R, R].", metavar="R"),
    ] = DETECT,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for the tuned scenario or sensor.toml, and tuning.json.")
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Overwrite an existing output folder of 'tune'.")
    ] = False,
    as_json: AsJson = False,
    fail_on: Annotated[
        str | None,
        typer.Option("--fail-on", help="'inconsistent': exit with status 1 unless the tuned filter is consistent."),
    ] = None,
) -> None:
    """Fit Q and R of a filter, and judge it before and after. The verdicts are on data that the fit has not seen."""
    from consistency.bench.scenario import load_scenario
    from consistency.bench.store.recorded_log import read_log
    from consistency.bench.tuning.tune import KIND, tuning_data, tuning_lines, tuning_verdicts, write
    from consistency.bench.tuning.tune import tune as tune_filter
    from consistency.referee.show import terminal
    from consistency.referee.system import require_free
    from consistency.referee.verdicts.judge_sources import settings_of
    from consistency.referee.verdicts.tables import document

    require_word("--fail-on", fail_on, "inconsistent")
    if (scenario is None) == (log is None):
        raise InputError("give either a SCENARIO or --log DIR")
    if log is not None and (runs is not None or seed is not None):
        raise InputError("--runs and --seed do not go with --log: a log has the runs it has")
    settings = settings_of(false_alarm=false_alarm, detect=detect)
    if out is not None:
        require_free(out, overwrite, KIND)
    tuning = tune_filter(
        load_scenario(str(scenario)) if log is None else read_log(log), filter_name, groups=groups,
        runs=50 if runs is None else runs, seed=0 if seed is None else seed, jobs=jobs, timeout=timeout,
        settings=settings,
    )  # fmt: skip
    if out is not None:
        write(tuning, out, overwrite)
    if as_json:
        print(json.dumps(tuning_data(tuning, out), indent=2, allow_nan=False))
    else:
        terminal.show(*document(tuning_verdicts(tuning), reasons=False).opening)
        print("\n" + "\n".join(tuning_lines(tuning, out)))
    if fail_on and not tuning.consistent:
        raise typer.Exit(1)


def challenge_command(
    filter_name: Annotated[
        str, typer.Argument(metavar="FILTER", help="Built-in filter (see 'list').", autocompletion=FILTER_NAMES)
    ],
    scenario: Annotated[
        str | None,
        typer.Option(
            "--scenario",
            help="World to start from: built-in name or .toml [one that fits the filter].",
            autocompletion=SCENARIO_NAMES,
        ),
    ] = None,
    within: Annotated[
        list[str] | None,
        typer.Option(
            "--within",
            help="Bounds such as range=2:8 or path=circle, or a TOML file of them; may be repeated.",
            metavar="NAME=...",
        ),
    ] = None,
    minutes: Annotated[
        float | None, typer.Option("--minutes", help="Time limit of search and confirmation, minutes [5].")
    ] = None,
    trials: Annotated[
        int | None,
        typer.Option(
            "--trials", help="Number of trials of the search, instead of --minutes; the same result on every machine."
        ),
    ] = None,
    seed: Seed = 0,
    jobs: Annotated[int, typer.Option("--jobs", help="Number of workers; -1 is one for each core.")] = -1,
    false_alarm: Annotated[
        float, typer.Option("--false-alarm", help="Probability of finding a correct filter overconfident.")
    ] = FALSE_ALARM,
    detect: Annotated[
        float, typer.Option("--detect", help="Ratio of true to stated covariance that the confirmation must find.")
    ] = DETECT,
    out: Annotated[
        Path | None, typer.Option("--out", help="Scenario file to write [default: challenge-FILTER.toml].")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Overwrite an existing file.")] = False,
    as_json: AsJson = False,
    fail_on: Annotated[
        str | None, typer.Option("--fail-on", help="'found': exit with status 1 if the filter is found overconfident.")
    ] = None,
) -> None:
    """Find the world where a filter is most overconfident. Confirm it on new runs."""
    from consistency.bench.challenging.challenge import (
        Plan,
        challenge_data,
        challenge_lines,
        require_scenario_file,
        write_scenario,
    )
    from consistency.bench.challenging.challenge import challenge as challenge_filter

    require_word("--fail-on", fail_on, "found")
    if minutes is None and trials is None:
        minutes = 5.0
    plan = Plan(minutes, trials, seed, jobs, false_alarm, detect)
    out = Path(f"challenge-{filter_name}.toml") if out is None else out
    require_scenario_file(out, overwrite)
    outcome = challenge_filter(filter_name, scenario, plan, within or [])
    if outcome.found:
        write_scenario(outcome, out)
    if as_json:
        print(json.dumps(challenge_data(outcome, out), indent=2))
    else:
        print("\n".join(challenge_lines(outcome, out)))
    if fail_on and outcome.found:
        raise typer.Exit(1)


def list_command(as_json: AsJson = False) -> None:
    """List scenarios, filters, experiments and sweeps."""
    from consistency.bench.filters import BOUNDS, SMOOTHERS, filter_summaries
    from consistency.bench.types import GUARDS
    from consistency.referee.system import summaries

    shipped, filters = summaries(), filter_summaries()
    if missing("bench"):
        print(f"consistency: to run what is listed needs {remedy('bench')}", file=sys.stderr)
    if as_json:
        listed = {"scenarios": shipped.pop("scenarios"), "filters": list(filters)}
        print(json.dumps(listed | shipped | {"filter_summaries": filters, "guards": GUARDS}, indent=2))
        return
    marks = dict.fromkeys(BOUNDS, " (not realisable)") | dict.fromkeys(SMOOTHERS, " (all data at once)")
    marked = {name: text + marks.get(name, "") for name, text in filters.items()}
    guards = {f"FILTER+{kind}": text for kind, text in GUARDS.items()}
    named = {
        **{kind.capitalize(): texts for kind, texts in shipped.items()},
        "Filters": marked,
        "Guards, before any filter but smoothers": guards,
    }
    for title, entries in named.items():
        print(title)
        width = max((len(name) for name in entries), default=0)
        for name, summary in entries.items():
            print(f"  {name:<{width}}  {summary}")
        print()
