"""Planar poses from files that do not hold them as columns t, x, y, heading: speeds and turn rates, poses in space."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from consistency.referee.column_names import COVARIANCE, POSE
from consistency.referee.errors import InputError
from consistency.referee.geometry import wrap
from consistency.referee.readers.clock_units import UNIT_NAMES
from consistency.referee.readers.formats.column_renaming import Columns
from consistency.referee.readers.formats.file_head import head_of
from consistency.referee.readers.formats.file_kinds import PLACES, SPEEDS, TURNS, is_poses
from consistency.referee.readers.formats.named_columns import TRUE, clock_of, places_of
from consistency.referee.readers.formats.other_names import covariance_places, state_places
from consistency.referee.readers.formats.pose_rows import on_plane, read_named, read_poses, times_of
from consistency.referee.readers.formats.sheet import TableRows, increasing
from consistency.referee.readers.formats.table_columns import LOWER_NAMES
from consistency.referee.types import Array


def read_plane(path: Path, motions: bool = False, columns: Columns | None = None) -> tuple[TableRows, str]:
    """Planar poses t, x, y, heading of a file, and what it was read as.

    Speeds and turn rates are integrated, each held from its row to the next: to the motion since the row before, in
    the frame of the body there, with ``motions``; else to poses from (0, 0, 0) on. Of poses in space it is the
    position and the heading of the x axis. Columns of a covariance, ``P_xx`` and so on, are kept.

    Raises
    ------
    InputError
        The file holds none of these, or its timestamps do not increase.
    """
    if is_poses(path, columns):
        lines = read_poses(path, true=True, columns=columns)
        of = lines.note or f"{path}: read as poses in space"
        return on_plane(lines, "line"), f"{of}, of which the heading is that of the x axis"
    head = head_of(path, columns)
    clock = None if head is None else clock_of(head.names)
    if head is None or clock is None:
        raise InputError(f"{path}: needs names of columns, t with x, y, heading, or t with v, omega")
    places, rates = places_of(head.names, PLACES), False
    if places is None:
        places, rates = places_of(head.names, (SPEEDS, TURNS)), True
    if places is None:
        raise InputError(f"{path}: holds no x, y, heading and no v, omega; there are: {', '.join(head.names[:12])}")
    others = covariance_places(head.names, POSE) | state_places(head.names, POSE, TRUE)
    known = (*COVARIANCE, *LOWER_NAMES.values(), *(head.names[place] for place in others.values()))
    stated = [name for name in dict.fromkeys(known) if name in head.names]
    wanted = (*clock[0], *places, *(head.names.index(name) for name in stated))
    lines, values = read_named(path, head, wanted, columns)
    first = len(clock[0])
    t, unit = times_of(lines, clock[0], values[:first], clock[1])
    pose = np.column_stack(values[first : first + len(places)])
    of = "planar poses"
    if rates:
        of = f"speed and turn rate, each held until the next, integrated to {'motions' if motions else 'poses'}"
        pose = motions_of(t, pose[:, 0], pose[:, 1])
        pose = pose if motions else poses_of(pose)
    rows = increasing(replace(lines, values=np.column_stack([t, pose, *values[first + len(places) :]])))
    note = f"{path}: read as {of}, {len(head.names)} columns, {UNIT_NAMES[unit]}"
    data = dict(zip(["t", *POSE, *stated], rows.values.T, strict=True))
    return TableRows(path, data, rows.line, "line", rows.open_line, rows.cut), note


def motions_of(t: Array, v: Array, omega: Array) -> Array:
    """Motions (N, 3) since the row before: forward, left and turn, in the frame of the body there, m and rad.

    Arcs of circles: ``v`` and ``omega`` (N,), m/s and rad/s, hold from their time ``t``, s, to the next one. The first
    row is 0.
    """
    dt = np.diff(t)
    turn, way = omega[:-1] * dt, v[:-1] * dt
    half = 0.5 * turn
    chord = way * np.sinc(half / np.pi)
    rows = np.column_stack([chord * np.cos(half), chord * np.sin(half), turn])
    return np.concatenate([np.zeros((1, 3)), rows])


def poses_of(motions: Array) -> Array:
    """Poses (N, 3) from (0, 0, 0) on, of motions as :func:`motions_of` gives them; headings within half a turn."""
    heading = np.cumsum(motions[:, 2])
    before = np.concatenate([[0.0], heading[:-1]])
    c, s = np.cos(before), np.sin(before)
    steps = np.column_stack([c * motions[:, 0] - s * motions[:, 1], s * motions[:, 0] + c * motions[:, 1]])
    return np.column_stack([np.cumsum(steps, axis=0), wrap(heading)])
