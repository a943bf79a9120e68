"""The sections of a report in their order."""

from __future__ import annotations

from typing import Any

from consistency.bench.pages.section import Section
from consistency.bench.pages.sections import (
    anees,
    axes,
    filters,
    findings,
    first_order,
    further,
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
    shares,
    verdicts,
    world,
)
from consistency.stereo.pages import biases, image_tracks, images, scenes, sensor_issues, stereo_noise

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
