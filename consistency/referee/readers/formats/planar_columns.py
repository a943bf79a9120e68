"""Planar poses from files that do not hold them as columns t, x, y, heading: speeds and turn rates, poses in space."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from consistency.referee.column_names import POSE
from consistency.referee.errors import InputError
from consistency.referee.geometry import wrap
from consistency.referee.readers.clock_units import UNIT_NAMES
from consistency.referee.readers.formats.columns import rates_in, state_columns
from consistency.referee.readers.formats.file_head import head_of
from consistency.referee.readers.formats.file_kinds import is_poses
from consistency.referee.readers.formats.pose_rows import on_plane, read_poses
from consistency.referee.readers.formats.sheet import OF_ONE_RUN, TableRows, sheet_of
from consistency.referee.readers.formats.spellings import PLAIN, Columns, clock_of, require_units
from consistency.referee.readers.formats.table_columns import times_of
from consistency.referee.types import Array


def read_plane(path: Path, motions: bool = False, columns: Columns | None = None) -> tuple[TableRows, str]:
    """A table with planar poses t, x, y, heading of a file that holds them otherwise, and what it was read as.

    Speeds and turn rates are integrated, each held from its row to the next: to the motion since the row before, in
    the frame of the body there, with ``motions``; else to poses from (0, 0, 0) on. Of poses in space it is the
    position and the heading of the x axis.

    Raises
    ------
    InputError
        Speeds are of several runs, or a row cannot be read.
    """
    if is_poses(path, columns):
        lines = read_poses(path, true=True, columns=columns)
        of = lines.note or f"{path}: read as poses in space"
        return on_plane(lines, "line"), f"{of}, of which the heading is that of the x axis"
    head = head_of(path, columns)
    assert head is not None
    names = head.names
    clock = clock_of(names)
    assert clock is not None
    poses = state_columns(names, POSE, PLAIN)
    are_poses = len(poses) == len(POSE)
    moving = tuple(poses.values()) if are_poses else rates_in(names)
    require_units([names[place] for place in (*clock.places, *moving)], path)
    sheet = sheet_of(path, head, columns)
    t, unit = times_of(sheet, clock, [sheet.numbers(names[place]) for place in clock.places])
    pose = sheet.matrix(names[place] for place in moving)
    of = "planar poses"
    if not are_poses:
        if "run" in sheet or "filter" in sheet:
            raise InputError(f"{path}: column 'run' or 'filter': {OF_ONE_RUN}")
        what = "motions" if motions else "poses"
        of = f"speed and turn rate, each held until the next, integrated to {what}"
        pose = motions_of(t, *pose.T)
        if not motions:
            pose = poses_of(pose)
    data = dict(zip(["t", *POSE], [t, *pose.T], strict=True))
    note = f"{path}: read as {of}, {len(names)} columns, {UNIT_NAMES[unit]}"
    return replace(sheet, data=sheet.data | data), note


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
