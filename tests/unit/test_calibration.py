"""The committed calibration table: complete, within its promises, and the one in the documentation."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "experiments"))
import calibration

ROOT = Path(__file__).parents[2]
TABLE = json.loads((ROOT / "reports/reference/calibration.json").read_text(encoding="utf-8"))


def test_every_case_was_measured_with_at_least_2000_gates() -> None:
    keys = [(row["world"], row["ratio"], row["false_alarm"], row["runs"], row["looks"]) for row in TABLE["rows"]]
    assert keys == [(c.world, c.ratio, c.false_alarm, c.looks[-1], len(c.looks)) for c in calibration.cases()]
    assert all(row["gates"] >= (2000 if row["ratio"] == 1.0 else 1000) for row in TABLE["rows"])


@pytest.mark.parametrize("row", TABLE["rows"], ids=lambda row: f"{row['world']}-{row['ratio']}-{row['looks']}")
def test_what_was_measured_keeps_the_promise(row: dict[str, float]) -> None:
    assert calibration.promises_kept(row, 0.99)


def test_the_documentation_shows_it() -> None:
    assert calibration.markdown(TABLE) in (ROOT / "docs/referee.md").read_text(encoding="utf-8")


def test_a_rate_outside_its_bounds_is_refused() -> None:
    row = TABLE["rows"][0]
    assert row["ratio"] == 1.0
    for found in (0, round(0.004 * row["gates"]), round(0.07 * row["gates"])):
        assert not calibration.promises_kept(row | {"found": found}, 0.99)
    power = next(r for r in TABLE["rows"] if r["ratio"] != 1.0)
    assert not calibration.promises_kept(power | {"found": round(0.9 * power["gates"])}, 0.99)
