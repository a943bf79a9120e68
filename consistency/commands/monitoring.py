"""``consistency monitor``: parses, calls, prints."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from consistency.commands.shared_options import (
    AsJson,
    Skip,
    given_options,
    print_document,
    reads_files,
    require_word,
    tell,
)
from consistency.referee.defaults import GATE_FALSE_ALARM
from consistency.referee.errors import InputError
from consistency.referee.readers.options import Reading

if TYPE_CHECKING:
    from consistency.referee.readers.formats.innovation_files import NisLog


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
    ] = 1.2,
    gate: Annotated[
        float | None, typer.Option("--gate", help="Probability of the filter's chi-square gate, such as 0.99.")
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
    from consistency.referee.document.alarms import monitor_document
    from consistency.referee.pages.write_pages import plotted, require_plot
    from consistency.referee.readers.formats.ardupilot_log import STATED, is_dataflash
    from consistency.referee.verdicts.judge_sources import skip_asked
    from consistency.referee.verdicts.monitor_sources import make_monitor, watch, watch_lines, without_first

    require_word("--fail-on", fail_on, "alarm")
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
        log = without_first(_read_innovations(Path(path), filter_name, run, files), first)
        tell(log.notes)
        if plot is not None:
            require_plot(plot, overwrite)
        watched = watch(log, watcher)
    print_document(
        monitor_document(
            watched.name, watched.monitor, watched.alarm, watched.alarm_t, watched.since_t, min(watched.t, default=0.0)
        ),
        as_json,
    )
    if plot is not None:
        from consistency.referee.pages.nis_over_time import monitor_drawing

        plotted(partial(monitor_drawing, watched), plot)
    if fail_on and watched.alarm is not None:
        raise typer.Exit(1)


def _read_innovations(path: Path, filter_name: str | None, run: int | None, files: Reading) -> NisLog:
    """Return the innovations of one run in a file, or in a folder of results."""
    if path.is_dir():
        from consistency.bench.runs.results_to_records import innovations_of
        from consistency.referee.readers.formats.innovation_files import refuse_options

        refuse_options(path, files)
        return innovations_of(path, filter_name, run)
    from consistency.referee.verdicts.monitor_sources import read_innovations

    return read_innovations(path, filter_name, run, files)


def _show_ratios(
    path: Path, sensor: str | None, core: int | None, plot: Path | None, overwrite: bool, as_json: bool
) -> None:
    """Test ratios of a log that holds no variances of its innovations, of which nothing is judged."""
    from consistency.referee.document.alarms import ratios_document
    from consistency.referee.pages.write_pages import plotted, require_plot
    from consistency.referee.readers.formats.ardupilot_log import read_ratios

    if plot is not None:
        require_plot(plot, overwrite)
    ratios, notes = read_ratios(path, sensor, core)
    tell(notes)
    print_document(ratios_document(path.stem, ratios), as_json)
    if plot is not None:
        from consistency.referee.pages.nis_over_time import monitor_drawing

        plotted(partial(monitor_drawing, ratios), plot)
