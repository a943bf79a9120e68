"""The sections of a report in their order."""

from __future__ import annotations

from typing import Any

from consistency.reporting.section import Section
from consistency.reporting.sections import (
    anees,
    axes,
    biases,
    filters,
    findings,
    first_order,
    further,
    image_tracks,
    images,
    innovations,
    maps,
    nees,
    no_truth,
    overview,
    own_errors,
    pose_errors,
    provenance,
    questions,
    referee,
    rejections,
    scenes,
    sensor_issues,
    shares,
    stereo_noise,
    verdicts,
    world,
)

SECTIONS: tuple[Section[Any, Any], ...] = (
    overview.SECTION,
    findings.SECTION,
    filters.SECTION,
    verdicts.SECTION,
    anees.SECTION,
    no_truth.SECTION,
    world.SECTION,
    pose_errors.SECTION,
    innovations.SECTION,
    questions.SECTION,
    axes.SECTION,
    nees.SECTION,
    further.SECTION,
    own_errors.SECTION,
    maps.SECTION,
    rejections.SECTION,
    stereo_noise.SECTION,
    shares.SECTION,
    scenes.SECTION,
    first_order.SECTION,
    biases.SECTION,
    sensor_issues.SECTION,
    images.SECTION,
    image_tracks.SECTION,
    referee.SECTION,
    provenance.SECTION,
)
