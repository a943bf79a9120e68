"""Records of files and verdicts on them, which draw themselves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from consistency.referee.diagnostics import Evidence, Verdict
from consistency.referee.diagnostics.wording import plural
from consistency.referee.document.blocks import Bullets, Facts
from consistency.referee.errors import InputError
from consistency.referee.extras import require
from consistency.referee.reading.options import Reading
from consistency.referee.show.static import block
from consistency.referee.sources import read_recordings
from consistency.referee.system.atomic import write_whole
from consistency.referee.verdicts.files import analyse_recordings
from consistency.referee.verdicts.options import settings_of, skip_asked

if TYPE_CHECKING:
    from consistency.referee.document.drawing import Sheet
    from consistency.referee.show.paper import Drawn


@dataclass(frozen=True, repr=False)
class Record(Evidence):
    """Estimates of one estimator from files, beside the truth; made by :func:`read`."""

    def plot(self, path: str | Path | None = None) -> Drawn:
        """Error of each component in one run with the stated 2-sigma bounds, and the coverage.

        Parameters
        ----------
        path : .png, .pdf or .svg to write as well; one that is there is replaced

        Returns
        -------
        A figure of Matplotlib, which notebooks show

        Raises
        ------
        InputError
            There is no error to draw, or the file cannot be written.
        """
        from consistency.referee.pages.files import record_sheet

        return _drawn(record_sheet(self), path)

    def __repr__(self) -> str:
        runs, unit = plural(len(self.run_numbers), "run"), "step" if self.window is None else "window"
        size = f"{runs} x {plural(len(self.t), unit)}"
        return f"<Record {self.name}: {size}, error {self.convention or '-'} of {', '.join(self.axes)}>"

    def _repr_html_(self) -> str:
        rows = (
            ("runs", str(len(self.run_numbers))), ("steps", str(len(self.t))), ("error", self.convention or "-"),
            ("components", ", ".join(self.axes)), ("failed runs", str(len(self.failures))),
        )  # fmt: skip
        return f"<div><strong>{escape(self.name)}</strong>{block(Facts(rows))}{block(Bullets(self.notes))}</div>"


@dataclass(frozen=True, repr=False)
class Judgement(Verdict):
    """A verdict on a :class:`Record`; made by :func:`judge`."""

    record: Record | None = None

    def plot(self, path: str | Path | None = None) -> Drawn:
        """Errors with their bounds, NEES with its band, and coverage; arguments of :meth:`Record.plot`."""
        from consistency.referee.pages.files import record_sheet

        assert self.record is not None
        return _drawn(record_sheet(self.record, self), path)

    def _repr_html_(self) -> str:
        from consistency.referee.pages.plain import picture

        assert self.record is not None
        return super()._repr_html_() + "".join(map(block, picture(self.record, self)))


def read(
    estimates: str | Path,
    truth: str | Path | None = None,
    covariance: str | Path | None = None,
    error: str | None = None,
    *,
    state: Sequence[str] | None = None,
    covariance_order: str | None = None,
    max_dt: float | None = None,
    time_offset: float | str | None = None,
    axes: Sequence[str] | None = None,
    topic: str | None = None,
    truth_topic: str | None = None,
    body: str | None = None,
    relative: str | float | None = None,
    motions: bool = False,
    windows: str | None = None,
    align: str | None = None,
    filter: str | None = None,
) -> Record:
    """Read files of another estimator, as ``consistency analyse FILES`` does; docs/files.md has the formats.

    Parameters
    ----------
    estimates : .csv, .parquet, .npz, a TUM trajectory, or a folder of these with one for each run
    truth : of the same kind, or the folder of a KITTI drive; not with .npz
    covariance : of a TUM trajectory: t and 36 or 21 numbers
    error : error that the covariance describes: so2, vector, left, right, so3 or so3-body; None is the default
    state : names of the columns that make up the state, in .csv and .parquet; None is x, y, heading
    covariance_order : translation-rotation or rotation-translation, of a trajectory
    max_dt : s, between an estimate and its truth; None is 0.01
    time_offset : s to add to the timestamps of the estimates, or "estimate"
    axes : components of the error of a trajectory that are judged: of x, y, z, roll, pitch, yaw
    topic, truth_topic : of a ROS bag: PoseWithCovarianceStamped or Odometry; poses, or PARENT:CHILD of /tf
    body : whose poses a KITTI drive gives as truth: imu (default), velodyne or camera
    relative : judge motions over windows of so many steps (100), seconds ("10s") or metres ("50m")
    motions : with ``relative``: each row is a motion with a covariance of its own, not a pose
    windows : "independent" declares errors of different windows independent, so that each is a run
    align : none, origin, posyaw, posyaw-all, se3 or se3-all: how estimates are moved into the world of the truth
    filter : which estimator, where the files hold several

    Raises
    ------
    InputError
        Something cannot be used: names file, line, column or option, and what is allowed.
    """
    true, stated = (None if path is None else Path(path) for path in (truth, covariance))
    reading = Reading(
        true, stated, error, state, covariance_order, max_dt, time_offset, axes, topic, truth_topic, body, relative,
        motions or None, windows, align,
    )  # fmt: skip
    found = read_recordings(Path(estimates), reading)
    named = {recording.name: recording for recording in found}
    if filter is None and len(named) > 1:
        raise InputError(f"{estimates}: holds several estimators ({', '.join(named)}); choose one with filter=")
    name = next(iter(named)) if filter is None else filter
    if name not in named:
        raise InputError(f"filter '{name}' is not in {estimates}; there are: {', '.join(named)}")
    return Record(**_parts(named[name]))


def judge(record: Record, *, optimal_gain: bool = False, skip: str | float | None = None, **settings: Any) -> Judgement:
    """Judge a record: consistent, overconfident, conservative, undecided, ..., with reasons.

    Parameters
    ----------
    optimal_gain : True if the filter has an optimal gain and gates nothing away: its innovations are then judged
    skip : first steps (20) or seconds ("2s") of each run to leave out of the statistics, chosen on other data
    settings : ``false_alarm``, ``detect``, ``power``, ``tolerance``, ``allow``, ``lost`` of
        :class:`consistency.diagnostics.Settings`

    Raises
    ------
    InputError
        A setting out of its range, or nothing is left.
    """
    record = cast(Record, record.without_first(skip_asked(skip)))
    verdict = analyse_recordings([record], None, settings_of(**settings), optimal_gain)[record.name]
    return Judgement(**_parts(verdict), record=record)


def _parts(of: Any) -> dict[str, Any]:
    return {field.name: getattr(of, field.name) for field in fields(of)}


def _drawn(sheet: Sheet, path: str | Path | None) -> Drawn:
    require("a plot", "plot")
    from consistency.referee.show.paper import drawn, picture

    figure = drawn(sheet)
    if path is not None:
        from consistency.referee.pages import require_plot

        path = Path(path)
        require_plot(path, overwrite=True)
        write_whole(path, picture(figure, path.suffix.lower().removeprefix(".")), 0o644)
    return figure
