"""State of a robot-centred map, and its steps: landmarks are parked at clones of the pose, and activated again.

The method is in :mod:`consistency.bench.filters.textbook.robocentric`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace

import numpy as np

from consistency.bench.filters.textbook.basics import heading_matrix, mounted
from consistency.bench.filters.textbook.inverse_range import (
    in_new_frame,
    moved_pose,
    pose_jacobian,
    poses_moved,
    shift_matrix,
    unit_vectors,
)
from consistency.bench.protocols import Problem
from consistency.referee.types import Array

Chart = Callable[[Array, Array], tuple[Array, Array]]  # poses and errors (k, 3) to moved poses and (3 k, 3 k)


@dataclass(frozen=True)
class CentredState:
    """Pose and blocks of three: clones of the pose, and landmarks, active or parked at a clone."""

    x: Array  # (n,), the pose; xi of a clone; a, e, rho of a landmark
    P: Array  # (n, n), of dp, dheading; and of the errors of these
    problem: Problem
    step: int = 0
    is_due: bool = False  # a round of parking
    noise: Array = field(default_factory=lambda: np.zeros((3, 2)))  # (3, k), added to the pose by the last motion
    places: dict[int, int] = field(default_factory=dict)  # offset of each landmark by label
    seen: dict[int, int] = field(default_factory=dict)  # step at which each was seen last
    parked: dict[int, int] = field(default_factory=dict)  # number of the clone at which a landmark is parked, by label
    clones: dict[int, int] = field(default_factory=dict)  # offset of each clone by number
    origins: dict[int, Array] = field(default_factory=dict)  # pose T (3,) of each, which is Exp(xi) T


def block_at(at: int) -> slice:
    """Places of the three numbers from ``at`` on."""
    return slice(at, at + 3)


def moved_by(state: CentredState, delta: Array) -> CentredState:
    """The state moved by an error (n,): the pose by Exp, all else by a sum."""
    x = state.x + delta
    x[:3] = moved_pose(state.x[:3], delta[:3])
    return replace(state, x=x)


def charted(state: CentredState, delta: Array, chart: Chart) -> tuple[CentredState, Array]:
    """The state moved by an error (n,), every clone to where it is then; d error about that / d error, (n, n)."""
    numbers = sorted(state.clones)  # in the order of time
    at = np.array([*(state.clones[number] for number in numbers), 0])[:, None] + np.arange(3)
    poses = np.array([*(state.origins[number] for number in numbers), state.x[:3]])
    x, C = state.x + delta, np.eye(len(delta))
    x[:3] = delta[:3]
    poses, C[np.ix_(at.ravel(), at.ravel())] = chart(poses, x[at])
    x[at] = 0.0
    x[:3] = poses[-1]
    return replace(state, x=x, origins=dict(zip(numbers, poses[:-1], strict=True))), C


def settled_clones(state: CentredState) -> CentredState:
    """Every clone at the pose it has, with the covariance of the error about that."""
    after, C = charted(state, np.zeros(len(state.x)), poses_moved)
    return replace(after, P=C @ state.P @ C.T)


def clones_of(state: CentredState, seen: list[int]) -> set[int]:
    """Numbers of the clones at which landmarks ``seen`` are parked."""
    return {state.parked[label] for label in seen if label in state.parked}


def indices_of(state: CentredState, clones: Collection[int], seen: list[int]) -> Array:
    """Indices of the pose, of the landmarks ``seen``, and of ``clones``."""
    starts = [0, *(state.places[label] for label in seen), *(state.clones[number] for number in clones)]
    return np.add.outer(starts, np.arange(3)).ravel()


def shifts_of(state: CentredState) -> Array:
    """(n, n), from the additive error of the pose to xi; the identity elsewhere."""
    T = np.eye(len(state.x))
    T[:3, :3] = shift_matrix(state.x[:3])
    return T


def turn_variance(state: CentredState, label: int) -> float:
    """Variance, rad^2, of the turn since the clone at which a landmark is parked."""
    P, clone = state.P, state.clones[state.parked[label]] + 2
    return float(P[2, 2] + P[clone, clone] - 2.0 * P[2, clone])


def clone_of(state: CentredState, number: int) -> tuple[slice, Array, Array]:
    """Where a clone is in the state, its pose (3,), and d xi about that pose / d xi about its origin (3, 3)."""
    at = block_at(state.clones[number])
    return at, moved_pose(state.origins[number], state.x[at]), pose_jacobian(state.x[at])


def expectation(state: CentredState, seen: list[int]) -> tuple[Array, Array]:
    """What is expected of landmarks, (m, 3), and its Jacobian (3 m, n), by xi of the pose about this state."""
    h, H = np.zeros((len(seen), 3)), np.zeros((3 * len(seen), len(state.x)))
    for i, label in enumerate(seen):
        rows, at = block_at(3 * i), block_at(state.places[label])
        if label not in state.parked:
            h[i], H[rows, at] = state.x[at], np.eye(3)
            continue
        clone, pose, J = clone_of(state, state.parked[label])
        h[i], H[rows, at], by_shift = seen_from(state, pose, state.x[at])
        H[rows, clone], H[rows, :3] = by_shift @ J, -by_shift
    return h, H


def seen_from(state: CentredState, clone: Array, y: Array) -> tuple[Array, Array, Array]:
    """A landmark parked at ``clone`` as it is seen now, and its derivatives by y and by xi_clone - xi, (3, 3) each."""
    pose = state.x[:3]
    Rt = heading_matrix(pose[2]).T
    R, t = Rt @ heading_matrix(clone[2]), Rt @ np.array([*(clone[:2] - pose[:2]), 0.0])
    (there,), (J,), (D,), (b,) = in_new_frame(y[None], R, t, state.problem.belief.sensor)
    W = Rt.T @ b + y[2] * np.array([*pose[:2], 0.0])  # rho times the point in the world
    by_shift = np.column_stack([y[2] * Rt[:, 0], y[2] * Rt[:, 1], Rt @ [-W[1], W[0], 0.0]])
    return there, J, D @ by_shift


def activated(state: CentredState, labels: list[int]) -> CentredState:
    """Landmarks that were parked, in the frame of the sensor again; clones that no landmark needs are dropped."""
    if not labels:
        return state
    x, T = state.x.copy(), np.eye(len(state.x))
    M = shift_matrix(x[:3])
    for label in labels:
        at, (clone, pose, J) = block_at(state.places[label]), clone_of(state, state.parked[label])
        x[at], T[at, at], by_shift = seen_from(state, pose, state.x[at])
        T[at, clone], T[at, :3] = by_shift @ J, -by_shift @ M
    parked = {label: number for label, number in state.parked.items() if label not in labels}
    return without_idle_clones(replace(state, x=x, P=T @ state.P @ T.T, parked=parked))


def without_block(state: CentredState, gone: int) -> CentredState:
    """The state without the block at ``gone``."""
    keep = np.delete(np.arange(len(state.x)), block_at(gone))

    def moved_up(places: dict[int, int]) -> dict[int, int]:
        return {key: at - 3 if at > gone else at for key, at in places.items() if at != gone}

    places, clones = moved_up(state.places), moved_up(state.clones)
    return replace(state, x=state.x[keep], P=state.P[np.ix_(keep, keep)], places=places, clones=clones)


def without_idle_clones(state: CentredState) -> CentredState:
    """The state without clones at which no landmark is parked."""
    for number in set(state.clones) - set(state.parked.values()):
        state = without_block(state, state.clones[number])
    return state


def with_parked(state: CentredState, unseen: int) -> CentredState:
    """The state with active landmarks that were ``unseen`` for so many steps parked at one new clone of the pose."""
    labels = [label for label in state.places if label not in state.parked and state.step - state.seen[label] >= unseen]
    if not labels:
        return state
    n, number = len(state.x), max(state.clones, default=0) + 1
    T = np.vstack([np.eye(n), np.zeros((3, n))])
    T[n:, :3] = shift_matrix(state.x[:3])
    return replace(
        state, x=np.append(state.x, np.zeros(3)), P=T @ state.P @ T.T,
        parked=state.parked | dict.fromkeys(labels, number), clones=state.clones | {number: n},
        origins=state.origins | {number: state.x[:3]},
    )  # fmt: skip


def point_in_world(state: CentredState, label: int) -> tuple[Array, Array]:
    """A landmark as a point (3,) in the world, m, and its Jacobian (3, n)."""
    at, frame, pose, to_shift = block_at(state.places[label]), slice(0, 3), state.x[:3], shift_matrix(state.x[:3])
    if label in state.parked:
        frame, pose, to_shift = clone_of(state, state.parked[label])
    offset, axes = mounted(state.problem.belief.sensor)
    (m,), (dm,) = unit_vectors(state.x[at][None])
    rho, R = state.x[at][2], heading_matrix(pose[2])
    point = R @ (axes @ m / rho + offset) + np.array([*pose[:2], 0.0])
    D = np.zeros((3, len(state.x)))
    D[:, at] = R @ axes @ np.column_stack([dm / rho, -m / rho**2])
    D[:, frame] = np.column_stack([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-point[1], point[0], 0.0]]) @ to_shift
    return point, D
