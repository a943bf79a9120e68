"""``consistency fit-covariance``: parses, calls, prints."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from consistency.commands.shared_options import (
    ESTIMATES,
    AsJson,
    print_document,
    reads_files,
    require_word,
    require_written,
)
from consistency.referee.readers.options import Reading

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
    no_correct: Annotated[
        bool, typer.Option("--no-correct", help="Do not correct mean errors of scale and heading.")
    ] = False,
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
    from dataclasses import replace

    from consistency.referee.fit_covariance.drives import read_drives
    from consistency.referee.fit_covariance.model_text import noise_document
    from consistency.referee.fit_covariance.noise_model import fit_covariance as fit
    from consistency.referee.system.folders import require_free

    require_word("--fail-on", fail_on, "inconsistent")
    require_written(overwrite, out, "--out")
    if out is not None:
        require_free(out, overwrite, "noise")
    drives = read_drives(path, reading=replace(files, motions=motions or None))
    other = None if second is None else read_drives(second, reading=files)
    model = fit(
        drives, span, held_out=held_out, axes=axes, correct=not no_correct, by_turn=by_turn, cautious=cautious,
        second=other, name=path.stem,
    )  # fmt: skip
    written: list[Path] = []
    if out is not None:
        from consistency.referee.fit_covariance.writing import write_model

        written = write_model(model, out, overwrite)
    print_document(noise_document(model), as_json, written)
    if fail_on and model.status != "consistent":
        raise typer.Exit(1)
