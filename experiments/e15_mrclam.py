"""Are planar filters consistent on real robots, UTIAS MRCLAM with odometry and range and bearing of landmarks?

    python experiments/e15_mrclam.py --data DIR --out DIR [--jobs J] [--overwrite]

DIR of ``--data`` holds folders MRCLAM_DatasetN (Leung et al. 2011, public research data of UTIAS: not shipped). How a
recording becomes a log: docs/reference/recorded.md.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np
import pandas as pd

import consistency as cs
from consistency.bench.runs.montecarlo import run_log
from consistency.bench.runs.reproduce_findings import command_line, sibling
from consistency.bench.runs.results_to_records import record_of
from consistency.bench.store.recorded_log import Log, write_log
from consistency.referee.system import manifest_of

if TYPE_CHECKING:
    import mrclam_log as conversion
else:
    conversion = sibling(__file__, "mrclam_log")
scripts = sibling(__file__, "data_scripts")

NOT_SHIPPED = "recordings of UTIAS MRCLAM"
FINDINGS = ()  # their names have that of the drive

ORIGIN, LICENCE = "UTIAS MRCLAM (Leung et al. 2011)", "none stated, public research data"
FILTERS = ("ekf-rb", "ukf-rb", "iekf-rb", "fej-ekf-rb", "oc-ekf-rb", "ri-ekf-rb", "ideal-ekf-rb")
ROBOTS = range(1, conversion.ROBOTS + 1)
CLAIM = "a planar filter is consistent on a real robot once the scale of its odometry is calibrated"


class Drive(NamedTuple):
    """The log of a robot, and how it was made."""

    log: Log
    found: conversion.Calibration
    dropped: conversion.Dropped


def drives(folder: Path) -> dict[str, Drive]:
    """All robots of all data sets in ``folder``, by name.

    Raises
    ------
    InputError
        There is no data set, or a file of one cannot be used.
    """
    sets = sorted(folder.glob("MRCLAM_Dataset*"))
    if not sets:
        raise cs.InputError(f"{folder}: holds no folder MRCLAM_DatasetN; get the data from UTIAS")
    made = {}
    for dataset in sets:
        for robot in ROBOTS:
            name = f"mrclam-{dataset.name.removeprefix('MRCLAM_Dataset')}-{robot}"
            trial, belief, found, dropped = conversion.log_of(conversion.read_robot(dataset, robot))
            table = pd.DataFrame(trial.landmarks, columns=["x", "y", "z"])
            table.insert(0, "landmark", np.arange(len(table)))
            made[name] = Drive(Log(name, [trial], belief, table), found, dropped)
    return made


def measure(study: cs.Study, logs: dict[str, Drive]) -> list[cs.Finding]:
    """Every filter on every robot: a finding for each robot, and all numbers in a table."""
    rows, findings = [], []
    for name, drive in logs.items():
        print(f"{name}: {', '.join(FILTERS)}", file=sys.stderr, flush=True)
        results = study.kept[name] = cast(cs.Results, run_log(drive.log, FILTERS, study.jobs))
        verdicts = cs.analyse(results)
        here = [row(name, filter_, verdicts[filter_], record_of(results, filter_).in_world) for filter_ in FILTERS]
        rows += here
        findings.append(finding(study, name, drive, here))
    study.tables["mrclam"] = pd.DataFrame(rows)
    return findings


class Row(NamedTuple):
    log: str
    filter: str
    status: str
    nees: float  # mean over the steps, over 3; infinite where the filter failed
    nis: float  # over its degrees of freedom
    position: float  # RMSE, m
    heading: float  # RMSE, rad


def row(name: str, filter_: str, verdict: cs.Verdict, c: cs.Record) -> Row:
    assert c.errors.error is not None
    assert c.errors.nees is not None
    nees = np.inf if c.failures else float(np.nanmean(c.errors.nees)) / 3
    square = np.square(c.errors.error[0])
    values, dof = np.asarray(c.innovations.nis), np.asarray(c.innovations.nis_dof)
    nis = float(np.nansum(values) / dof[np.isfinite(values)].sum())
    position, heading = np.sqrt(np.nanmean(square[:, :2].sum(axis=1))), np.sqrt(np.nanmean(square[:, 2]))
    return Row(name, filter_, verdict.status, nees, nis, float(position), float(heading))


def finding(study: cs.Study, name: str, drive: Drive, rows: Sequence[Row]) -> cs.Finding:
    found, trial = drive.found, drive.log.trials[0]
    each = "; ".join(
        f"{r.filter} {r.status}, NEES/3 {r.nees:.2f}, NIS/dof {r.nis:.2f}, RMSE {r.position:.2f} m" for r in rows
    )
    text = study.finding(
        all(r.status == "consistent" for r in rows),
        scenario=name,
        id=name,
        source="this project, on UTIAS MRCLAM (Leung et al. 2011)",
        claim=CLAIM,
        statistic="verdict, NEES, NIS and RMSE of one drive",
        published="none",
        measured=f"odometry reads {1.0 / found.scale_v - 1.0:.1%} high, {trial.steps} steps, {drive.dropped.kept} "
        f"measurements, {drive.dropped.gross} wrong barcodes dropped: {each}",
        accept="every filter consistent",
    )
    return replace(text, runs=1)


def command(arguments: Sequence[str] | None = None) -> None:
    """Write OUT as `consistency reproduce` does, and the logs themselves as OUT/logs/NAME."""
    given = scripts.options_of(__doc__, arguments, "folder with MRCLAM_DatasetN", jobs=True)
    study, started = cs.Study(runs=1, seed=0, jobs=given.jobs), time.monotonic()
    logs = drives(given.data)
    manifest = manifest_of(
        kind="log", seed=None, runs=1, wall=time.monotonic() - started, complete=True, failures=0, origin=ORIGIN,
        licence=LICENCE,
    )  # fmt: skip
    findings = measure(study, logs)
    scripts.keep(study, findings, given, started)
    for name, drive in logs.items():
        write_log(given.out / "logs" / name, drive.log.trials, drive.log.belief, drive.log.landmarks, manifest)
    print(f"results in {given.out}, the logs in its folder logs; next: consistency report {given.out}")


if __name__ == "__main__":
    command_line(command)
