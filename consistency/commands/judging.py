"""Verdicts: ``analyse``, ``report``, ``plan``, ``compare``, ``baseline`` and ``monitor``.

They parse, call and print.
"""

from __future__ import annotations

import json
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from consistency.commands.shared_options import (
    DETECT_HELP,
    ESTIMATES,
    FILTER_NAMES,
    LOST_HELP,
    SCENARIO_NAMES,
    AsJson,
    FalseAlarm,
    Judged,
    Power,
    Seed,
    Skip,
    are_files,
    given_options,
    print_document,
    read_files,
    reads_files,
    require_word,
    require_written,
    tell,
    tell_notes,
)
from consistency.referee.column_names import POSE
from consistency.referee.defaults import DETECT, FALSE_ALARM, GATE_FALSE_ALARM, NIS_TOLERANCE, POWER
from consistency.referee.errors import InputError
from consistency.referee.readers.options import GROUPED, Reading, flag_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from consistency.referee.diagnostics.monitor import GateRatios
    from consistency.referee.diagnostics.record import Record
    from consistency.referee.diagnostics.record import Skip as FirstSteps
    from consistency.referee.show.blocks import Document
    from consistency.referee.verdicts.compare_sources import Baseline
    from consistency.referee.verdicts.judge_sources import Source
    from consistency.referee.verdicts.monitor_sources import Watched


@reads_files
def analyse_command(
    path: Judged,
    files: Reading,
    filters: Annotated[
        list[str] | None, typer.Option("--filter", metavar="NAME", help="Only this filter; may be repeated.")
    ] = None,
    false_alarm: Annotated[
        float | None,
        typer.Option("--false-alarm", help=f"Probability of rejecting a correct filter [{FALSE_ALARM}]."),
    ] = None,
    detect: Annotated[
        float | None,
        typer.Option(
            "--detect", help=f"Say 'consistent' only if the ratio is shown to lie in [1/R, R] [{DETECT}].", metavar="R"
        ),
    ] = None,
    tolerance: Annotated[
        float | None,
        typer.Option("--tolerance", help="Accept a ratio that is shown to lie in [1/R, R].", metavar="R"),
    ] = None,
    lost: Annotated[
        float | None,
        typer.Option(
            "--lost", help="Say 'consistent' only if the share of lost runs is shown to be at most P.", metavar="P"
        ),
    ] = None,
    innovations: Annotated[
        str | None,
        typer.Option(
            "--innovations", help="'optimal': declare an optimal, ungated gain; innovations are then tested too."
        ),
    ] = None,
    confidence: Annotated[
        float | None,
        typer.Option("--confidence", help="Confidence level; alternative to --false-alarm (1 - false alarm)."),
    ] = None,
    skip: Skip = None,
    report: Annotated[
        Path | None,
        typer.Option("--report", help="Folder for HTML and PDF; or FILE.xml (JUnit), .md."),
    ] = None,
    verbose: Annotated[
        bool, typer.Option("--verbose", help="Show p values of all questions and credibility indices, too.")
    ] = False,
    as_json: AsJson = False,
    fail_on: Annotated[
        str | None, typer.Option("--fail-on", help="'inconsistent': exit 1 unless all are consistent.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Overwrite files other than reports, too.")] = False,
) -> None:
    """Check whether stated covariances match the errors. Explain the verdict."""
    from consistency.referee.verdicts.judge_sources import files_source, judge_all, settings_of, skip_asked
    from consistency.referee.verdicts.tables import document

    require_word("--fail-on", fail_on, "inconsistent")
    require_word("--innovations", innovations, "optimal")
    changes = given_options(
        confidence=confidence, false_alarm=false_alarm, detect=detect, tolerance=tolerance, lost=lost
    )
    settings, first = settings_of(**changes) if changes else None, skip_asked(skip)
    written: list[Path] = []
    recordings: list[Record] = []
    refused: InputError | None = None  # of a report, said below the verdict
    is_folder = False
    require_written(overwrite, report, "--report")
    if report is not None:
        from consistency.referee.pages.write_pages import is_one_file, require_report

        overwrite = require_report(report, overwrite)
        is_folder = not is_one_file(report)
    if are_files(path, files):
        try:
            recordings = [recording.without_first(first) for recording in read_files(path, files)]
        except InputError as error:
            from consistency.referee.verdicts.inspect_sources import says_more

            raise InputError(f"{error}; see: consistency inspect {path}") if says_more(path, files) else error from None
        source = files_source(path, recordings)
        verdicts = judge_all(source, filters, settings=settings, optimal_gain=innovations is not None)
        tell_notes(recordings)
        _refuse_unfinished(path, source, "monte-carlo", fail_on)
    else:
        from consistency.bench.runs.results_to_records import results_source

        results = results_source(path)
        if is_folder:
            raise InputError(f"--report: is for files of another estimator; for {path} use 'consistency report {path}'")
        if innovations is not None:
            raise InputError(
                "--innovations is for files of another estimator; filters of the bench declare it themselves"
            )
        verdicts = judge_all(results, filters, settings=settings, skip=first)
        _refuse_unfinished(path, results, "run", fail_on)
    shown = document(verdicts, path.name, verbose=verbose)
    print_document(shown, as_json)
    sys.stdout.flush()  # whatever becomes of the pictures
    if report is not None:
        from consistency.commands.program_reports import write_verdicts

        try:
            written = write_verdicts(recordings, verdicts, shown, report, None, overwrite)
        except InputError as error:
            refused = error
    if not as_json:
        for file in written:
            print(file)
    is_failed = fail_on is not None and not all(verdict.consistent for verdict in verdicts.values())
    if refused is not None and not is_failed:
        raise refused
    if refused is not None:
        print(f"consistency: {refused}", file=sys.stderr)
    if is_failed:
        raise typer.Exit(1)


