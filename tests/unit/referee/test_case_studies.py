"""The case studies: verdicts on the stored draws, and the figures that the documents state of them.

A verdict here is not statistical: the draws are stored, so that it is the same each time.
"""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import consistency as cs
from consistency import testing
from consistency.referee.cli import main

DOCS = Path(__file__).parents[3] / "docs"
FOLDER = DOCS / "case-studies"
VERSIONS = ("4.2.1", "4.3.0")
RATIO = re.compile(r"x\d+\.\d+ \[\d+\.\d+, \d+\.\d+\]")
EXPECTED = 3.20  # tr(P^-1 P') / 9, with P of preintMeasCov() and P' of residualCovariance() of 4.3.0 without noise
ROWS = {  # of the table in docs/case-studies.md: archive, and status by version
    "the factor at the truth": ("", "overconfident", "consistent"),
    "a tenth of the turn, 0.2 rad": ("-tenth", "heavy-tailed", "consistent"),
    "the preintegrated vector with `preintMeasCov()`": ("-vector", "consistent", "consistent"),
    "the residual with `preintMeasCov()`": ("-raw", "overconfident", "overconfident"),
}


@cache
def verdict(version: str, kind: str = "") -> cs.Verdict:
    return cs.judge(cs.read(FOLDER / f"gtsam-{version}{kind}.npz"))


def ratio(version: str, kind: str = "") -> str:
    found = verdict(version, kind)
    low, high = found.inflation_interval
    return f"x{found.inflation:.2f} [{low:.2f}, {high:.2f}]"


@pytest.mark.parametrize("row", ROWS)
def test_the_table_has_what_the_referee_says(row: str) -> None:
    kind, *statuses = ROWS[row]
    table = (DOCS / "case-studies.md").read_text("utf-8")
    (line,) = re.findall(rf"^\| {re.escape(row)} \| (.*) \| (.*) \|$", table, re.M)
    for version, status, cell in zip(VERSIONS, statuses, line, strict=True):
        assert cell == f"{status}, {ratio(version, kind)}"
        assert cell.startswith(verdict(version, kind).status)


def test_the_factor_of_the_older_version_alone_is_overconfident() -> None:
    """Both are judged by the same noise; the interval has the ratio that the two covariances of 4.3.0 give."""
    old, new = (verdict(version) for version in VERSIONS)
    assert (old.status, new.status) == ("overconfident", "consistent")
    assert old.inflation_interval[0] < EXPECTED < old.inflation_interval[1]
    assert new.inflation_interval[0] < 1.0 < new.inflation_interval[1]
    assert verdict("4.2.1", "-tenth").inflation < 1.2


@pytest.mark.parametrize(("page", "kinds"), [
    ("README.md", {("4.2.1", ""), ("4.2.1", "-tenth"), ("4.3.0", "-raw")}),
    ("docs/index.md", {("4.2.1", "")}),
])  # fmt: skip
def test_figures_of_the_opening_are_those_of_the_archives(page: str, kinds: set[tuple[str, str]]) -> None:
    text = " ".join((DOCS.parent / page).read_text("utf-8").split())
    opening = text.partition("## Quick start")[0]
    assert set(RATIO.findall(opening)) == {ratio(*kind) for kind in kinds}


def test_the_printed_verdict_of_the_readme_is_what_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    (shown,) = re.findall(r"^(gtsam-4\.2\.1 is .*) \.\.\.$", (DOCS.parent / "README.md").read_text("utf-8"), re.M)
    with pytest.raises(SystemExit) as end:
        main(["analyse", str(FOLDER / "gtsam-4.2.1.npz"), "--fail-on", "inconsistent"])
    assert end.value.code == 1
    assert shown in " ".join(capsys.readouterr().out.split())


def test_a_gate_says_the_same() -> None:
    """Through arrays, as in a test of one's own."""
    for version in VERSIONS:
        with np.load(FOLDER / f"gtsam-{version}.npz") as archive:
            errors, covariances = (archive[key].astype(float) for key in ("errors", "covariances"))
        if version == "4.3.0":
            testing.assert_consistent(errors, covariances)
            continue
        with pytest.raises(testing.ConsistencyError) as failed:
            testing.assert_consistent(errors, covariances)
        assert failed.value.verdict.status == "overconfident"


def test_archives_are_small() -> None:
    sizes = {path.name: path.stat().st_size for path in FOLDER.glob("*.npz")}
    assert len(sizes) == len(VERSIONS) * len(ROWS)
    assert max(sizes.values()) < 100_000
