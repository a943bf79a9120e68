"""Landmarks over frames: matches linked to tracks, and few of them chosen for filters that are O(n^2) in landmarks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from consistency.referee.errors import InputError
from consistency.referee.types import Indices

PIXELS = ["z0", "z1", "z2"]


def linked(links: Sequence[Indices]) -> list[Indices]:
    """Numbers of the tracks that matches of consecutive frames are part of.

    Parameters
    ----------
    links : for each pair of frames k, k + 1 the rows (M_k, 2) of one feature in both; a row occurs once at most

    Returns
    -------
    for each pair (M_k,), the track of each match; a track continues where the row in frame k + 1 is one of the next
    pair, and tracks are numbered in the order in which they begin
    """
    tracks: list[Indices] = []
    going: dict[int, int] = {}  # row in the frame that two pairs share -> track
    count = 0
    for rows in links:
        now = np.empty(len(rows), np.int64)
        for match, row in enumerate(rows[:, 0].tolist()):
            now[match] = going.get(row, count)
            count += row not in going
        going = dict(zip(rows[:, 1].tolist(), now.tolist(), strict=True))
        tracks.append(now)
    return tracks


@dataclass(frozen=True)
class TrackSelection:
    """Which observations become those of landmarks."""

    slots: int  # landmarks seen at once, at most
    max_age: int  # observations of a landmark, at most
    min_life: int  # observations of a landmark, at least
    bands: int  # columns of the image that the slots are spread over
    width: float  # of the image, px


def thinned(rows: pd.DataFrame, rule: TrackSelection) -> pd.DataFrame:
    """Rows (step, landmark, z0, z1, z2) of at most ``rule.slots`` landmarks at once.

    A free slot goes to the emptiest column of the image, there to the piece with the longest life ahead,
    then the nearer, then the first: nothing is drawn by chance. Step 0 has no observation.

    Parameters
    ----------
    rows : columns piece, step, z0, z1, z2, sorted by piece, then step; z0 from the middle of the image

    Raises
    ------
    InputError
        Nothing is left.
    """
    rows = rows[rows["step"] >= 1].copy()
    column = (rows["z0"] + rule.width / 2) * rule.bands // rule.width  # of the image, from the left
    rows["band"] = np.clip(column, 0, rule.bands - 1).astype(np.int64)
    rows["left"] = rows.groupby("piece").cumcount(ascending=False) + 1  # observations to come, with this one
    row_of = {key: i for i, key in enumerate(zip(rows["piece"], rows["step"], strict=True))}
    alive: list[tuple[int, int, int]] = []  # piece, landmark, observations left
    picked: list[tuple[int, int]] = []  # row, landmark
    started = 0
    for step, step_rows in rows.groupby("step"):
        alive = [(piece, landmark, life - 1) for piece, landmark, life in alive if life > 1]
        used = {piece for piece, _, _ in alive}
        candidates = step_rows[(step_rows["left"] >= rule.min_life) & ~step_rows["piece"].isin(used)]
        crowd = np.bincount(step_rows.loc[step_rows["piece"].isin(used), "band"], minlength=rule.bands)
        for piece, life in _next_landmarks(candidates, crowd, rule.slots - len(alive), rule):
            if life > rule.max_age:  # half for every other: cut all in one frame, nothing would link it on
                life = rule.max_age if started % 2 else rule.max_age // 2
            alive.append((piece, started, life))
            started += 1
        picked += [(row_of[piece, step], landmark) for piece, landmark, _ in alive]
    if not picked:
        raise InputError(
            f"the recording holds no track that could be used: {rule.min_life} observations in a row after step 0"
        )
    index, landmark = np.array(picked).T
    table: pd.DataFrame = rows.iloc[index].assign(landmark=landmark)
    return table[["step", "landmark", *PIXELS]].reset_index(drop=True)


def _next_landmarks(
    candidates: pd.DataFrame,
    crowd: Indices,
    free: int,
    rule: TrackSelection,
) -> list[tuple[int, int]]:
    """(piece, life) of the next landmarks, one column of the image after the other."""
    order = candidates.assign(life=candidates["left"].clip(upper=rule.max_age)).sort_values(
        ["life", "z2", "piece"], ascending=[False, False, True]
    )
    parts = [order[order["band"] == b] for b in range(rule.bands)]
    queues = [list(zip(q["piece"], q["left"], strict=True)) for q in parts]
    crowd = crowd.copy()
    result = list[tuple[int, int]]()
    while len(result) < free and any(queues):
        band = min((b for b in range(rule.bands) if queues[b]), key=lambda b: crowd[b])
        result.append(queues[band].pop(0))
        crowd[band] += 1
    return result
