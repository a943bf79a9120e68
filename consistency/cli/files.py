"""Options of files of another estimator, which several commands read."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

if TYPE_CHECKING:
    from consistency.recording import Recording


@dataclass(frozen=True)
class FileOptions:
    """How files are read; None where an option is not given."""

    truth: Annotated[
        Path | None,
        typer.Option("--truth", help="Truth of the estimates, in the same form, or a KITTI drive's folder."),
    ] = None
    covariance: Annotated[
        Path | None, typer.Option("--covariance", help="Covariances of a TUM trajectory: t and 36 or 21 numbers.")
    ] = None
    error: Annotated[
        str | None,
        typer.Option("--error", help="Error that the covariance is of: so2, vector, left, right, so3 or so3-body."),
    ] = None
    state: Annotated[
        str | None, typer.Option("--state", metavar="A,B,C", help="Columns that make up the state [x,y,heading].")
    ] = None
    covariance_order: Annotated[
        str | None,
        typer.Option("--covariance-order", help="translation-rotation [default] or rotation-translation."),
    ] = None
    max_dt: Annotated[
        float | None, typer.Option("--max-dt", help="Seconds between an estimate and its truth at most [0.01].")
    ] = None
    time_offset: Annotated[
        str | None,
        typer.Option("--time-offset", metavar="S|estimate", help="Seconds to add to the estimates' timestamps."),
    ] = None
    axes: Annotated[
        str | None,
        typer.Option("--axes", metavar="A,B,C", help="Components of a trajectory to judge, as x,y,yaw in the plane."),
    ] = None
    topic: Annotated[
        str | None, typer.Option("--topic", help="Of a ROS bag: Odometry or PoseWithCovarianceStamped.")
    ] = None
    truth_topic: Annotated[
        str | None, typer.Option("--truth-topic", help="Of a ROS bag: poses, or PARENT:CHILD, frames of /tf.")
    ] = None
    body: Annotated[
        str | None, typer.Option("--body", help="Of a KITTI drive as truth: imu [default], velodyne or camera.")
    ] = None
    relative: Annotated[
        str | None,
        typer.Option(
            "--relative",
            metavar="N|Ns|Nm",
            help="Judge motions over windows: N steps, seconds (10s), metres (50m).",
        ),
    ] = None
    motions: Annotated[
        bool | None,
        typer.Option(
            "--motions/", help="With --relative: each row is a motion with a covariance of its own.", show_default=False
        ),
    ] = None
    windows: Annotated[
        str | None, typer.Option("--windows", help="'independent': errors of windows are, so that each is a run.")
    ] = None
    align: Annotated[
        str | None,
        typer.Option(
            "--align",
            metavar="MODE",
            help="Move estimates into the world of the truth: none [default]; origin, by the first pose of each run; "
            "posyaw or se3, by a frame fitted to each run; posyaw-all or se3-all, by one for all runs.",
        ),
    ] = None

    def given(self) -> list[str]:
        """Options that were given, as they are written."""
        return [f"--{field.name.replace('_', '-')}" for field in fields(self) if getattr(self, field.name) is not None]

    def reading(self) -> dict[str, Any]:
        """As :func:`consistency.recording.read_recordings` takes them."""
        options = asdict(self)
        options["convention"] = options.pop("error")
        return options | {
            "state": _names(self.state), "axes": _names(self.axes), "time_offset": _seconds(self.time_offset),
            "align": None if self.align == "none" else self.align,
        }  # fmt: skip

    def are(self, path: Path) -> bool:
        """Whether a path is files of another estimator, and no folder of ``consistency run``."""
        from consistency.recording import is_recording

        return is_recording(path, **self.reading())

    def read(self, path: Path) -> list[Recording]:
        """Files of another estimator."""
        from consistency.recording import read_recordings

        return read_recordings(path, **self.reading())


def tell_notes(*read: list[Recording]) -> None:
    """What was assumed and left out, to standard error; said when nothing is refused any more."""
    from consistency.reading import one_line

    for note in dict.fromkeys(note for recordings in read for one in recordings for note in one.notes):
        print(f"consistency: {one_line(note, 4000)}", file=sys.stderr)


def reads_files(command: Callable[..., Any]) -> Callable[..., Any]:
    """A command with the options of files, which it gets as one argument ``files``."""
    signature = inspect.signature(command, eval_str=True)
    shared = get_type_hints(FileOptions, include_extras=True)
    own = {
        field.name: inspect.Parameter(
            field.name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=shared[field.name]
        )
        for field in fields(FileOptions)
    }

    @wraps(command)
    def with_files(**given: Any) -> Any:
        return command(files=FileOptions(**{name: given.pop(name) for name in own}), **given)

    parameters = []
    for name, parameter in signature.parameters.items():
        parameters += list(own.values()) if name == "files" else [parameter.replace(kind=parameter.KEYWORD_ONLY)]
    with_files.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    with_files.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return with_files


def _names(text: str | None) -> list[str] | None:
    return None if text is None else [name.strip() for name in text.split(",")]


def _seconds(text: str | None) -> float | str | None:
    """A number where the text is one."""
    try:
        return text if text is None else float(text)
    except ValueError:
        return text
