"""Comparisons: ``compare`` and ``baseline``; they parse, call and print."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from consistency.commands.shared_options import (
    AsJson,
    FalseAlarm,
    Judged,
    Skip,
    are_files,
    print_document,
    read_files,
    reads_files,
    require_word,
    tell_notes,
)
from consistency.referee.defaults import FALSE_ALARM
from consistency.referee.errors import InputError
from consistency.referee.readers.options import GROUPED, Reading, flag_of

if TYPE_CHECKING:
    from consistency.referee.diagnostics.records.record import Record
    from consistency.referee.diagnostics.records.skipped_start import Skip as FirstSteps
    from consistency.referee.verdicts.baselines import Baseline
    from consistency.referee.verdicts.judge_sources import Source


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
    from consistency.referee.verdicts.baselines import is_baseline
    from consistency.referee.verdicts.compare_sources import compare_filters, compare_with, comparison_document
    from consistency.referee.verdicts.judge_sources import skip_asked

    require_word("--fail-on", fail_on, "worse")
    if not 0.0 < false_alarm < 1.0:
        raise InputError(f"--false-alarm must lie between 0 and 1, got {false_alarm}")
    first = skip_asked(skip)
    sides = [each for each in (path, other) if each is not None]
    estimates = [each for each in sides if not is_baseline(each) and are_files(each, files)]
    if not estimates and (unread := files.given()):
        raise InputError(f"{flag_of(unread[0])}: is for files of another estimator, and none is named")
    if len(estimates) == 2 and files.covariance is not None:
        raise InputError(
            f"--covariance: would be read with {path} and with {other}; keep one of them with 'consistency baseline'"
        )
    read = {each: read_files(each, files) for each in estimates}
    new, *old = (_summaries(each, read.get(each), first, files.truth) for each in sides)
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
    from consistency.referee.verdicts.baselines import baseline, read_baseline

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
    from consistency.referee.verdicts.baselines import baseline as summarise
    from consistency.referee.verdicts.baselines import write_baseline

    recordings: list[Record] = []
    source: Source | list[Record]
    if are_files(path, files):
        source = recordings = read_files(path, files)
    else:
        from consistency.bench.runs.results_to_records import results_source

        source = results_source(path)
    write_baseline(summarise(source, str(path), skip, files.truth), out, overwrite)
    tell_notes(recordings)
    print(f"baseline in {out}; next: consistency compare NEW {out}")
