"""The sections of a report in their order."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from consistency.referee.pages.section import Section

# modules with a SECTION, by name below the package: some are of the stereo laboratory, which the bench does not know
NAMES = (
    *(
        f"bench.pages.sections.{name}"
        for name in (
            "overview", "findings", "filters", "verdicts", "anees", "no_truth", "world", "pose_errors", "innovations",
        )
    ),
    "referee.pages.questions",
    "referee.pages.axes",
    *(f"bench.pages.sections.{name}" for name in ("nees", "further", "own_errors", "maps", "rejections")),
    "stereo.pages.stereo_noise",
    "bench.pages.sections.shares",
    "stereo.pages.scenes",
    "bench.pages.sections.first_order",
    *(f"stereo.pages.{name}" for name in ("sensor_issues", "images")),
    "bench.pages.sections.referee",
    "bench.pages.sections.provenance",
)  # fmt: skip
SECTIONS: tuple[Section[Any, Any], ...] = tuple(import_module(f"consistency.{name}").SECTION for name in NAMES)
