"""Verdicts: ``analyse``, ``report`` and ``plan``; they parse, call and print."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from consistency.commands.shared_options import (
    DETECT_HELP,
    ESTIMATES,
    LOST_HELP,
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
    tell_notes,
)
from consistency.referee.column_names import POSE
from consistency.referee.defaults import DETECT, FALSE_ALARM, POWER
from consistency.referee.errors import InputError
from consistency.referee.extras import missing, remedy
from consistency.referee.readers.options import Reading

if TYPE_CHECKING:
    from consistency.referee.diagnostics.records.record import Record
    from consistency.referee.verdicts.judge_sources import Source


@reads_files
def analyse_command(
    path: Judged,
    files: Reading,
    filters: Annotated[
        list[str] | None, typer.Option("--filter", metavar="NAME", help="Only this filter; may be repeated.")
    ] = None,
    false_alarm: Annotated[
        float | None,
        typer.Option("--false-alarm", help=f"Probability of finding a fault in a correct filter [{FALSE_ALARM}]."),
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
        typer.Option("--report", help="Folder for an HTML and a PDF page, or FILE.xml (JUnit), or FILE.md."),
    ] = None,
    verbose: Annotated[
        bool, typer.Option("--verbose", help="Show p values of all questions and credibility indices, too.")
    ] = False,
    as_json: AsJson = False,
    fail_on: Annotated[
        str | None, typer.Option("--fail-on", help="'inconsistent': exit with status 1 unless all are consistent.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Overwrite files other than reports, too.")] = False,
) -> None:
    """Check whether stated covariances match the errors. Explain the verdict."""
    from consistency.referee.document.judged_filters import document
    from consistency.referee.show import FORMATS
    from consistency.referee.verdicts.judge_sources import files_source, judge_all, settings_of, skip_asked

    require_word("--fail-on", fail_on, "inconsistent")
    require_word("--innovations", innovations, "optimal")
    changes = given_options(
        confidence=confidence, false_alarm=false_alarm, detect=detect, tolerance=tolerance, lost=lost
    )
    settings, first = settings_of(**changes) if changes else None, skip_asked(skip)
    written: list[Path] = []
    recordings: list[Record] = []
    refused: InputError | None = None  # of a report, said below the verdict
    is_file = report is not None and report.suffix.lower() in FORMATS.keys() - {".html", ".json"}  # a folder has both
    require_written(overwrite, report, "--report")
    if report is not None:
        from consistency.referee.pages.write_pages import require_report

        overwrite = require_report(report, overwrite)
    if are_files(path, files):
        recordings = [recording.without_first(first) for recording in read_files(path, files)]
        source = files_source(path, recordings)
        verdicts = judge_all(source, filters, settings=settings, optimal_gain=innovations is not None)
        tell_notes(recordings)
        _refuse_unfinished(path, source, "monte-carlo", fail_on)
    else:
        from consistency.bench.runs.results_to_records import results_source

        results = results_source(path)
        if report is not None and not is_file:
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
        from consistency.referee.pages.write_pages import write_file_reports, write_text_file
        from consistency.referee.show.as_json import render

        try:
            if is_file:
                written = [write_text_file(shown, report)]
            else:
                data = render(document(verdicts))
                written = write_file_reports(recordings, verdicts, report, path.name, data, overwrite)
                if missing("report"):
                    print(f"consistency: pictures and the PDF need {remedy('report')}", file=sys.stderr)
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
            metavar="[SCENARIO]", help="Scenario of a short pilot, which shows how steps depend on each other."
        ),
    ] = None,
    filters: Annotated[
        list[str] | None, typer.Option("--filter", metavar="NAME", help="Filter of the pilot; may be repeated.")
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
    as_json: AsJson = False,
) -> None:
    """Compute how many runs a verdict needs. Without a pilot, the number holds however steps depend on each other."""
    from consistency.referee.document.needed_runs import plan_lines
    from consistency.referee.verdicts.planned_runs import pilots_of_records
    from consistency.referee.verdicts.planned_runs import plan as plan_runs

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
