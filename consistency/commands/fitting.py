"""``consistency fit-covariance`` and ``correct``: parse, call, print."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from consistency.commands.shared_options import (
    ESTIMATES,
    AsJson,
    Skip,
    print_document,
    read_files,
    reads_files,
    require_word,
    require_written,
    tell_notes,
)
from consistency.referee.errors import InputError
from consistency.referee.readers.options import OPTIONS, Reading

KEPT = (
    "truth", "max_dt", "time_offset", "topic", "truth_topic", "body", "columns", "truth_columns", "world", "body_axes",
    "truth_world", "truth_body_axes",
)  # fmt: skip


@reads_files(only=KEPT)
def fit_covariance_command(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="ESTIMATES", help=f"Poses of an odometry: {ESTIMATES}; a folder has a file for each drive."
        ),
    ],
    files: Reading,
    span: Annotated[
        str,
        typer.Option("--span", metavar="Nm|Ns|N", help="Length of the motions: metres (1m), seconds (1s), steps (10)."),
    ],
    held_out: Annotated[
        str | None,
        typer.Option(
            "--held-out",
            metavar="A,B|half",
            help="Drives to judge and not to fit, or 'half' of each [each drive by the fit of the others].",
        ),
    ] = None,
    axes: Annotated[
        int | None, typer.Option("--axes", help="Number of axes: 3 (x, y, yaw) or 6 [those of the poses].")
    ] = None,
    motions: Annotated[
        bool, typer.Option("--motions", help="Read each row as the motion since the row before.")
    ] = False,
    second: Annotated[
        Path | None,
        typer.Option("--second", help="Poses of another estimator of these drives, to separate errors of the truth."),
    ] = None,
    keep_mean_error: Annotated[
        bool, typer.Option("--keep-mean-error", help="Do not correct mean errors of scale and heading.")
    ] = False,
    no_correct: Annotated[bool, typer.Option("--no-correct", hidden=True)] = False,
    by_turn: Annotated[
        bool, typer.Option("--by-turn", help="Also correct a displacement that each turn adds, such as wheel slip.")
    ] = False,
    cautious: Annotated[
        float | None,
        typer.Option(
            "--cautious", metavar="P", help="Raise all covariances so that they suffice for a share P of new drives."
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Folder for noise.toml, motions, snippets, page.")] = None,
    as_json: AsJson = False,
    fail_on: Annotated[
        str | None, typer.Option("--fail-on", help="'inconsistent': exit with status 1 unless consistent.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Overwrite an existing folder of --out.")] = False,
) -> None:
    """Fit a covariance to odometry that states none. Judge it on other drives."""
    from consistency.referee.fit_covariance.drives import read_drives
    from consistency.referee.fit_covariance.noise_model import fit_covariance as fit
    from consistency.referee.fit_covariance.noise_model import noise_document
    from consistency.referee.system import require_free

    require_word("--fail-on", fail_on, "inconsistent")
    require_written(overwrite, out, "--out")
    if out is not None:
        require_free(out, overwrite, "noise")
    drives = read_drives(path, reading=files.with_options(motions=motions or None))
    other = None if second is None else read_drives(second, reading=files)
    mean = not (keep_mean_error or no_correct)
    model = fit(
        drives, span, held_out=held_out, axes=axes, correct=mean, by_turn=by_turn, cautious=cautious, second=other,
        name=path.stem,
    )  # fmt: skip
    written: list[Path] = []
    if out is not None:
        from consistency.referee.fit_covariance.fit_files import write_model

        written = write_model(model, out, overwrite)
    if no_correct:
        print("consistency: --no-correct is now called --keep-mean-error", file=sys.stderr)
    print_document(noise_document(model), as_json, written)
    if fail_on and model.status != "consistent":
        raise typer.Exit(1)


NOT_CORRECTED = ("relative", "motions", "windows", "truth_covariance", "truth_errors", "truth_shared")
CORRECTABLE = [each.name for each in OPTIONS if each.name not in NOT_CORRECTED]


@reads_files(only=CORRECTABLE)
def correct_command(
    path: Annotated[
        Path, typer.Argument(metavar="ESTIMATES", help=f"Estimates, with or without covariances: {ESTIMATES}.")
    ],
    files: Reading,
    per: Annotated[
        str | None,
        typer.Option("--per", metavar="axis", help="'axis': a factor for each component [for each block of them]."),
    ] = None,
    held_out: Annotated[
        str | None,
        typer.Option(
            "--held-out",
            metavar="A,B|half",
            help="Runs that are judged and not fitted, or the second half [each by the factors of the others].",
        ),
    ] = None,
    skip: Skip = None,
    name: Annotated[
        str | None, typer.Option("--filter", metavar="NAME", help="Which, if the files hold several estimators.")
    ] = None,
    anyway: Annotated[
        bool, typer.Option("--anyway", help="Write a correction also where no factor mends what is wrong.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder for correction.toml, corrected runs, lines for other programs, page."),
    ] = None,
    as_json: AsJson = False,
    fail_on: Annotated[
        str | None, typer.Option("--fail-on", help="'inconsistent': exit 1 unless consistent after.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a folder of --out.")] = False,
) -> None:
    """Find factors for what is stated, or variances where nothing is. Judge them on held-out runs."""
    from consistency.referee.fit_covariance.correct import correct, correction_document, the_record
    from consistency.referee.fit_covariance.correct_bounds import BoundCorrection, bound_correction_document
    from consistency.referee.readers.formats.restated import text_files
    from consistency.referee.system import require_free
    from consistency.referee.verdicts.judge_sources import skip_asked

    require_word("--per", per, "axis")
    require_word("--fail-on", fail_on, "inconsistent")
    require_written(overwrite, out, "--out")
    if out is not None:
        require_free(out, overwrite, "correction")
    align = files.matching.align
    if per is not None and align not in (None, "none", "origin"):
        raise InputError(f"--per axis: does not go with --align {align}, which turns the axes of the covariances")
    files = files.with_options(unstated=files.statement.level is None)
    records = read_files(path, files)
    record = the_record(records, name).without_first(skip_asked(skip))
    texts = text_files(path, files, record.name)
    names = None
    if len(texts) == len(record.run_numbers) and record.runs.unit == "run" and texts[0].run_column is None:
        names = [texts[run].path.stem for run in record.run_numbers]
    found = correct(record, held_out=held_out, per_axis=per is not None, names=names)
    tell_notes(records)
    written: list[Path] = []
    is_written = out is not None and (anyway or found.status != "inconsistent")
    if out is not None and is_written:
        from consistency.referee.fit_covariance.fit_files import write_bound_correction, write_correction

        if isinstance(found, BoundCorrection):
            written = write_bound_correction(found, record.groups, texts, out, overwrite)
        else:
            written = write_correction(found, record, texts, out, overwrite)
    shown = bound_correction_document(found) if isinstance(found, BoundCorrection) else correction_document(found)
    print_document(shown, as_json, written)
    if out is not None and not is_written:
        print(
            f"consistency: {out} is not written, as no factor mends what is wrong; --anyway writes it", file=sys.stderr
        )
        raise typer.Exit(1)
    if fail_on and found.status != "consistent":
        raise typer.Exit(1)
