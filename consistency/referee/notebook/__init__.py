"""Files of another estimator in three lines of Python: read, judge, look; also inspect, plan, compare and list.

Their errors name arguments, where those of commands name flags. A record and a verdict show themselves in a notebook by
the functions at the end. What each does stands in ``readers`` and ``verdicts``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from numpy.typing import ArrayLike

from consistency.referee.defaults import DETECT, FALSE_ALARM, POWER
from consistency.referee.diagnostics.judge_record import judge as judge_record
from consistency.referee.diagnostics.number_words import plural
from consistency.referee.diagnostics.record import Record, numbered_axes
from consistency.referee.diagnostics.verdict import Verdict
from consistency.referee.errors import InputError, naming_arguments
from consistency.referee.extras import explained_import
from consistency.referee.readers.formats.members import UNWEIGHTED
from consistency.referee.readers.options import OPTIONS, make_reading
from consistency.referee.readers.pipeline.arrays_in_memory import record_of_statement
from consistency.referee.readers.pipeline.by_column import with_groups
from consistency.referee.readers.pipeline.read_files import checked_options, read_frames, read_recordings
from consistency.referee.readers.truth_covariance import declared, require_truth_options
from consistency.referee.show import as_html
from consistency.referee.show.blocks import Bullets, Facts, Figure, fragment
from consistency.referee.verdicts.compare_sources import Compared, baseline, compare_with, is_baseline, read_baseline
from consistency.referee.verdicts.inspect_sources import Inspection, inspect_files
from consistency.referee.verdicts.judge_sources import pilots_of_records, plan_runs, settings_of, skip_asked
from consistency.referee.verdicts.tables import document, summary_blocks

if TYPE_CHECKING:
    import pandas as pd

OF_PATHS = ("truth", "covariance", "by_file")  # options that are paths
GIVEN = ("same trials", None)  # origin of records whose trials are declared to be the same


@naming_arguments
def read(
    estimates: str | Path | Any,
    truth: str | Path | Any | None = None,
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
    independent: bool = False,
    align: str | None = None,
    lever_arm: Sequence[float] | None = None,
    split: str | int | None = None,
    truth_covariance: str | Path | None = None,
    truth_errors: str | None = None,
    truth_shared: bool = False,
    level: str | float | Mapping[str, Any] | None = None,
    gaussian: bool = False,
    ends: str | None = None,
    alert_limit: str | float | Mapping[str, Any] | None = None,
    by: str | None = None,
    by_file: str | Path | None = None,
    bins: int | Sequence[float] | None = None,
    columns: Mapping[str, str] | None = None,
    truth_columns: Mapping[str, str] | None = None,
    world: str | None = None,
    body_axes: str | None = None,
    truth_world: str | None = None,
    truth_body_axes: str | None = None,
    dof: int | None = None,
    members: Mapping[str, str] | None = None,
    ensemble: int | None = None,
    filter: str | None = None,
) -> Record:
    """Read files of another estimator, as ``consistency analyse FILES`` does; docs/files.md has the formats.

    Parameters
    ----------
    estimates : .csv, .parquet, .npz, a TUM trajectory, or a folder of these with one for each run; or a table in
        memory, as a DataFrame, with the columns of a .csv
    truth : of the same kind, or the folder of a KITTI drive; not with .npz. "repeats": all runs have the same true
        values, which nobody knows
    covariance : of a TUM trajectory: t and 36 or 21 numbers
    error : error that the covariance describes: so2, vector, left, right, so3, so3-body, rvec or euler; None is
        the default, and "guess" judges all that poses have
    state : names of the columns that make up the state, in .csv and .parquet; None is x, y, heading
    covariance_order : translation-rotation or rotation-translation, or blocks in their order, as p,v,R; of a trajectory
    max_dt : s, between an estimate and its truth; None is 0.01
    time_offset : s to add to the timestamps of the estimates, or "estimate"
    axes : components of the error of a trajectory that are judged: of x, y, z, roll, pitch, yaw
    topic, truth_topic : of a ROS bag: PoseWithCovarianceStamped or Odometry; poses, or PARENT:CHILD of /tf
    body : whose poses a KITTI drive gives as truth: imu (default), velodyne or camera
    relative : judge motions over windows of so many steps (100), seconds ("10s") or metres ("50m")
    motions : with ``relative``: each row is a motion with a covariance of its own, not a pose
    windows : "independent" declares errors of different windows independent, so that each is a run
    independent : declares errors of different rows independent, as of images or calibrations, so that each is a run
    align : none, origin, posyaw, posyaw-all, se3 or se3-all: how estimates are moved into the world of the truth
    lever_arm : of a truth of positions alone: its point in the axes of the estimated body, x, y, z, m
    split : split one long log into so many pieces treated as independent runs; "auto" takes the advised number
    truth_covariance : of the truth itself, in the convention of the error: "columns" of its file, or a file of t and 36
        or 21 numbers
    truth_errors : how errors of the truth depend on each other: "independent", "per-run", or "common" to all runs; with
        None only what holds under any dependence is said
    truth_shared : the estimator has fused the truth
    level : of bounds, radii and intervals in columns ``bound_x``, ``radius_x_y``, ``x_low`` and ``x_high``, or the key
        ``bounds``: 0.95, "95%", "2sigma", "CEP"; or by name, ``{"bound_x": 0.95}``
    alert_limit : of protection levels, in their unit, or by name: the verdict has the shares of the Stanford diagram
    gaussian : read them, or deviations at that level, as the covariance of a Gaussian, circular for radii
    ends : "independent" declares that ends of runs and lost runs do not depend on the errors (bounds)
    by : column whose values make groups, in each of which the size of the errors is judged, too: words as they are,
        numbers in quantile bins. It was fixed before the error was: a setting, the environment, time, what had been
        measured so far
    by_file : table with the column and ``t`` (s, the last value at or before a step counts), ``run``, or both
    bins : number of quantile bins of ``by`` (5), or the edges between them
    columns, truth_columns : names of columns here and in the file: ``{"x": "pos_n", "P*": "cov_*"}``
    world, body_axes, truth_world, truth_body_axes : axes of each file, a letter each: "enu" or "ned"; "flu" or "frd".
        A pose maps from its body axes to its world axes
    dof : degrees of freedom of each NIS of a table that has no column of them
    members : columns of a table that hold members of an ensemble: ``{"x": "e*"}``, all that begin with e
    ensemble : number of members whose mean and sample covariance the files state
    filter : which estimator, where the files hold several

    Raises
    ------
    InputError
        Something cannot be used: names file, line, column or option, and what is allowed.
    """
    in_memory = any(hasattr(table, "columns") for table in (estimates, truth))
    true = None if truth is None or in_memory else Path(truth)
    stated = None if covariance is None else Path(covariance)
    of_truth = None if truth_covariance is None else str(truth_covariance)
    reading = make_reading(
        truth=true, covariance=stated, topic=topic, truth_topic=truth_topic, body=body,
        error=error, covariance_order=covariance_order,
        world=world, body_axes=body_axes, truth_world=truth_world, truth_body_axes=truth_body_axes,
        state=state, axes=axes, columns=columns, truth_columns=truth_columns, members=members,
        max_dt=max_dt, time_offset=time_offset, align=align, lever_arm=lever_arm,
        relative=relative, motions=motions or None, windows=windows, independent=independent or None, split=split,
        truth_covariance=of_truth, truth_errors=truth_errors, truth_shared=truth_shared or None,
        level=level, gaussian=gaussian or None, ends=ends, dof=dof, ensemble=ensemble, alert_limit=alert_limit,
        by=by, by_file=None if by_file is None else Path(by_file), bins=bins,
    )  # fmt: skip
    found = read_frames(estimates, truth, reading) if in_memory else read_recordings(Path(estimates), reading)
    where = "estimates" if in_memory else estimates
    named = {recording.name: recording for recording in found}
    if filter is None and len(named) > 1:
        raise InputError(f"{where}: holds several estimators ({', '.join(named)}); choose one with filter=")
    name = next(iter(named)) if filter is None else filter
    if name not in named:
        raise InputError(f"filter '{name}' is not in {where}; there are: {', '.join(named)}")
    return named[name]


@naming_arguments
def inspect(path: str | Path, **options: Any) -> Inspection:
    """Inspect a file: what it holds, and what judges it.

    Parameters
    ----------
    path : file or folder of estimates, a bag, a flight log
    options : of :func:`read`, as far as they are known; others are looked for

    Returns
    -------
    Inspection
        ``print`` shows it. ``command`` is the command line, and ``cs.read(path, **arguments)`` reads what it judges.

    Raises
    ------
    InputError
        The file is missing, or its kind or an option is unknown.
    """
    for name in options:
        if name not in (there := [each.name for each in OPTIONS]):
            raise InputError(f"{name}: is not an option of files; there are: {', '.join(there)}")
    given: dict[str, Any] = {
        name: Path(value) if name in OF_PATHS and value is not None else value for name, value in options.items()
    }
    return inspect_files(Path(path), make_reading(**given))


@naming_arguments
def judge(
    record: Record | str | Path | ArrayLike | None = None,
    covariances: ArrayLike | None = None,
    *,
    deviations: ArrayLike | None = None,
    members: ArrayLike | None = None,
    truth: ArrayLike | str | None = None,
    ensemble: int | None = None,
    bounds: ArrayLike | None = None,
    level: str | float | Mapping[str, Any] | None = None,
    gaussian: bool = False,
    ends: str | None = None,
    alert_limit: str | float | Mapping[str, Any] | None = None,
    axes: Sequence[str] | None = None,
    independent: bool = False,
    name: str = "estimator",
    optimal_gain: bool = False,
    skip: str | float | None = None,
    truth_covariances: ArrayLike | None = None,
    truth_errors: str | None = None,
    truth_shared: bool = False,
    by: ArrayLike | Mapping[str, ArrayLike] | None = None,
    bins: int | Sequence[float] | None = None,
    **settings: Any,
) -> Verdict:
    """Judge a record, a file, or arrays: consistent, overconfident, conservative, undecided, ..., with reasons.

    Parameters
    ----------
    record : of :func:`read`; or a path, which is read without options; or errors (runs, steps, n), truth minus
        estimate. A run whose error is not finite, or whose covariance is not positive definite, has failed in that
        step: it is counted, and the others are judged. Where every run begins with singular covariances, as at a
        start that is known exactly, its steps are left out up to the first of full rank. Steps without a truth are
        masked (``numpy.ma``) and do not count.
    covariances : (runs, steps, n, n), beside errors
    deviations : (runs, steps, n), in place of covariances where only standard deviations are stated: each component is
        judged by itself, at a false-alarm rate that all share (Holm)
    members : (runs, steps, m, n), in place of errors: draws that are exchangeable with the truth if they are right, as
        those of an ensemble or of equally weighted particles; whatever their distribution. Needs ``truth``
    truth : (runs, steps, n), of members; or "repeats": ``record`` holds estimates (runs, steps, n) of the same true
        values in every run, which nobody knows
    ensemble : number of members whose sample covariances these are, and whose mean the errors are about
    bounds : (runs, steps, n), in place of covariances, bounds on the size of each component; or (runs, steps), on the
        length of all, such as a horizontal radius. The question is then whether errors leave them as often as their
        level says
    level : share of the steps in which the error stays inside a bound: 0.95, "95%", "2sigma", "CEP", or by name,
        ``{"bound_x": 0.95}``
    gaussian : bounds, or deviations and covariances at that level, stand for the covariance of a Gaussian, which is
        judged
    ends : "independent" declares that ends of runs and lost runs do not depend on the errors (bounds)
    alert_limit : of bounds that are protection levels, in their unit, or by name: the verdict then has the shares of
        the steps in each region of the Stanford diagram
    axes : (n,) names of the components of errors
    independent : each row is an independent run of one step. Errors may then be (N, n), with covariances (N, n, n) or
        deviations (N, n); of a path its rows are runs
    name : of the estimator, in messages; arrays alone
    optimal_gain : True if the filter has an optimal gain and gates nothing away: its innovations are then judged
    skip : first steps (20) or seconds ("2s") of each run to leave out of the statistics, chosen on other data
    truth_covariances : (runs, steps, n, n), of the truth itself, beside errors
    truth_errors, truth_shared : of arrays, as for :func:`read`
    by : (runs, steps), or (runs,), numbers or words whose groups are judged, too, as :func:`read` has them of a column;
        ``{"n_matches": array}`` names it
    bins : of ``by``, as for :func:`read`
    settings : ``false_alarm``, ``detect``, ``power``, ``tolerance``, ``allow``, ``lost`` of
        :class:`consistency.diagnostics.Settings`

    Raises
    ------
    InputError
        A setting out of its range, or nothing is left; shapes that do not fit, a covariance that is not symmetric, a
        step that is not finite in any run.
    """
    given = {"covariances": covariances, "deviations": deviations, "bounds": bounds}
    stated = {key: value for key, value in given.items() if value is not None}
    if len(stated) > 1:
        raise InputError(f"{', '.join(stated)}: give one of them beside errors")
    if "weights" in settings:
        raise InputError(f"weights: {UNWEIGHTED}")
    options = make_reading(
        level=level, gaussian=gaussian or None, ends=ends, ensemble=ensemble, alert_limit=alert_limit
    )
    if bounds is not None or options.given(("level", "gaussian", "ends", "alert_limit")):
        options = checked_options(options)
    if stated or members is not None or truth is not None:
        of_truth = {} if truth_covariances is None or truth is not None else {"truth_covariances": truth_covariances}
        errors = cast("ArrayLike | None", record)
        record = record_of_statement(errors, stated | of_truth, members, truth, axes, name, independent, options)
        if truth is None:
            options = make_reading(truth_errors=truth_errors, truth_shared=truth_shared or None)
            require_truth_options(options)
            (record,) = declared([record], options)
    elif isinstance(record, (str, Path)):
        record = read(
            record, independent=independent, level=level, gaussian=gaussian, ends=ends, alert_limit=alert_limit
        )
    elif not isinstance(record, Record):
        raise InputError("covariances: needed beside errors, (runs, steps, n, n); or deviations, (runs, steps, n)")
    elif independent:
        raise InputError("independent: is for errors and paths; of a record, give independent=True to consistency.read")
    if by is not None or bins is not None:
        record = with_groups(record, by, bins)
    if record.runs.independent:
        from consistency.referee.readers.pipeline.relative_motions import rows_as_declared

        record = rows_as_declared(record)
    record = record.without_first(skip_asked(skip))
    if optimal_gain:
        record = record.with_optimal_gain()
    return judge_record(record, settings_of(**settings), keep_record=True)


@naming_arguments
def plan(
    dof: int = 3,
    *,
    detect: float = DETECT,
    false_alarm: float = FALSE_ALARM,
    power: float = POWER,
    allow: str | None = None,
    lost: float | None = None,
    groups: int | None = None,
    like: Record | str | Path | None = None,
) -> dict[str, Any]:
    """Compute how many runs a verdict needs, whatever the dependence of steps.

    Parameters
    ----------
    dof : dimension of the error; that of ``like`` where that is given
    detect : ratio of true to stated covariance that must be found
    false_alarm : probability of rejecting a correct filter
    power : probability of finding that ratio
    allow : "conservative" accepts a covariance that is too large
    lost : share of lost runs that must be excluded
    groups : number of groups, in one of which that ratio must be found
    like : a record or file of similar runs, which shows how steps depend on each other

    Returns
    -------
    dict
        ``runs``, ``one_step``, ``looks``, and with ``like`` the runs that such a filter takes, as ``plan --json``.

    Raises
    ------
    InputError
        A number out of its range, or ``like`` has no truth or too few runs.
    """
    pilots, pilot_dof = None, dof
    if like is not None:
        pilots, pilot_dof = pilots_of_records([like if isinstance(like, Record) else read(like)])
        dof = pilot_dof
    return plan_runs(dof, detect, false_alarm, power, allow, pilots, lost, pilot_dof, groups)


@naming_arguments
def compare(
    new: Record | str | Path,
    old: Record | str | Path,
    *,
    same_trials: bool = False,
    false_alarm: float = FALSE_ALARM,
    skip: str | float | None = None,
    **options: Any,
) -> Compared:
    """Compare an estimator with another, or with an earlier version, run by run where the trials are the same.

    Parameters
    ----------
    new, old : records, or files, which are read with ``options``; ``old`` may be a file of ``consistency baseline``
    same_trials : records with runs of the same numbers are of the same trials; of files the truth tells
    false_alarm : probability of calling ``new`` worse where it is not
    skip : first steps (20) or seconds ("2s") of each run to leave out
    options : of :func:`consistency.read`

    Returns
    -------
    Compared
        ``print`` shows the sentence; ``worse``, and ``comparison`` with all numbers.

    Raises
    ------
    InputError
        There is no NEES, or the errors have different components.
    """
    if not 0.0 < false_alarm < 1.0:
        raise InputError(f"--false-alarm must lie between 0 and 1, got {false_alarm}")
    truth = None if options.get("truth") is None else Path(options["truth"])
    sides = []
    for side, name in ((new, "new"), (old, "old")):
        if isinstance(side, Record):
            summary = baseline([side], name, skip, None)
        elif is_baseline(Path(side)):
            sides.append(read_baseline(Path(side), skip))
            continue
        else:
            summary = baseline([read(side, **options)], str(side), skip, truth)
        sides.append(replace(summary, origin=GIVEN) if same_trials else summary)
    (found,) = compare_with(sides[0], sides[1], (), false_alarm)
    return found


@naming_arguments
def verdict_table(verdicts: Mapping[str, Verdict] | Iterable[Verdict]) -> pd.DataFrame:
    """List verdicts in a DataFrame, a row each, from which pandas writes LaTeX; needs pandas.

    Parameters
    ----------
    verdicts : by the name of a row; without names those of the estimators

    Returns
    -------
    pandas.DataFrame
        ``verdict``, ``runs``, ``steps``, ``anees`` and its expected value, ``ratio`` of true to stated covariance with
        the ends of its interval, ``worst_axis``, ``failed`` runs and ``faults``; NaN without a truth

    Raises
    ------
    MissingPackageError
        pandas is not installed.
    """
    with explained_import("verdict_table"):
        import pandas as pd

    named = verdicts if isinstance(verdicts, Mapping) else [(verdict.filter, verdict) for verdict in verdicts]
    rows = {}
    for name, v in dict(named).items():
        ratio = (float("nan"),) * 3 if v.scale is None else tuple(v.scale.inflation)
        rows[name] = {
            "verdict": v.status, "runs": v.runs, "steps": v.steps,
            "anees": float("nan") if v.scale is None else v.scale.mean_anees, "expected": v.scale.dof if v.scale else 0,
            "ratio": ratio[0], "ratio_low": ratio[1], "ratio_high": ratio[2],
            "worst_axis": v.worst_axis[0] if v.worst_axis else "", "failed": len({f.run for f in v.failures}),
            "faults": ", ".join(v.faults),
        }  # fmt: skip
    table: pd.DataFrame = pd.DataFrame.from_dict(rows, orient="index")
    return table


# --- how they show themselves -----------------------------------------------------------------------------------------


def record_text(record: Record) -> str:
    runs, unit = plural(len(record.run_numbers), record.runs.unit), "step" if record.origin.window is None else "window"
    size = f"{runs} x {plural(len(record.runs.t), unit)}"
    return (
        f"<Record {record.name}: {size}, error {record.errors.convention or '-'} of {', '.join(record.errors.names)}>"
    )


def record_html(record: Record) -> str:
    rows = (
        ("runs", str(len(record.run_numbers))), ("steps", str(len(record.runs.t))),
        ("error", record.errors.convention or "-"),
        ("components", ", ".join(record.errors.names)), ("failed runs", str(len(record.failures))),
    )  # fmt: skip
    shown = as_html.fragment(Facts(rows), Bullets(record.origin.notes))
    return f"<div><strong>{escape(record.name)}</strong>{shown}</div>"


def verdict_text(verdict: Verdict) -> str:
    return fragment(*summary_blocks(verdict))


def verdict_html(verdict: Verdict) -> str:
    """The sentence, the table, and below it the picture where the record is kept and one can be drawn."""
    from consistency.referee.pages.record_figures import overview

    blocks = list(summary_blocks(verdict))
    if verdict.record is not None:
        with suppress(InputError):  # neither errors nor NEES
            blocks.append(Figure("Errors, NEES, coverage", "", (overview(verdict.record, verdict),)))
    return as_html.fragment(*blocks)


def plot(record: Record, verdict: Verdict | None, path: str | Path | None, figure: str | None = None) -> Any:
    """See :meth:`Record.plot` and :meth:`Verdict.plot`."""
    from consistency.referee.pages.record_figures import overview, record_figures
    from consistency.referee.pages.write_pages import plotted

    if record.errors.error is not None and not record.errors.axes:
        axes = numbered_axes(record.errors.error.shape[-1])
        record = replace(record, errors=replace(record.errors, axes=axes))
    if figure is None or verdict is None:
        return plotted(overview(record, verdict), path)
    of_report = {each.title: each.drawings for each in record_figures(record, verdict)}
    if figure not in of_report:
        raise InputError(f"figure={figure!r}: is not in the report; there are: {', '.join(of_report)}")
    return plotted(of_report[figure][0], path)


def write_verdict(verdict: Verdict, path: str | Path, overwrite: bool) -> list[Path]:
    """See :meth:`Verdict.write`."""
    from consistency.referee.pages.write_pages import (
        is_one_file,
        require_report,
        write_file_reports,
        write_text_file,
    )
    from consistency.referee.show.as_json import render

    path = Path(path)
    replaces = require_report(path, overwrite)
    shown = document({verdict.filter: verdict}, path.name)
    if is_one_file(path):
        return [write_text_file(shown, path)]
    if verdict.record is None:
        raise InputError(
            f"{verdict.filter}: the record was not kept with the verdict; write FILE.xml or FILE.md, or "
            "judge the arrays of the gate by consistency.judge, whose verdict writes a page"
        )
    judged = {verdict.filter: verdict}
    return write_file_reports([verdict.record], judged, path, verdict.filter, render(document(judged)), replaces)
