"""``consistency characterise``: parses, calls, prints."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from consistency.cli.app import app
from consistency.errors import InputError


@app.command()
def characterise(
    source: Annotated[
        Path, typer.Argument(metavar="LOG|IMAGES", help="Log folder with truth, or folder of stereo pairs.")
    ],
    out: Annotated[Path, typer.Option("--out", help="sensor.toml to write: a scenario or log can believe it.")],
    grid: Annotated[str, typer.Option("--grid", metavar="KxL", help="Nodes of the bias map, across and down.")] = "5x4",
    at_rest: Annotated[bool, typer.Option("--at-rest", help="The sensor stood still all the time.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the file if it exists.")] = False,
) -> None:
    """Measure a stereo sensor: noise, bias map, growth with disparity, tails, whiteness, each with an interval."""
    from consistency.characterising.printing import print_characterisation
    from consistency.characterising.recorded import characterise_log
    from consistency.characterising.writing import as_json as json_of
    from consistency.characterising.writing import require_free_file, sensor_text, write_sensor

    require_free_file(out, overwrite)
    nodes = _sizes(grid, "--grid", 2)
    measured = characterise_log(source, nodes, at_rest)
    write_sensor(out, sensor_text(measured.of, measured.others))
    if as_json:
        print(json_of(measured.of))
    else:
        print_characterisation(measured.of)
        print(f"sensor in {out}; next: consistency recommend {out}")


def _sizes(text: str, option: str, least: int) -> tuple[int, int]:
    """Two counts of ``KxL``."""
    one, cross, two = text.lower().partition("x")
    if not (cross and one.isdecimal() and two.isdecimal() and min(int(one), int(two)) >= least):
        raise InputError(f"{option} {text}: must be two numbers of at least {least}, as 5x4")
    return int(one), int(two)
