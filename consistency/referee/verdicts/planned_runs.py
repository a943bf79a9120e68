"""How many runs a verdict takes that a command asks for."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from consistency.referee.diagnostics.records.record import Record
from consistency.referee.errors import InputError
from consistency.referee.types import Array
from consistency.referee.verdicts.judge_sources import refused


def plan(
    dof: int,
    detect: float,
    false_alarm: float,
    power: float,
    allow: str | None = None,
    pilots: Mapping[str, tuple[Array, int]] | None = None,
    lost: float | None = None,
    pilot_dof: int = 3,
    groups: int | None = None,
) -> dict[str, Any]:
    """Runs that a verdict takes (``runs``, 30 or more), those of one chi-square test (``one_step``), and first looks.

    Parameters
    ----------
    pilots : of each filter, mean NEES over ``dof`` of a few runs (N,), and their steps; ``like`` then has the runs that
        filters take whose steps depend on each other as theirs do
    lost : share of lost runs that is to be excluded
    pilot_dof : dimension of the errors of the pilots
    groups : number of groups, in one of which the covariance may be wrong; ``runs_in_group`` is then what each takes

    Raises
    ------
    InputError
        A number out of its range, or pilots without truth.
    """
    from consistency.referee.diagnostics.planning.early_stopping import Design
    from consistency.referee.diagnostics.planning.pilot import pilot_plan
    from consistency.referee.diagnostics.statistics.number_of_runs import (
        FEWEST_PLANNED,
        gate_runs,
        group_runs,
        lost_runs,
        required_runs,
    )

    if allow not in (None, "conservative"):
        raise InputError(f"--allow must be 'conservative', got '{allow}'")
    if pilots is not None and dof != pilot_dof:
        raise InputError(f"--dof {dof}: results of the bench have {pilot_dof} dimensions; leave it out")
    try:
        runs = max(FEWEST_PLANNED, gate_runs(dof, detect, false_alarm, power, allow, lost))
        inspections = itertools.takewhile(lambda one: one[0] < runs, Design(dof).inspections())
        looks = [count for count, spent in inspections if spent]
        planned: dict[str, Any] = {
            "dof": dof, "detect": detect, "false_alarm": false_alarm, "power": power, "allow": allow, "runs": runs,
            "one_step": required_runs(dof, detect, false_alarm, power, two_sided=allow is None), "looks": looks,
        }  # fmt: skip
        if lost is not None:
            planned |= {"lost": lost, "lost_runs": lost_runs(lost, power)}
        if groups is not None:
            each = group_runs(dof, detect, groups, false_alarm, power, allow)
            planned |= {"groups": groups, "runs_in_group": each, "group_runs": groups * each}
        if pilots is not None:
            planned["like"] = {}
            for name, (means, steps) in pilots.items():
                planned["like"][name] = vars(pilot_plan(means, dof, steps, detect, false_alarm, power, allow, lost))
    except InputError:
        raise
    except ValueError as error:
        raise refused(error) from None
    return planned


def pilots_of_records(
    records: Sequence[Record], filters: Sequence[str] | None = None
) -> tuple[dict[str, tuple[Array, int]], int]:
    """Pilots of :func:`plan` in records of files, and the dimension of their errors.

    Raises
    ------
    InputError
        No such filter, one without truth, or too few runs that did not fail.
    """
    from consistency.referee.diagnostics.questions.scale import FEW, run_means

    named = {record.name: record for record in records}
    pilots = {}
    for name in filters or named:
        if name not in named:
            raise InputError(f"--filter {name}: is not in these runs; there are: {', '.join(named)}")
        record = named[name]
        if record.nees is None or record.parts:
            raise InputError(f"{name}: a pilot needs truth and a whole covariance")
        means, counts = run_means(record.nees)
        failed = np.isin(record.run_numbers, [failure.run for failure in record.failures])
        means = means[(counts > 0) & ~failed] / record.dof
        if len(means) < FEW:
            raise InputError(f"{name}: a pilot needs at least {FEW} runs that did not fail, got {len(means)}")
        pilots[name] = means, record.nees.shape[1]
    return pilots, next(iter(named.values())).dof
