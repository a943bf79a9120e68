"""NEES of the landmarks that filters have in their maps after the last step."""

from __future__ import annotations

from consistency.bench.pages.report_input import Study, Track
from consistency.referee.diagnostics.verdict.parts import MapScore
from consistency.referee.document.blocks import Block, Heading, Name, Text, table
from consistency.referee.document.map import COLUMNS, map_cells
from consistency.referee.document.verdict import FILTER
from consistency.referee.pages.section import STUDY, Section

CAPTION = (
    "Landmarks in the map after the last step of runs that did not fail. NEES over degrees of freedom: 1 is right, "
    "above is overconfident; 95 % intervals from the spread between runs. Landmarks of one run share the error of its "
    "pose, so each run counts once. Together: by the joint covariance of pose and landmarks, whose NEES is chi-square "
    "with 3 degrees of freedom for the pose and 3 for each landmark; a dash where it was not kept. The verdict on the "
    "map asks what that on the pose asks, with landmarks in the place of steps, and of pose and map together; no "
    "verdict on a pose depends on it. Left out: what is no landmark of the world, or has no covariance that is "
    "positive definite."
)


def read(study: Study) -> Study | None:
    return study if any(of.landmarks > 0 for _, of in _maps(study)) else None


def _maps(study: Study) -> list[tuple[Track, MapScore]]:
    return [(track, track.verdict.map) for track in study.tracks if track.verdict.map is not None]


def show(study: Study) -> tuple[Block, ...]:
    """One row for each filter that has a map, and a sentence for each verdict on one."""
    maps = _maps(study)
    rows = [(Name(track.name, track.look), *map_cells(of)) for track, of in maps]
    sentences = [f"Map of {track.name}: {of.verdict.reasons[0]}." for track, of in maps if of.verdict is not None]
    return (
        Heading("Map", 4, "Map"),
        table((FILTER, *COLUMNS), rows, f"Maps of {study.name}", caption=CAPTION, apart=True, whole=True),
        *map(Text, sentences),
    )


SECTION = Section(STUDY, read, show)
