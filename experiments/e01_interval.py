"""Is [2.36, 3.72] the 95 % interval of the average NEES of 50 runs?"""

from __future__ import annotations

import consistency as cs
from consistency.bench.runs.reproduce_findings import script

FINDINGS = ("interval-eq17",)

PUBLISHED = (2.36, 3.72)  # Herath 2007 sec. 4.5


def main(study: cs.Study) -> list[cs.Finding]:
    """The interval is a property of chi-square with 150 degrees of freedom; no run is needed."""
    low, high = cs.anees_interval(dof=3, runs=50, confidence=0.95)
    holds = (round(low, 2), round(high, 2)) == PUBLISHED
    return [
        study.finding(
            holds,
            scenario="none",
            verdict_if_not="refuted",
            id="interval-eq17",
            source="Herath 2007, eq. 17 and sec. 4.5",
            claim="[2.36, 3.72] is the 95 % concentration region of the average NEES, N = 50, dimension 3",
            statistic="two-sided 95 % interval of chi-square(150) / 50",
            published="[2.36, 3.72]",
            measured=f"[{low:.4f}, {high:.4f}]",
            accept="both ends equal to the two printed decimals",
        )
    ]


if __name__ == "__main__":
    script(main)
