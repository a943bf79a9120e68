"""Commands that try many worlds or settings: sweep, tune and challenge; they parse, call and print."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from consistency.commands.shared_options import (
    SCENARIO,
    AsJson,
    BackendName,
    FalseAlarm,
    Jobs,
    Scheduler,
    SchedulerWait,
    Seed,
    SlurmOptions,
    require_word,
)
from consistency.referee.defaults import DETECT, FALSE_ALARM
from consistency.referee.errors import InputError


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
        typer.Option("--filter", metavar="NAME", help="Filter, instead of those in the file; may be repeated."),
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
    from consistency.bench.runs.backends.choose_executor import executor_for
    from consistency.bench.sweeps.regime_map import regime_of, write_regime
    from consistency.bench.sweeps.run_sweep import run_sweep
    from consistency.bench.sweeps.sweep_file import load_sweep
    from consistency.bench.sweeps.sweep_folder import open_sweep

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
    filter_name: Annotated[str, typer.Option("--filter", help="Filter name (see 'list').")],
    scenario: Annotated[str | None, typer.Argument(metavar="SCENARIO", help=SCENARIO)] = None,
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
    from consistency.bench.tuning.tune import tune as tune_filter
    from consistency.bench.tuning.tuning_result import KIND, tuning_data, tuning_lines, tuning_verdicts, write
    from consistency.referee.document.judged_filters import document
    from consistency.referee.show import terminal
    from consistency.referee.system.folders import require_free
    from consistency.referee.verdicts.judge_sources import settings_of

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
    filter_name: Annotated[str, typer.Argument(metavar="FILTER", help="Built-in filter (see 'list').")],
    scenario: Annotated[
        str | None,
        typer.Option("--scenario", help="World to start from: built-in name or .toml [one that fits the filter]."),
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
