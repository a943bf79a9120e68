"""Fig. 13 of Herath et al. (2007) in several studies of N runs: what is typical, and what single runs do to it."""

from __future__ import annotations

import pandas as pd

from consistency.bench.pages.sections.published_findings import Exhibit, Source, exhibit_blocks, listing
from consistency.bench.pages.sections.report_input import Report
from consistency.referee.show.blocks import Block, Table

CHAPTER = ("fig13", "Fig. 13: the average NEES in several studies", "Fig. 13")
ON_PAPER = True  # of a report of several studies


def studies(data: pd.DataFrame) -> Table:
    heads = {
        "filter": ("Filter", ""), "study": ("Study", ""), "anees": ("Mean ANEES", ".1f"),
        "median_run": ("Median run", ".1f"), "worst_run": ("Worst run", ".0f"),
    }  # fmt: skip
    caption = (
        "Mean NEES of the pose, 3 if the covariance is right. The mean over the runs of a study is that of eq. 16; "
        "where the worst run is far from the median run, that run alone decides it"
    )
    return listing(data, heads, "Average NEES by study", caption)


EXHIBITS = (
    Exhibit(("fig13a", "fig13b", "fig13b-xyz"), "fig13a, fig13b, fig13b-xyz: studies of N runs side by side",
            (Source("fig13", ("anees", "median_run", "worst_run"), ("filter", "study"), studies),)),
)  # fmt: skip


def blocks(report: Report) -> tuple[Block, ...]:
    """The studies, where the folder holds them."""
    return exhibit_blocks(report, EXHIBITS)
