"""The sections of a report in their order."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from consistency.referee.pages.section import Section

# sections by module below the package, and by name where it is not SECTION: some are of the stereo laboratory, which
# the bench does not know
NAMES = (
    "bench.pages.sections.overview",
    "bench.pages.exhibits:FINDINGS",
    "bench.pages.sections.filters",
    "bench.pages.sections.overview:VERDICTS",
    "bench.pages.sections.anees",
    "bench.pages.sections.study_tables:NO_TRUTH",
    *(f"bench.pages.sections.{name}" for name in ("world", "pose_errors", "innovations")),
    "referee.pages.questions",
    "referee.pages.axes",
    "bench.pages.sections.nees",
    *(f"bench.pages.sections.study_tables:{name}" for name in ("FURTHER", "OWN_ERRORS", "MAPS", "REJECTIONS")),
    "stereo.pages.stereo_noise",
    "bench.pages.sections.shares",
    "stereo.pages.scenes",
    "bench.pages.sections.first_order",
    *(f"stereo.pages.{name}" for name in ("sensor_issues", "images")),
    "bench.pages.sections.referee",
    "bench.pages.sections.provenance",
)
SECTIONS: tuple[Section[Any, Any], ...] = tuple(
    getattr(import_module(f"consistency.{module}"), name or "SECTION")
    for module, _, name in (entry.partition(":") for entry in NAMES)
)
