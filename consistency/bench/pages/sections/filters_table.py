"""Every filter of a world in one table: verdicts on pose and map, error, cost and failures."""

from __future__ import annotations

from typing import Any

from consistency.bench.pages.sections.published_findings import extra_table
from consistency.bench.pages.sections.report_input import Report
from consistency.referee.show.blocks import Block, Cell, Column, Small, Stack, Status, brief, table

FILE = "filters.parquet"
NUMBERS = ["anees", "rmse", "map_nees", "joint_nees", "cost", "failures", "runs", "false_alarm"]
NAMES = ["filter", "realisable", "error", "status", "diagnosis", "map_status", "map_diagnosis", "scenario"]
CLAUSES = 2  # of a diagnosis, that a row has room for
MISSING = ["anees", "rmse", "map_nees", "joint_nees"]
COLUMNS = (
    Column("Filter, and what is wrong", width="2.6fr"),
    Column("Pose", width="1fr"),
    Column("ANEES (3 expected)", "ANEES", number=True),
    Column("RMSE position (m)", "RMSE\n(m)", number=True),
    Column("Map", width="1fr"),
    Column("Map NEES / 3", "Map\nNEES / 3", number=True),
    Column("Pose and map together", "Together", number=True),
    Column("Cost of a step", "Cost", number=True),
    Column("Failed runs", "Failed", number=True),
)


def filters_table(report: Report) -> tuple[Block, ...]:
    """The table of the folder; nothing where the file does not exist."""
    filters = extra_table(report.folder / FILE, NUMBERS, NAMES, MISSING)
    if filters is None:
        return ()
    first = filters.iloc[0]
    rows = [_row(values) for values in filters.to_dict("records")]
    caption = (
        f"{first['scenario']}, {first['runs']:.0f} runs of each filter on the same trials; false-alarm rate of each "
        f"verdict {100 * first['false_alarm']:.2g} %. Map NEES / 3 is the mean over landmarks, together is the NEES of "
        "pose and map by their joint covariance over its degrees of freedom: 1 is right, above is overconfident. Cost: "
        "time of a step over that of ekf-uvd, median of interleaved repeats in one process. A bound is told the truth, "
        "so that no robot can run it."
    )
    return (table(COLUMNS, rows, "Filters", caption=caption, whole=True),)


def _row(values: dict[Any, Any]) -> tuple[Cell, ...]:
    below = [Small(f"Pose: {_brief(values['diagnosis'])}."), Small(f"Map: {_brief(values['map_diagnosis'])}.")]
    bound = "" if values["realisable"] == "yes" else " (a bound)"
    numbers = (brief(values[column]) for column in ("anees", "rmse"))
    map_numbers = (brief(values[column]) for column in ("map_nees", "joint_nees", "cost"))
    status = Status(values["map_status"]) if values["map_status"] != "-" else "–"
    return (
        Stack(f"{values['filter']}{bound}", tuple(below), bold=True), Status(values["status"]), *numbers, status,
        *map_numbers, f"{values['failures']:.0f}",
    )  # fmt: skip


def _brief(diagnosis: str) -> str:
    return "; ".join(diagnosis.split("; ")[:CLAUSES])
