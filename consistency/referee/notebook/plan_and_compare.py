"""What commands do besides judging, for Python: runs to plan, estimators to compare, verdicts to list."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from consistency.referee.defaults import DETECT, FALSE_ALARM, POWER
from consistency.referee.diagnostics.record import Record
from consistency.referee.diagnostics.verdict import Verdict
from consistency.referee.errors import InputError, naming_arguments
from consistency.referee.extras import explained_import
from consistency.referee.notebook.read_and_judge import read
from consistency.referee.verdicts import compare_sources, judge_sources

if TYPE_CHECKING:
    import pandas as pd

GIVEN = ("same trials", None)  # origin of records whose trials are declared to be the same


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
        pilots, pilot_dof = judge_sources.pilots_of_records([like if isinstance(like, Record) else read(like)])
        dof = pilot_dof
    return judge_sources.plan_runs(dof, detect, false_alarm, power, allow, pilots, lost, pilot_dof, groups)


@naming_arguments
def compare(
    new: Record | str | Path,
    old: Record | str | Path,
    *,
    same_trials: bool = False,
    false_alarm: float = FALSE_ALARM,
    skip: str | float | None = None,
    **options: Any,
) -> compare_sources.Compared:
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
        if not isinstance(side, Record) and compare_sources.is_baseline(Path(side)):
            sides.append(compare_sources.read_baseline(Path(side), skip))
            continue
        record = side if isinstance(side, Record) else read(side, **options)
        origin = None if isinstance(side, Record) else truth
        summary = compare_sources.baseline([record], name if isinstance(side, Record) else str(side), skip, origin)
        sides.append(replace(summary, origin=GIVEN) if same_trials else summary)
    (found,) = compare_sources.compare_with(sides[0], sides[1], (), false_alarm)
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