@reads_files
def inspect_command(
    path: Annotated[Path, typer.Argument(metavar="PATH", help=f"File or folder: {ESTIMATES}, flight logs.")],
    files: Reading,
    as_json: AsJson = False,
) -> None:
    """Show what a file holds, and the command that judges it."""
    from consistency.referee.verdicts.inspect_sources import inspect_files, inspection_document

    found = inspect_files(path, files)
    print_document(inspection_document(found), as_json)
    if found.missing:
        raise InputError(found.missing)


def _refuse_unfinished(path: Path, source: Source, command: str, fail_on: str | None) -> None:
    """Say that runs are missing; refuse them with ``--fail-on``."""
    if not source.unfinished:
        return
    text = f"{path}: {source.unfinished}; the same 'consistency {command}' with --resume continues"
    if fail_on:
        raise InputError(f"--fail-on: {text}")
    print(f"consistency: {text}", file=sys.stderr)


@reads_files
def report_command(
    path: Annotated[
        Path, typer.Argument(metavar="PATH", help=f"Folder written by 'run' or 'reproduce', or estimates: {ESTIMATES}.")
    ],
    files: Reading,
    html: Annotated[
        Path | None,
        typer.Option("--html", help="HTML file [default: PATH/report.html; for estimates PATH-report.html]."),
    ] = None,
    pdf: Annotated[Path | None, typer.Option("--pdf", help="PDF file [default: beside the HTML file].")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Overwrite existing files.")] = False,
) -> None:
    """Write a report as one offline HTML file and a PDF."""
    from consistency.referee.pages.write_pages import require_pages, write_file_pages
    from consistency.referee.verdicts.judge_sources import files_source, judge_all

    estimates = are_files(path, files)
    stem = path.with_name(f"{path.stem}-report") if estimates else path / "report"
    # one of the two named: only that one is written
    targets = (html, pdf) if html or pdf else (stem.with_name(f"{stem.name}.html"), stem.with_name(f"{stem.name}.pdf"))
    if estimates:
        require_pages(*targets, overwrite)
        recordings = read_files(path, files)
        write_file_pages(recordings, judge_all(files_source(path, recordings)), *targets, path.name)
        tell_notes(recordings)
    else:
        from consistency.bench.pages import write_reports

        write_reports(path, *targets, overwrite)
    for target in targets:
        if target is not None:
            print(target)


def plan_command(
    scenario: Annotated[
        str | None,
        typer.Argument(
            metavar="[SCENARIO]",
            help="Scenario of a short pilot, which shows how steps depend on each other.",
            autocompletion=SCENARIO_NAMES,
        ),
    ] = None,
    filters: Annotated[
        list[str] | None,
        typer.Option(
            "--filter", metavar="NAME", help="Filter of the pilot; may be repeated.", autocompletion=FILTER_NAMES
        ),
    ] = None,
    like: Annotated[
        Path | None, typer.Option("--like", metavar="RESULTS", help="Results to use instead of a pilot.")
    ] = None,
    pilot_runs: Annotated[int, typer.Option("--pilot-runs", help="Number of runs of the pilot.")] = 40,
    seed: Seed = 0,
    detect: Annotated[float, typer.Option("--detect", help=f"{DETECT_HELP.capitalize()}.")] = DETECT,
    dof: Annotated[int, typer.Option("--dof", help="Dimension of the error; 3 for a planar pose.")] = 3,
    false_alarm: FalseAlarm = FALSE_ALARM,
    power: Power = POWER,
    allow: Annotated[
        str | None, typer.Option("--allow", help="'conservative': accept a covariance that is too large.")
    ] = None,
    lost: Annotated[float | None, typer.Option("--lost", help=f"{LOST_HELP.capitalize()}.", metavar="P")] = None,
    groups: Annotated[
        int | None, typer.Option("--groups", help="Number of groups of --by, in one of which that ratio must be found.")
    ] = None,
    level: Annotated[
        str | None, typer.Option("--level", help="Runs for bounds of this level, such as 95%, in place of covariances.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Compute how many runs a verdict needs. Without a pilot, the number holds however steps depend on each other."""
    from consistency.referee.verdicts.judge_sources import pilots_of_records, plan_of_bounds, plan_runs
    from consistency.referee.verdicts.tables import bound_plan_lines, plan_lines

    if level is not None:
        if scenario is not None or like is not None or lost is not None or groups is not None or allow is not None:
            raise InputError("--level: goes with --detect, --false-alarm and --power alone; it needs no pilot")
        of_bounds = plan_of_bounds(level, detect, false_alarm, power)
        print(json.dumps(of_bounds, indent=2) if as_json else "\n".join(bound_plan_lines(of_bounds)))
        return
    if scenario is not None and like is not None:
        raise InputError("give either a SCENARIO for a pilot or --like RESULTS")
    if filters and scenario is None and like is None:
        raise InputError("--filter goes with a SCENARIO or --like RESULTS")
    if scenario is not None and not filters:
        raise InputError(f"--filter: name the filter to plan for in {scenario}")
    pilots: dict[str, Any] | None = None
    pilot_dof = len(POSE)
    if like is not None and are_files(like, Reading()):
        pilots, pilot_dof = pilots_of_records(read_files(like, Reading()), filters)
        dof = pilot_dof
    elif like is not None or (scenario is not None and filters):
        plan_runs(dof, detect, false_alarm, power, allow, lost=lost, groups=groups)  # refuse before the work
        from consistency.bench.runs import montecarlo, results_to_records
        from consistency.bench.scenario import load_scenario
        from consistency.bench.store.results import Tables, open_results

        results: Tables
        if like is not None:
            results = open_results(like)
        else:
            results = montecarlo.run_trials(load_scenario(str(scenario)), filters or (), pilot_runs, seed)
        pilots = {}
        for record in results_to_records.records_of_results(results, filters):  # one in memory at a time
            pilots |= pilots_of_records([record])[0]
    planned = plan_runs(dof, detect, false_alarm, power, allow, pilots, lost, pilot_dof, groups)
    if as_json:
        print(json.dumps(planned, indent=2))
    else:
        print("\n".join(plan_lines(planned)))


@reads_files(without=GROUPED)
def compare_command(
    path: Judged,
    files: Reading,
    other: Annotated[
        Path | None, typer.Argument(metavar="[OTHER]", help="Earlier files in the same form, or a file of 'baseline'.")
    ] = None,
    filters: Annotated[
        list[str] | None,
        typer.Option(
            "--filter",
            metavar="NAME",
            help="Filters to compare, the first with the rest; with OTHER, the filter to use in both.",
        ),
    ] = None,
    false_alarm: FalseAlarm = FALSE_ALARM,
    skip: Skip = None,
    as_json: AsJson = False,
    fail_on: Annotated[
        str | None, typer.Option("--fail-on", help="'worse': exit with status 1 if the first is worse.")
    ] = None,
) -> None:
    """Compare a filter with another, or with an earlier version. On the same trials, the comparison is run by run."""
    from consistency.referee.verdicts.compare_sources import (
        compare_filters,
        compare_with,
        comparison_document,
        is_baseline,
    )
    from consistency.referee.verdicts.judge_sources import skip_asked

    require_word("--fail-on", fail_on, "worse")
    if not 0.0 < false_alarm < 1.0:
        raise InputError(f"--false-alarm must lie between 0 and 1, got {false_alarm}")
    first = skip_asked(skip)
    sides = [each for each in (path, other) if each is not None]
    estimates = [each for each in sides if not is_baseline(each) and are_files(each, files)]
    if not estimates and (unread := files.given()):
        raise InputError(f"{flag_of(unread[0])}: is for files of another estimator, and none is named")
    if len(estimates) == 2 and files.sources.covariance is not None:
        raise InputError(
            f"--covariance: would be read with {path} and with {other}; keep one of them with 'consistency baseline'"
        )
    read = {each: read_files(each, files) for each in estimates}
    new, *old = (_summaries(each, read.get(each), first, files.sources.truth) for each in sides)
    if old:
        compared = compare_with(new, old[0], filters or [], false_alarm)
    else:
        compared = compare_filters(new, filters or [], false_alarm)
    tell_notes(*read.values())
    print_document(comparison_document(compared), as_json)
    if fail_on and any(each.worse for each in compared):
        raise typer.Exit(1)


def _summaries(path: Path, recordings: list[Record] | None, first: FirstSteps | None, truth: Path | None) -> Baseline:
    """Return a row for each run of estimates, of a folder of results, or of a file of 'baseline'."""
    from consistency.referee.verdicts.compare_sources import baseline, read_baseline

    if recordings is not None:
        return baseline(recordings, str(path), first, truth)
    if path.is_dir():
        from consistency.bench.runs.results_to_records import results_source

        return baseline(results_source(path), str(path), first)
    return read_baseline(path, first)


@reads_files(without=GROUPED)
def baseline_command(
    path: Judged,
    out: Annotated[Path, typer.Option("--out", help="JSON file to write; small enough for version control.")],
    files: Reading,
    skip: Skip = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Overwrite an existing file.")] = False,
) -> None:
    """Store what a later 'compare' needs, one row a run."""
    from consistency.referee.verdicts.compare_sources import baseline as summarise
    from consistency.referee.verdicts.compare_sources import write_baseline

    recordings: list[Record] = []
    source: Source | list[Record]
    if are_files(path, files):
        source = recordings = read_files(path, files)
    else:
        from consistency.bench.runs.results_to_records import results_source

        source = results_source(path)
    write_baseline(summarise(source, str(path), skip, files.sources.truth), out, overwrite)
    tell_notes(recordings)
    print(f"baseline in {out}; next: consistency compare NEW {out}")


@reads_files(only=("columns", "dof"))
def monitor_command(
    path: Annotated[
        str,
        typer.Argument(
            metavar="FILE",
            help="Innovations of one run: .csv, .parquet, .npz, .ulg of PX4, .bin of ArduPilot, a folder of 'run', "
            "or - for CSV lines.",
        ),
    ],
    files: Reading,
    innovations: Annotated[
        str | None,
        typer.Option("--innovations", help="'optimal': declare the optimal gain, without which nothing is judged."),
    ] = None,
    false_alarm: Annotated[
        float, typer.Option("--false-alarm", help="Probability that a correct filter ever raises an alarm.")
    ] = GATE_FALSE_ALARM,
    tolerance: Annotated[
        float, typer.Option("--tolerance", help="Accept scales of the NIS up to this ratio; 1 is the exact test.")
    ] = NIS_TOLERANCE,
    gate: Annotated[
        str | None,
        typer.Option(
            "--gate",
            metavar="P",
            help="Judge the filter's chi-square gate, too, of this probability: 99% or 0.99.",
        ),
    ] = None,
    mission: Annotated[
        int | None, typer.Option("--mission", help="Number of innovations of the whole mission, if known.")
    ] = None,
    filter_name: Annotated[
        str | None, typer.Option("--filter", help="Filter to use if FILE holds several; for flight logs, the sensor.")
    ] = None,
    run: Annotated[
        int | None,
        typer.Option("--run", help="Run to use if FILE holds several; for flight logs, the instance of the EKF."),
    ] = None,
    skip: Skip = None,
    plot: Annotated[Path | None, typer.Option("--plot", help="Plot of NIS and evidence, .png, .pdf or .svg.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Overwrite an existing plot.")] = False,
    as_json: AsJson = False,
    fail_on: Annotated[str | None, typer.Option("--fail-on", help="'alarm': exit with status 1 on an alarm.")] = None,
) -> None:
    """Watch the innovations of a deployed filter. Raise an alarm if their size is not what the filter states."""
    from consistency.referee.pages.write_pages import require_plot
    from consistency.referee.readers.formats.flight_logs import STATED, is_dataflash
    from consistency.referee.readers.formats.innovation_files import refuse_options
    from consistency.referee.verdicts.judge_sources import skip_asked
    from consistency.referee.verdicts.monitor_sources import (
        make_monitor,
        monitor_document,
        read_innovations,
        refuse_bags,
        skip_first,
        watch,
        watch_lines,
    )

    require_word("--fail-on", fail_on, "alarm")
    if path != "-":
        refuse_bags(Path(path))
    first = skip_asked(skip)
    if is_dataflash(Path(path)) and filter_name not in STATED:
        if refused := given_options(fail_on=fail_on, gate=gate, mission=mission, skip=skip):
            option = next(iter(refused)).replace("_", "-")
            raise InputError(f"--{option}: {path} holds test ratios, of which nothing is judged, unless --filter names "
                             f"{' or '.join(STATED)}")  # fmt: skip
        _show_ratios(Path(path), filter_name, run, plot, overwrite, as_json)
        return
    watcher = make_monitor(innovations, false_alarm=false_alarm, tolerance=tolerance, gate=gate, mission=mission)
    if path == "-":
        options = given_options(filter=filter_name, run=run, skip=skip, plot=plot)
        if options:
            raise InputError(f"--{next(iter(options))}: does not go with lines as they come (-)")
        watched = watch_lines(sys.stdin, "stdin", watcher, partial(print, file=sys.stderr, flush=True), files)
    else:
        if Path(path).is_dir():
            from consistency.bench.runs.results_to_records import innovations_of

            refuse_options(Path(path), files)
            log = innovations_of(Path(path), filter_name, run)
        else:
            log = read_innovations(Path(path), filter_name, run, files)
        log = skip_first(log, first)
        tell(log.notes)
        if plot is not None:
            require_plot(plot, overwrite)
        watched = watch(log, watcher)
    start = min(watched.t, default=0.0)
    said = monitor_document(watched.name, watched.monitor, watched.alarm, watched.alarm_t, watched.since_t, start)
    _print_and_plot(said, as_json, watched, plot)
    if fail_on and watched.alarm is not None:
        raise typer.Exit(1)


def _show_ratios(
    path: Path, sensor: str | None, core: int | None, plot: Path | None, overwrite: bool, as_json: bool
) -> None:
    """Test ratios of a log that holds no variances of its innovations, of which nothing is judged."""
    from consistency.referee.pages.write_pages import require_plot
    from consistency.referee.readers.formats.flight_logs import read_ratios
    from consistency.referee.verdicts.monitor_sources import ratios_document

    if plot is not None:
        require_plot(plot, overwrite)
    ratios, notes = read_ratios(path, sensor, core)
    tell(notes)
    _print_and_plot(ratios_document(path.stem, ratios), as_json, ratios, plot)


def _print_and_plot(said: Document, as_json: bool, shown: Watched | Sequence[GateRatios], plot: Path | None) -> None:
    print_document(said, as_json)
    if plot is not None:
        from consistency.referee.pages.ratio_figures import monitor_drawing
        from consistency.referee.pages.write_pages import plotted

        plotted(partial(monitor_drawing, shown), plot)
