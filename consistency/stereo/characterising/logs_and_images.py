"""What is characterised: a log, stereo pairs in the order of time, or stereo pairs of a chessboard."""

from __future__ import annotations

from pathlib import Path

from consistency.referee.errors import InputError
from consistency.stereo.characterising.bias_map import GRID
from consistency.stereo.characterising.from_log import MeasuredSensor, SourceOptions, characterise_log, is_log

WIDEST = 10.0  # m, of a square of a board; more are millimetres
NODES, CORNERS = 2, 3  # least numbers across and down, of nodes of a bias map and of corners


def characterise_source(source: Path, options: SourceOptions) -> MeasuredSensor:
    """The sensor of a log folder or of a folder of images.

    Raises
    ------
    InputError
        Options that do not go together or with the source, and whatever the source lacks.
    """
    if not source.is_dir():
        raise InputError(f"{source}: no such folder; give a log, or a folder of stereo pairs")
    if is_log(source):
        if given := options.of_images():
            raise InputError(f"{given[0]}: goes with images, but {source} is a log")
        return characterise_log(source, options.grid or GRID, options.at_rest, options.free_poses)
    if (options.board is None) != (options.square is None):
        raise InputError(
            "--board and --square go together: without the size of its squares, the depth of a plane is not known, and "
            "so not what its disparities should be"
        )
    if options.board is None or options.square is None:
        return _of_sequence(source, options)
    if not 0.0 < options.square < WIDEST:
        raise InputError(f"--square {options.square:g}: must be a positive number of metres, below {WIDEST:g}")
    if options.seed is not None:
        raise InputError("--seed: goes with images without a board; nothing is drawn at random from one")
    if options.at_rest or options.truth is not None:
        raise InputError("--board: goes neither with --at-rest nor with --truth; the poses of the board are fitted")
    from consistency.stereo.characterising.boards import characterise_board

    model = options.distortion or "full"
    return MeasuredSensor(characterise_board(source, options.board, options.square, model, options.grid or GRID), {})


def _of_sequence(source: Path, options: SourceOptions) -> MeasuredSensor:
    from consistency.stereo.characterising.from_pairs import characterise_images

    if options.distortion is not None:
        raise InputError("--distortion: goes with --board; other images bring their calibration")
    if options.grid is not None:
        raise InputError("--grid: goes with a log or with --board; images of an unknown scene give no bias map")
    return MeasuredSensor(characterise_images(source, options), {})


def parse_counts(text: str, option: str, least: int) -> tuple[int, int]:
    """Two counts of ``KxL``.

    Raises
    ------
    InputError
        ``text`` is something else, or one of them is below ``least``.
    """
    one, cross, two = text.lower().partition("x")
    are_numbers = one.isdecimal() and two.isdecimal()
    if not cross or not are_numbers or min(int(one), int(two)) < least:
        raise InputError(f"{option} {text}: must be two numbers of at least {least}, as 9x6")
    return int(one), int(two)
