"""The mix-ups of worlds and bodies that are looked for: axes, turns and shifts that the two files do not share."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.geometry import wrap
from consistency.referee.readers.alignment.world_frames import (
    BodyTransform,
    WorldTransform,
    fitted_body,
    fitted_frame,
    moved,
    on_body,
    spread,
)
from consistency.referee.readers.mix_ups.known import Guess, changed
from consistency.referee.readers.truth_matching import Poses
from consistency.referee.types import Array

ARM = 1e-3  # of the size of the path: shorter lever arms are not named
TURN = 3.0  # degrees: frames that differ by less are not named
SHIFT = 0.05  # of the size of the path


def worlds_of(runs: Sequence[Poses]) -> list[Guess]:
    """Possible mix-ups of the worlds and bodies of poses, the likelier first; none of other states."""
    kind = runs[0].manifold
    convention = runs[0].convention
    if kind == "vector" or runs[0].covariance.shape[-1] > 6:
        return []
    axes = _ned() if kind == "spatial" else [_mirrored(convention)]
    return [*axes, *_frames(runs), *_bodies(runs)]


def _ned() -> Iterator[Guess]:
    """A world whose z points down, with a body whose z does so too or not."""
    swapped = Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    north = WorldTransform(swapped, np.zeros(3))
    down = BodyTransform(Rotation.from_matrix(np.diag([1.0, -1.0, -1.0])), np.zeros(3))
    worlds = "one file is in a world of x north, y east, z down, the other in one of x east, y north, z up"
    remedy = "add --world ned{0} if that is the estimates, --truth-world ned{1} if it is the truth"
    yield Guess(f"{worlds}; {remedy.format('', '')}", lambda p: moved(p, north), fine=False)
    remedy = remedy.format(" --body-axes frd", " --truth-body-axes frd")
    words = f"{worlds}, and their bodies have z down and z up; {remedy}"
    yield Guess(words, lambda p: on_body(moved(p, north), down), fine=False)


def _mirrored(convention: str) -> Guess:
    """A plane whose x is north and y east."""
    A = np.diag([1.0, -1.0, -1.0])
    if convention != "left":
        A[:2, :2] = [[0.0, 1.0], [1.0, 0.0]]

    def swapped(pose: Array) -> Array:
        x, y, heading = pose.T
        return np.column_stack([y, x, wrap(0.5 * np.pi - heading)])

    words = "one file is in a plane of x north, y east, the other in one of x east, y north"
    remedy = "add --world ned if that is the estimates, --truth-world ned if it is the truth"
    change = changed(estimate=swapped, covariance=lambda P: A @ P @ A.T)
    return Guess(f"{words}; {remedy}", change, fine=False)


def _frames(runs: Sequence[Poses]) -> Iterator[Guess]:
    """The worlds of the files differ by a turn about z and a shift, the same in all runs, or another in each."""
    frame = fitted_frame(runs)
    if frame is None or not (size := spread(runs)) > 0:
        return
    angle = np.rad2deg(frame.heading)
    several = len(runs) > 1
    if abs(angle) >= TURN or np.linalg.norm(frame.shift) >= SHIFT * size:
        turn = ""
        mode = "posyaw"
        if abs(angle) > TURN:
            turn = f"turned by {angle:.1f} degrees about z and "
        if several:
            mode = "posyaw-all"
        words = (
            f"the world of the estimates is {turn}shifted by {_place(frame.shift, runs)} m to meet that of the truth; "
            f"write both in one world, or add --align {mode}"
        )
        yield Guess(words, lambda p: moved(p, frame), fine=False)
    if several:
        words = "each run is turned about z and shifted by itself to meet the truth; add --align posyaw"
        yield Guess(words, lambda p: moved(p, fitted_frame([p]) or frame), last=True, fine=False)


def _bodies(runs: Sequence[Poses]) -> Iterator[Guess]:
    """The bodies of the files differ by a constant turn or lever arm."""
    body = fitted_body(runs)
    if body is None:
        return
    angle = np.round(np.rad2deg(body.turn.as_rotvec()), 1) + 0.0
    size = spread(runs)
    parts = []
    if np.linalg.norm(angle) >= TURN:
        turned = f"({angle[0]:.1f}, {angle[1]:.1f}, {angle[2]:.1f}) degrees about x, y, z"
        if runs[0].manifold == "planar":
            turned = f"{angle[2]:.1f} degrees about z"
        parts.append(f"turned by {turned}")
    if np.linalg.norm(body.arm) >= ARM * size:
        parts.append(f"shifted by a lever arm of {_place(body.arm, runs)} m")
    if parts:
        words = f"the body of the truth is {' and '.join(parts)} against that of the estimates; write poses of one body"
        yield Guess(words, lambda p: on_body(p, body), fine=False)


def _place(values: Array, runs: Sequence[Poses]) -> str:
    """Coordinates in space, or x and y."""
    d = 2 if runs[0].manifold == "planar" else 3
    return f"({', '.join(f'{value:.3g}' for value in values[:d])})"
