"""Landmarks over frames: matches linked to tracks, and few of them chosen for filters that are O(n^2) in landmarks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from consistency.referee.errors import InputError
from consistency.referee.types import Indices

PIXELS = ["z0", "z1", "z2"]
FREE = -1  # in place of a landmark's number


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


class TrackSelection(NamedTuple):
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
    rows : columns piece, step, z0, z1, z2, sorted by piece, then step, in which a piece skips no step; z0 from the
        middle of the image

    Raises
    ------
    InputError
        Nothing is left.
    """
    rows = rows[rows["step"] >= 1].reset_index(drop=True)
    column = (rows["z0"] + rule.width / 2) * rule.bands // rule.width  # of the image, from the left
    band = np.clip(column, 0, rule.bands - 1).to_numpy(np.int64)
    left = rows.groupby("piece").cumcount(ascending=False).to_numpy() + 1  # observations to come, with this one
    order = np.lexsort((rows["piece"], -rows["z2"], -np.minimum(left, rule.max_age), rows["step"]))
    landmark = np.full(len(rows), FREE)
    count = 0
    starts = 1 + np.flatnonzero(np.diff(rows["step"].to_numpy()[order]))
    for at in np.split(order, starts):
        taken = landmark[at] != FREE
        crowd = np.bincount(band[at[taken]], minlength=rule.bands)
        candidates = at[~taken & (left[at] >= rule.min_life)]
        for row in _next_rows(candidates, band, crowd, rule.slots - taken.sum()):
            life = left[row]
            if life > rule.max_age:
                life = rule.max_age
                if count % 2 == 0:  # every other is half as long: cut all in one frame, nothing would link it on
                    life //= 2
            landmark[row : row + life] = count
            count += 1
    if not count:
        raise InputError(
            f"the recording holds no track that could be used: {rule.min_life} observations in a row after step 0"
        )
    table: pd.DataFrame = rows.assign(landmark=landmark)[landmark != FREE]
    return table.sort_values(["step", "landmark"], ignore_index=True)[["step", "landmark", *PIXELS]]


def _next_rows(candidates: Indices, band: Indices, crowd: Indices, free: int) -> list[int]:
    """The first observations of the next landmarks, each from the emptiest column of the image."""
    queues = {b: list(candidates[band[candidates] == b]) for b in range(len(crowd))}
    chosen: list[int] = []
    while len(chosen) < free:
        waiting = [b for b, queue in queues.items() if queue]
        if not waiting:
            break
        emptiest = min(waiting, key=crowd.__getitem__)
        chosen.append(queues[emptiest].pop(0))
        crowd[emptiest] += 1
    return chosen
