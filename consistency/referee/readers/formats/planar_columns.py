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
from consistency.referee.readers.formats.sheet import TableRows
from consistency.referee.readers.formats.table_columns import LOWER_NAMES
from consistency.referee.readers.formats.text_blocks import increasing
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
    names = head.names
    times, stated_unit = clock
    poses = places_of(names, PLACES)
    rates = places_of(names, (SPEEDS, TURNS))
    moving = poses or rates
    if moving is None:
        raise InputError(f"{path}: holds no x, y, heading and no v, omega; there are: {', '.join(names[:12])}")
    kept = [name for name in (*COVARIANCE, *LOWER_NAMES.values()) if name in names]
    for place in (covariance_places(names, POSE) | state_places(names, POSE, TRUE)).values():
        kept.append(names[place])
    kept = list(dict.fromkeys(kept))
    lines, values = read_named(path, head, (*times, *moving, *map(names.index, kept)), columns)
    t, unit = times_of(lines, times, values[: len(times)], stated_unit)
    values = values[len(times) :]
    pose = np.column_stack(values[: len(moving)])
    of = "planar poses"
    if poses is None:
        what = "motions" if motions else "poses"
        of = f"speed and turn rate, each held until the next, integrated to {what}"
        pose = motions_of(t, *pose.T)
        if not motions:
            pose = poses_of(pose)
    rows = increasing(replace(lines, values=np.column_stack([t, pose, *values[len(moving) :]])))
    data = dict(zip(["t", *POSE, *kept], rows.values.T, strict=True))
    note = f"{path}: read as {of}, {len(names)} columns, {UNIT_NAMES[unit]}"
    return TableRows(path, data, rows.line, "line", rows.open_line, rows.cut), note


def motions_of(t: Array, v: Array, omega: Array) -> Array:
    """Motions (N, 3) since the row before: forward, left and turn, in the frame of the body there, m and rad.

    Arcs of circles: ``v`` and ``omega`` (N,), m/s and rad/s, hold from their time ``t``, s, to the next one. The first
    row is 0.
    """
    dt = np.diff(t)
    turn = omega[:-1] * dt
    way = v[:-1] * dt
    half = 0.5 * turn
    chord = way * np.sinc(half / np.pi)
    rows = np.column_stack([chord * np.cos(half), chord * np.sin(half), turn])
    return np.concatenate([np.zeros((1, 3)), rows])


def poses_of(motions: Array) -> Array:
    """Poses (N, 3) from (0, 0, 0) on, of motions as :func:`motions_of` gives them; headings within half a turn."""
    forward, left, turn = motions.T
    heading = np.cumsum(turn)
    before = np.concatenate([[0.0], heading[:-1]])
    c = np.cos(before)
    s = np.sin(before)
    steps = np.column_stack([c * forward - s * left, s * forward + c * left])
    return np.column_stack([np.cumsum(steps, axis=0), wrap(heading)])
