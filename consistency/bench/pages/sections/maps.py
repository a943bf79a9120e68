"""NEES of the landmarks that filters have in their maps after the last step."""

from __future__ import annotations

from consistency.bench.pages.blocks import Block, Cell, Column, Heading, Name, Text, table
from consistency.bench.pages.model import Study, Track
from consistency.bench.pages.section import STUDY, Section
from consistency.bench.pages.wording import brief
from consistency.referee.diagnostics import Interval, Verdict

COLUMNS = (
    Column("Filter", width="1.3fr"),
    Column("Verdict on the map", "Verdict on\nthe map", width="1.2fr"),
    Column("Mean NEES / 3 of landmarks", "Mean NEES / 3\nof landmarks", number=True),
    Column("Pose and map together, NEES / dof", "Pose and map\ntogether", number=True),
    Column("Map given the pose, NEES / dof", "Map given\nthe pose", number=True),
    Column("Runs", number=True),
    Column("Landmarks", number=True),
    Column("Landmarks left out", "Landmarks\nleft out", number=True),
)
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
    """The study; None where no landmark has a NEES."""
    return study if any(_has_map(track) for track in study.tracks) else None


def _has_map(track: Track) -> bool:
    return track.verdict.map is not None and track.verdict.map.landmarks > 0


def show(study: Study) -> tuple[Block, ...]:
    """One row for each filter that has a map, and a sentence for each verdict on one."""
    tracks = [track for track in study.tracks if track.verdict.map is not None]
    rows = [_cells(track) for track in tracks]
    sentences = [f"Map of {t.name}: {v.reasons[0]}." for t in tracks if (v := _verdict(t)) is not None]
    return (
        Heading("Map", 4, "Map"),
        table(COLUMNS, rows, f"Maps of {study.name}", caption=CAPTION, apart=True, whole=True),
        *(Text(sentence) for sentence in sentences),
    )


def _verdict(track: Track) -> Verdict | None:
    return None if track.verdict.map is None else track.verdict.map.verdict


def _cells(track: Track) -> tuple[Cell, ...]:
    name, *others = row(track)
    return Name(name, track.look), *others


def row(track: Track) -> tuple[str, ...]:
    """Cells of one filter with a map, as COLUMNS."""
    score = track.verdict.map
    assert score is not None
    verdict, joint = score.verdict, None if score.verdict is None else score.verdict.joint
    together = ("–", "–") if joint is None or not joint.runs else (_with_ends(joint.both), _with_ends(joint.map))
    status = "not judged" if verdict is None else verdict.status
    own = _with_ends(score.ratio) if score.landmarks else "–"
    return track.name, status, own, *together, str(score.runs), str(score.landmarks), str(score.left_out)


def _with_ends(interval: Interval) -> str:
    value, low, high = interval
    return f"{brief(value)} [{brief(low)}, {brief(high)}]"


SECTION = Section(STUDY, read, show)
