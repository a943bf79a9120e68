"""Any program under test: ``monte-carlo``; it parses, calls and prints."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from consistency.commands.shared_options import (
    DETECT_HELP,
    LOST_HELP,
    AsJson,
    FalseAlarm,
    Power,
    Skip,
    print_document,
    print_next,
    reads_files,
    require_word,
    tell,
    tell_notes,
)
from consistency.referee.defaults import DETECT, FALSE_ALARM, POWER
from consistency.referee.readers.options import Reading


@reads_files
def monte_carlo_command(
    command: Annotated[list[str], typer.Argument(metavar="COMMAND", hidden=True)],
    out: Annotated[Path, typer.Option("--out", help="Folder to write, with a folder for each run.")],
    files: Reading,
    estimates: Annotated[
        str, typer.Option("--estimates", metavar="FILE", help="What the program writes into the folder of each run.")
    ] = "estimates.csv",
    runs: Annotated[
        int | None, typer.Option("--runs", help="Number of runs [as many as 'plan' gives for the first run's errors].")
    ] = None,
    until_decided: Annotated[
        bool, typer.Option("--until-decided", help="As many runs as the verdict takes, instead of --runs.")
    ] = False,
    max_runs: Annotated[int | None, typer.Option("--max-runs", help="Most runs of --until-decided.")] = None,
    each: Annotated[
        str | None,
        typer.Option("--each", metavar="'GLOB'", help="One run for each of these recorded files or folders: {input}."),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", help="Number from which the seeds of all runs follow.")] = 0,
    jobs: Annotated[int, typer.Option("--jobs", help="Runs at a time; -1 is one a core.")] = -1,
    timeout: Annotated[float | None, typer.Option("--timeout", help="Seconds a run, after which it is killed.")] = None,
    cwd: Annotated[Path | None, typer.Option("--cwd", help="Working folder of the program [that of its run].")] = None,
    check_seed: Annotated[
        bool, typer.Option("--check-seed", help="Do run 0 twice, and say whether its tables are the same.")
    ] = False,
    detect: Annotated[float, typer.Option("--detect", help=f"{DETECT_HELP.capitalize()}.")] = DETECT,
    false_alarm: FalseAlarm = FALSE_ALARM,
    power: Power = POWER,
    lost: Annotated[float | None, typer.Option("--lost", help=f"{LOST_HELP.capitalize()}.", metavar="P")] = None,
    innovations: Annotated[
        str | None, typer.Option("--innovations", help="'optimal': of an optimal gain without a gate; they are judged.")
    ] = None,
    skip: Skip = None,
    keep: Annotated[
        str, typer.Option("--keep", help="'failed': delete files of other runs when their numbers were read.")
    ] = "all",
    resume: Annotated[bool, typer.Option("--resume", help="Do the runs that are missing in --out.")] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace --out of an earlier call, --report and --junit.")
    ] = False,
    report: Annotated[
        Path | None, typer.Option("--report", help="Folder for an HTML and a PDF page, or FILE.xml or FILE.md.")
    ] = None,
    junit: Annotated[Path | None, typer.Option("--junit", help="JUnit file of the verdict, for CI.")] = None,
    as_json: AsJson = False,
    fail_on: Annotated[
        str | None, typer.Option("--fail-on", help="'inconsistent': exit 1 unless all are consistent.")
    ] = None,
) -> None:
    """Run any program many times, and judge its estimates. Each run has another {seed}.

    COMMAND, behind --, is the program with its arguments, in which {run}, {seed}, {out}, {here} and {worker} are
    replaced. Each run has a folder of its own in --out, {out}, where the program is started; {here} is the folder of
    the call. The program writes estimates and truth there, as 'analyse' reads them.
    """
    from consistency.commands.program_reports import require_reports, write_verdicts
    from consistency.referee.programs.process import inputs_of, program_of
    from consistency.referee.programs.study import ProgramPlan, run_study
    from consistency.referee.readers.pipeline.program_runs import failures_in_words
    from consistency.referee.verdicts.judge_sources import settings_of, skip_asked
    from consistency.referee.verdicts.tables import document

    require_word("--fail-on", fail_on, "inconsistent")
    require_word("--innovations", innovations, "optimal")
    settings = settings_of(false_alarm=false_alarm, detect=detect, power=power, lost=lost)
    here, hint = Path.cwd(), ""
    if each is not None:
        hint = f"; if it is one of the files of --each, quote the pattern: --each '{each}'"
    program = program_of(command, here, cwd, hint)
    inputs = () if each is None else inputs_of(each, here)
    plan = ProgramPlan(
        runs, until_decided, max_runs, seed, jobs, timeout, check_seed, keep, inputs, settings, skip_asked(skip),
        innovations is not None,
    )  # fmt: skip
    require_reports(report, junit, overwrite)
    records, verdicts = run_study(program, plan, out, estimates, files, resume, overwrite)
    tell_notes(records)
    tell(failures_in_words(records, out))
    shown = document(verdicts, program.name)
    print_document(shown, as_json)
    sys.stdout.flush()  # whatever becomes of the pictures
    written = write_verdicts(records, verdicts, shown, report, junit, overwrite)
    if not as_json:
        for file in written:
            print(file)
        print_next("runs", out)
    if fail_on is not None and not all(verdict.consistent for verdict in verdicts.values()):
        raise typer.Exit(1)
