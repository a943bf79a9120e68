"""Tables of the experiments on the stereo front-end as records; they hold every number that is shown."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from consistency.errors import InputError
from consistency.reporting.model import Cells, FirstOrder, FrontEnd, Scene, Scenes, Shares
from consistency.reporting.tables import extra_table

SHARES = ["depth", "share", "expected", "low", "high", "false_alarm", "noise", "samples", "repetitions"]
SCENES = [
    "far", "noise", "repetitions", "ratio", "ratio_least", "ratio_most", "region_low", "region_high", "confidence",
    "near", "points", "samples", "dof",
]  # fmt: skip
CELLS = ["ratio", "nees_ratio", "runs", "failed", "points", "false_alarm", "holds"]
NAMES = ["estimator", "status"]
ACCEPTED = "consistent"


def front_end(folder: Path) -> FrontEnd:
    """Tables that ``consistency reproduce`` has left in ``folder``.

    Raises
    ------
    InputError
        A file is damaged, lacks a column, or holds what cannot be drawn.
    """
    return FrontEnd(
        _shares(folder / "frontend_fig22.parquet"), _scenes(folder / "frontend_fig23.parquet"),
        _first_order(folder / "first_order.parquet"),
    )  # fmt: skip


def _shares(path: Path) -> Shares | None:
    table = extra_table(path, SHARES)
    if table is None:
        return None
    table = table.sort_values("depth")
    same = table.iloc[0]
    return Shares(
        depth=table["depth"].to_numpy(),
        share=table["share"].to_numpy(),
        expected=float(same["expected"]),
        accepted=(float(same["low"]), float(same["high"])),
        false_alarm=float(same["false_alarm"]),
        noise=float(same["noise"]),
        samples=int(same["samples"]),
        repetitions=int(same["repetitions"]),
    )


def _scenes(path: Path) -> Scenes | None:
    table = extra_table(path, SCENES)
    if table is None:
        return None
    same = table.iloc[0]
    return Scenes(
        scenes=tuple(
            Scene(
                row["far"], row["noise"], int(row["repetitions"]), row["ratio"], (row["ratio_least"], row["ratio_most"])
            )
            for row in table.to_dict("records")
        ),
        region=(float(same["region_low"]), float(same["region_high"])),
        confidence=float(same["confidence"]),
        near=float(same["near"]),
        points=int(same["points"]),
        samples=int(same["samples"]),
        dof=int(same["dof"]),
    )


def _first_order(path: Path) -> FirstOrder | None:
    table = extra_table(path, CELLS, NAMES, missing=["nees_ratio"])
    if table is None:
        return None
    for column in ("ratio", "nees_ratio"):
        if (bad := (table[column] <= 0).to_numpy()).any():
            row = int(np.flatnonzero(bad)[0])
            raise InputError(f"{path}: column '{column}', row {row}: not above zero ({table[column].iloc[row]:g})")
    same = table.iloc[0]
    estimators = (
        Cells(
            str(name), part["ratio"].to_numpy(), part["nees_ratio"].to_numpy(), (part["status"] == ACCEPTED).to_numpy()
        )
        for name, part in table.groupby("estimator", sort=False)
    )
    return FirstOrder(
        estimators=tuple(estimators),
        runs=int(same["runs"]),
        failed=int(table["failed"].sum()),
        points=int(same["points"]),
        false_alarm=float(same["false_alarm"]),
        holds=float(same["holds"]),
    )
