"""EKF-SLAM by sub-maps, Williams (2001), "Efficient solutions to autonomous mapping and navigation problems".

The constrained local submap filter (Williams, Dissanayake & Durrant-Whyte 2002). Every so many steps the robot starts a
small map in a frame whose origin is its pose at that moment: there it is known exactly, and nothing depends on what was
seen before. The large map keeps its landmarks and, for its robot, the pose of that frame. When the next small map is
begun, the one before is joined to the large map:

1. robot and landmarks of the small map are turned and shifted into the world, with the covariances of the frame's pose
   and of the small map, which are independent;
2. a landmark that is in both maps is one landmark: the difference of its two positions is observed to be zero, without
   noise. Then one of the two is left out;
3. the robot's pose in the world is that of the next frame.

Headings in a small map are small, and so are errors of linearisation in it; those of a closed loop come at once, with
the constraint. In a linear world the estimate after a join is that of one large filter. Between joins the large map is
not asked, so that the pose is less certain than it could be.

There are no kernels of this method. The loop of the kernels has one state with one robot in it, whose pose it reports,
and a landmark has one place there; here two maps stand side by side, each with its robot, and landmarks are in both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from consistency.bench.filters.textbook import basics
from consistency.bench.filters.textbook.basics import SlamState, heading_matrix
from consistency.bench.filters.textbook.ekf import ExtendedKalman
from consistency.bench.protocols import Problem
from consistency.bench.types import Control, Gaussian, Info, Observation

STEPS = 50  # of a small map: 5 s, in which the heading of the published robot drifts by 4 degrees


@dataclass(frozen=True)
class Maps:
    """The map as it was at the last join, with the frame of the small map for its robot, and the small map."""

    large: SlamState
    small: SlamState
    steps: int = 0  # of the small map


class SubmapKalman:
    def __init__(self, name: str, uvd: bool, steps: int = STEPS) -> None:
        self.name, self.uvd, self.steps = name, uvd, steps
        self.sensors = ("uvd",) if uvd else ("xyz", "uvd")
        self.small = ExtendedKalman(name, uvd)

    def init(self, problem: Problem) -> Maps:
        return self._begun(basics.start(problem))

    def predict(self, state: Maps, control: Control) -> Maps:
        return replace(state, small=self.small.predict(state.small, control), steps=state.steps + 1)

    def update(self, state: Maps, observation: Observation) -> tuple[Maps, Info]:
        small, info = self.small.update(state.small, observation)
        state = replace(state, small=small)
        return (self._begun(joined_map(state)) if state.steps == self.steps else state), info

    def forget(self, state: Maps, landmark: int) -> Maps:
        large, small = (
            basics.without(part, landmark) if landmark in part.landmarks else part
            for part in (state.large, state.small)
        )
        return replace(state, large=large, small=small)

    def pose(self, state: Maps) -> Gaussian:
        return basics.pose_of(in_world(state))

    def map(self, state: Maps) -> dict[int, Gaussian]:
        return basics.map_of_state(joined_map(state))

    def _begun(self, large: SlamState) -> Maps:
        return Maps(large, self.small.init(replace(large.problem, start=np.zeros(3))))


def in_world(state: Maps) -> SlamState:
    """Robot, landmarks of the large map and those of the small one, all in the world; a landmark may be duplicated."""
    large, small = state.large, state.small
    origin, n, turn = large.x[:3], len(large.x), heading_matrix(large.x[2])
    x, J = [large.x[3:]], np.eye(n + len(small.x))
    for o in range(0, len(small.x), 3):
        is_robot = o == 0  # whose third number is a heading
        point = turn @ small.x[o : o + 3] + [origin[0], origin[1], origin[2] * is_robot]
        rows = slice(n + o, n + o + 3)
        J[rows, :3] = [[1.0, 0.0, origin[1] - point[1]], [0.0, 1.0, point[0] - origin[0]], [0.0, 0.0, is_robot]]
        J[rows, rows] = turn
        x.insert(0 if is_robot else len(x), point)
    order = np.r_[n : n + 3, 3:n, n + 3 : len(J)]  # the robot first; the frame is left out
    J = J[order]
    P = J @ block_diag(large.P, small.P) @ J.T
    return replace(large, x=np.concatenate(x), P=P, landmarks=large.landmarks + small.landmarks)


def joined_map(state: Maps) -> SlamState:
    """The large map with what the small one has, every landmark once."""
    both, first = in_world(state), len(state.large.landmarks)
    shared = [label for label in state.small.landmarks if label in state.large.landmarks]
    copies = [3 + 3 * (first + state.small.landmarks.index(label)) for label in shared]
    x, P, keep = both.x, both.P, np.ones(len(both.x), bool)
    if shared:
        H = np.zeros((3 * len(shared), len(x)))
        for i, (label, copy) in enumerate(zip(shared, copies, strict=True)):
            o, rows = state.large.at(label), slice(3 * i, 3 * i + 3)
            H[rows, o : o + 3], H[rows, copy : copy + 3] = np.eye(3), -np.eye(3)
            keep[copy : copy + 3] = False
        S, W = basics.gain(P, H, np.zeros((len(H), len(H))))
        x, P = x - W @ H @ x, P - W @ S @ W.T
    new = tuple(label for label in state.small.landmarks if label not in shared)
    P = P[np.ix_(keep, keep)]
    return replace(both, x=x[keep], P=(P + P.T) / 2.0, landmarks=state.large.landmarks + new)


FILTERS = {name: SubmapKalman(name, uvd=name.endswith("uvd")) for name in ("submap-ekf-xyz", "submap-ekf-uvd")}
