"""Covariances of positions in other axes that are looked for: those of the motion, or turned the wrong way."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from consistency.referee.readers.alignment.world_frames import rotations
from consistency.referee.readers.mix_ups.known import Guess
from consistency.referee.readers.truth_matching import Poses, nearest
from consistency.referee.types import Array

IN_WORLD = ("so2", "so3", "so3-body", "vector")  # errors whose position is along the axes of the world
NAMES = ("x y z", "px py pz", "pos_x pos_y pos_z", "east north up", "e n u", "north east down", "n e d")
SPEED = "v{}"  # name of a component of the velocity, of the axis

Axes = Callable[[Poses, list[int]], Array]  # columns (N, d, d) of axes at each estimate, of positions at these places


def turns_of(runs: Sequence[Poses], axes: Sequence[str]) -> Iterator[Guess]:
    """Possible mix-ups of the axes of the covariance of positions, and of velocities beside them."""
    blocks = _position_blocks(runs[0], [axis.lower() for axis in axes])
    if not blocks or runs[0].convention not in IN_WORLD:
        return
    if not any(np.ptp(p.estimate[:, blocks[0]], axis=0).any() for p in runs if len(p.t)):
        return  # errors without places
    names = ", ".join(axes[i] for i in blocks[0])
    own = f"turn it into the axes of {names}"
    in_space = len(blocks[0]) == 3
    if in_space:
        words = f"the covariance of {names} is along radius, track and normal; {own}"
        yield _turned(words, _orbital, blocks)
    words = f"the covariance of {names} is along and across the motion; {own}"
    yield _turned(words, _along, blocks)
    turn = "course" if runs[0].manifold == "vector" else "heading"
    words = f"the covariance of {names} is turned by the negative {turn}; turn it by the {turn} itself"
    yield _turned(words, _wrong_way, blocks)


def _position_blocks(p: Poses, axes: Sequence[str]) -> list[list[int]]:
    """Places of the positions, and of velocities along the same axes; none where the state has no positions."""
    if p.manifold != "vector":
        poses_alone = p.covariance.shape[-1] <= 6
        return [list(range(p.d))] if poses_alone else []
    for names in map(str.split, NAMES):
        for d in (3, 2):
            speeds = list(map(SPEED.format, names[:d]))
            blocks = [list(map(axes.index, some)) for some in (names[:d], speeds) if set(some) <= set(axes)]
            if blocks and set(names[:d]) <= set(axes):
                return blocks
    return [list(range(len(axes)))] if len(axes) in (2, 3) else []


def _turned(words: str, axes: Axes, blocks: list[list[int]]) -> Guess:
    """Covariances in axes of their own, turned into those of the error."""

    def change(p: Poses) -> Poses:
        n = p.covariance.shape[-1]
        own = axes(p, blocks[0])
        T = np.tile(np.eye(n), (len(own), 1, 1))
        for block in blocks:
            T[np.ix_(range(len(own)), block, block)] = own
        return replace(p, covariance=T @ p.covariance @ np.swapaxes(T, 1, 2))

    return Guess(words, change)


def _motion(p: Poses, places: list[int]) -> tuple[Array, Array]:
    """True positions beside the estimates and their changes from sample to sample, (N, d) both.

    Where nothing moves, the motion is that before.
    """
    last = len(p.true_t) - 1
    before = np.clip(np.searchsorted(p.true_t, p.t, side="right") - 1, 0, last)
    at = nearest(p.t, p.true_t, before)
    true = p.truth[:, places]
    change = true[np.minimum(at + 1, last)] - true[np.maximum(at - 1, 0)]
    moves = (change != 0).any(axis=1)
    latest = np.maximum.accumulate(np.where(moves, np.arange(len(at)), 0))
    return true[at], change[latest]


def _along(p: Poses, places: list[int]) -> Array:
    """Along the motion over ground, to its left, and up."""
    _, change = _motion(p, places)
    return _about_z(np.arctan2(change[:, 1], change[:, 0]), len(places))


def _wrong_way(p: Poses, places: list[int]) -> Array:
    """What is turned by the negative heading, or course, is right if it is turned by the heading twice."""
    if p.manifold == "vector":
        _, change = _motion(p, places)
        return _about_z(2.0 * np.arctan2(change[:, 1], change[:, 0]), len(places))
    forward = rotations(p.estimate, p.manifold).apply([1.0, 0.0, 0.0])
    return _about_z(2.0 * np.arctan2(forward[:, 1], forward[:, 0]), len(places))


def _about_z(angle: Array, d: int) -> Array:
    """Turns (N, d, d) about z."""
    R = np.tile(np.eye(d), (len(angle), 1, 1))
    c = np.cos(angle)
    s = np.sin(angle)
    R[:, :2, :2] = np.moveaxis(np.array([[c, -s], [s, c]]), -1, 0)
    return R


def _orbital(p: Poses, places: list[int]) -> Array:
    """Along the radius, to the front, and normal to both."""
    place, change = _motion(p, places)
    normal = np.cross(place, change)
    track = np.cross(normal, place)
    axes = np.stack([place, track, normal], axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(axes / np.linalg.norm(axes, axis=1, keepdims=True))
