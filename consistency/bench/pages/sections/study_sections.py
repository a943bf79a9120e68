"""The sections of a study in their order; those that are a table with a row for each filter stand here.

A section is a function from a study to blocks: none where it does not apply. A new one is written here, or in a file
of its own if it is long, and named in :data:`SECTIONS`.
"""

from __future__ import annotations

from collections.abc import Callable

from consistency.bench.pages.sections.nees import anees_curves, nees_distribution
from consistency.bench.pages.sections.nis import innovations
from consistency.bench.pages.sections.one_run import pose_errors, world_map
from consistency.bench.pages.sections.report_input import Study
from consistency.referee.geometry import ADDITIVE, PLANAR
from consistency.referee.pages.ratio_figures import by_axis
from consistency.referee.pages.verdicts import diagnosis
from consistency.referee.show.blocks import Block, Cell, Column, Heading, Name, Text, table
from consistency.referee.verdicts.tables import BRIEF, FILTER, cells, columns, map_cells, rejection_cells
from consistency.referee.verdicts.tables import FURTHER as FURTHER_COLUMNS
from consistency.referee.verdicts.tables import MAP_COLUMNS as MAP_COLUMNS
from consistency.referee.verdicts.tables import REJECTION_COLUMNS as GUARD_COLUMNS

OF_FURTHER = (
    "Noncredibility index and inclination (Li & Zhao 2006): 0 dB is credible, 10 dB a covariance wrong by a factor "
    "of 10; inclination above 0 is overconfident. The ratio that would be found: with power 0.95 by these runs."
)
OF_MAPS = (
    "Landmarks in the map after the last step of runs that did not fail. NEES over degrees of freedom: 1 is right, "
    "above is overconfident; 95 % intervals from the spread between runs. Landmarks of one run share the error of its "
    "pose, so each run counts once. Together: by the joint covariance of pose and landmarks, whose NEES is chi-square "
    "with 3 degrees of freedom for the pose and 3 for each landmark; a dash where it was not kept. The verdict on the "
    "map asks what that on the pose asks, with landmarks in the place of steps, and of pose and map together; no "
    "verdict on a pose depends on it. Left out: what is not a landmark of the world, or has no covariance that is "
    "positive definite."
)
OF_REJECTIONS = (
    "Observations offered to filters with a guard, over all runs. Precision: the share of the rejected ones that are "
    "spurious; recall: the share of the spurious ones that are rejected, the first sighting of a landmark included, "
    "which no guard can judge. 95 % intervals by Clopper and Pearson at the effective number of observations, with "
    "runs as clusters. A dash where nothing is spurious, or where a log does not say what is."
)
LONG = 12  # rows from which the table of further figures may be broken between pages


def without_truth(study: Study) -> tuple[Text, ...]:
    """Why there are no pose errors where the truth is not known, and what is left to judge."""
    left = "all that can be judged" if study.judged else "reported and not judged"
    text = (
        f"The truth of {study.name} is not known, so there are no pose errors and no NEES to show; the innovations "
        f"below are {left}."
    )
    return () if study.has_truth else (Text(text, style="note"),)


def further(study: Study) -> tuple[Block, ...]:
    """Further figures of merit of each filter."""
    if not study.has_truth:
        return ()
    heads, whole = (FILTER, *columns(FURTHER_COLUMNS)), len(study.tracks) <= LONG
    rows = [(Name(track.name, track.look), *cells(FURTHER_COLUMNS, track.verdict)) for track in study.tracks]
    label = f"Further figures of {study.name}"
    return Heading("Further figures", 4), table(heads, rows, label, caption=OF_FURTHER, whole=whole)


def own_error_table(study: Study) -> tuple[Block, ...]:
    """Filters with an error of their own: what is judged in it, and beside it in the additive error of the world."""
    rows: list[tuple[Cell, ...]] = []
    for track in study.tracks:
        own, world = track.verdict, track.verdict.world
        if world is not None:
            rows.append((Name(track.name, track.look), f"{own.convention}, its own", *cells(BRIEF, own)))
            rows.append(("", f"{ADDITIVE}, additive", *cells(BRIEF, world)))
    heads, title = (FILTER, Column("Error", width="2.4fr"), *columns(BRIEF)), "Errors of their own"
    label = f"Own errors of {study.name}"
    shown = table(heads, rows, label, caption=of_own_errors(study), whole=True)
    return (Heading(title, 4), shown) if rows else ()


def of_own_errors(study: Study) -> str:
    """Which errors these are, and which of them the rest of the report is about."""
    own = dict.fromkeys(t.verdict.convention for t in study.tracks if t.verdict.world is not None)
    errors = "; ".join(f"{error}: {PLANAR[error]}" for error in (*filter(None, own), ADDITIVE))
    return (
        f"{errors}. The covariance of such a filter is that of its own error, so its verdict and every NEES, ratio, "
        "bias and coverage in this report are in that one. Pose errors with their sigma, and RMSE, are those of the "
        "pose in the world."
    )


def maps(study: Study) -> tuple[Block, ...]:
    """NEES of the landmarks in the maps after the last step, and a sentence for each verdict on a map."""
    scores = [(track, track.verdict.map) for track in study.tracks if track.verdict.map is not None]
    if not any(of.landmarks > 0 for _, of in scores):
        return ()
    rows = [(Name(track.name, track.look), *map_cells(of)) for track, of in scores]
    sentences = [f"Map of {track.name}: {of.verdict.reasons[0]}." for track, of in scores if of.verdict is not None]
    heads, label = (FILTER, *MAP_COLUMNS), f"Maps of {study.name}"
    shown = table(heads, rows, label, caption=OF_MAPS, whole=True)
    return Heading("Map", 4), shown, *map(Text, sentences)


def rejections(study: Study) -> tuple[Block, ...]:
    """Which observations guards kept from their filters."""
    scores = [(track, track.verdict.rejection) for track in study.tracks]
    rows = [(Name(track.name, track.look), *rejection_cells(r)) for track, r in scores if r is not None]
    heads, title = (FILTER, *GUARD_COLUMNS), "Rejected observations"
    shown = table(heads, rows, f"{title} of {study.name}", caption=OF_REJECTIONS, whole=True)
    return (Heading(title, 4), shown) if rows else ()


SECTIONS: tuple[Callable[[Study], tuple[Block, ...]], ...] = (
    anees_curves, without_truth, world_map, pose_errors, innovations, diagnosis, by_axis, nees_distribution, further,
    own_error_table, maps, rejections,
)  # fmt: skip
