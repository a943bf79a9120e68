"""The mix-ups in files that are looked for.

Each is a unit, order, side, frame or convention of one file or of both, or a covariance in other axes.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.geometry import PLANAR, SPATIAL, inverse, matrices, vectors, wrap
from consistency.referee.readers.alignment import (
    BodyTransform,
    WorldTransform,
    fitted_body,
    fitted_frame,
    moved,
    on_body,
    rotations,
    spread,
)
from consistency.referee.readers.truth_matching import Change, Poses, finite_rows, nearest, submatrices
from consistency.referee.types import Array

ALL_ORDERS = 4  # components up to which all orders are looked at
SWAPS = 8  # and up to which swaps of two are
DEGREE = np.pi / 180.0
MILLI = 1e-3
SINGULAR = 1e-3  # smallest eigenvalue of a correlation from which on a direction is named
SAME = 0.9  # share of a direction that is the same in all steps
WORK = 1e8  # multiplications at most to look for such directions
UNIT = 1e-3  # lengths of quaternions differ by less from 1
OF = {"both files": ("estimate", "truth"), "the estimates": ("estimate",), "the truth": ("truth",)}  # fields of poses
Function = Callable[[Any], Any]  # of a field of poses
ARM = 1e-3  # of the size of the path: shorter lever arms are not named
TURN = 3.0  # degrees: frames that differ by less are not named
SHIFT = 0.05  # of the size of the path
IN_WORLD = ("so2", "so3", "so3-body", "vector")  # errors whose position is along the axes of the world
NAMES = ("x y z", "px py pz", "pos_x pos_y pos_z", "east north up", "e n u", "north east down", "n e d")
SPEED = "v{}"  # name of a component of the velocity, of the axis
Axes = Callable[[Poses, list[int]], Array]  # columns (N, d, d) of axes at each estimate, of positions at these places


@dataclass(frozen=True)
class Guess:
    """A possible mix-up in words, and the files read without it."""

    text: str
    change: Change
    last: bool = False  # named only where nothing else fits: it has a fit of its own for each run
    fine: bool = True  # named where less than a decade is wrong too: no bias and no drift looks like it
    exact: bool = False  # named by its NEES alone, however little is wrong
    volume: float = 0.0  # log of the factor of volumes of the truth, whose density it divides


def guesses_of(runs: Sequence[Poses], axes: Sequence[str], part: list[int]) -> list[Guess]:
    """Possible mix-ups of covariances, units and orders, the likelier first; ``part`` is judged."""
    kind = runs[0].manifold
    convention = runs[0].convention
    n = runs[0].own.covariance.shape[-1]
    if kind == "spatial" and n > 6:
        return list(_swapped_blocks(n))
    scales = [*_roots(runs, part), *_singular(runs, axes, part)]
    if kind == "vector":
        covariances = _permuted(axes, len(axes))
        states = _permuted(axes, len(axes), states=True)
        return [*scales, *covariances, *states, *_quaternion_states(runs, axes)]
    of_covariance = [*scales, *_permuted(axes, 3)]
    if kind == "spatial":
        of_covariance = [*scales, *_block_orders(axes), *_permuted(axes, 3)]
        words = "its angles are half angles, those of the vector part of a quaternion; multiply their variances by 4"
        angles = slice(3, 6)
        half = Guess(words, changed(covariance=_times(angles, 2.0)), exact=True)
        own = [*_orders(convention), *_quaternions(), *of_covariance]
        own += [*_units(3, angles), half, *_positions(3)]
    else:
        sides = [kind for kind in PLANAR if kind not in (convention, "vector")]
        own = [*map(_of_error, sides), *_headings(), *of_covariance]
        own += [*_units(2, slice(2, 3)), *_positions(2)]
    words = "the poses of the estimates are inverse, world in body; invert them"
    return [*own, Guess(words, changed(estimate=_inverse), fine=False)]


# --- what makes fields of poses right ----------------------------------------------------------------


def changed(**functions: Function) -> Change:
    """A change of some fields of poses, each by a function of what it holds."""

    def change(p: Poses) -> Poses:
        return p.with_values(**{name: function(p.value(name)) for name, function in functions.items()})

    return change


def _columns(order: Sequence[int]) -> Function:
    """Columns (N, m) in another order."""
    return lambda values: values[:, list(order)]


def _components(order: Sequence[int]) -> Function:
    """Rows and columns of matrices (N, n, n) in another order."""
    return partial(submatrices, index=order)


def _declared(convention: str) -> Function:
    """Another convention of the error."""
    return lambda _: convention


def _times(part: slice, factor: float) -> Function:
    """Matrices (N, n, n) with some components multiplied by a factor."""

    def scaled(P: Array) -> Array:
        scale = np.ones(P.shape[-1])
        scale[part] = factor
        return P * scale[:, None] * scale

    return scaled


def _inverse(poses: Array) -> Array:
    """Inverse poses, where they are finite."""
    finite = finite_rows(poses)
    out: Array = poses.copy()
    out[finite] = vectors(inverse(matrices(poses[finite])))
    return out


# --- covariances -------------------------------------------------------------------------------------


def _roots(runs: Sequence[Poses], part: list[int]) -> Iterator[Guess]:
    """Standard deviations, an inverse or a root in the place of the covariance."""
    if any((p.variances < 0).any() for p in runs):
        return
    P = np.concatenate([submatrices(p.own.covariance, part) for p in runs])
    beside = P[:, ~np.eye(len(part), dtype=bool)]
    beside = beside[np.isfinite(beside)]
    squared = changed(covariance=lambda P: np.square(_without_cross_terms(P)))
    yield Guess("its diagonal holds standard deviations; square them", squared)
    if beside.any() and (np.abs(beside) <= 1.0).all():
        words = (
            "its diagonal holds standard deviations, and correlations are beside them; multiply each correlation by "
            "the two deviations, and square the diagonal"
        )
        yield Guess(words, changed(covariance=_of_correlations))
    inverted = partial(_inverted, part=part)
    yield Guess("it is an information matrix; invert it", changed(covariance=inverted))
    words = "it holds the upper root U of an information matrix U'U; write the inverse of U'U"
    yield Guess(words, changed(covariance=lambda U: inverted(_of_root(U))))
    if beside.any():
        yield Guess("it holds the lower root L of the covariance; write L L'", changed(covariance=_of_root))


def _of_correlations(P: Array) -> Array:
    """D R D of matrices with the deviations D on their diagonals and the correlations R beside."""
    n = P.shape[-1]
    sigma = np.diagonal(P, axis1=1, axis2=2)
    R = P.copy()
    R[:, range(n), range(n)] = 1.0
    return np.asarray(R * sigma[:, :, None] * sigma[:, None, :])


def _without_cross_terms(P: Array) -> Array:
    variances = np.diagonal(P, axis1=1, axis2=2)
    return np.asarray(variances[:, :, None] * np.eye(P.shape[-1]))


def _of_root(P: Array) -> Array:
    """U'U of the upper triangles U, which are the lower ones L turned over."""
    U = np.triu(P)
    return np.asarray(np.swapaxes(U, 1, 2) @ U)


def _inverted(P: Array, part: list[int]) -> Array:
    """Inverses of the rows and columns ``part``; NaN elsewhere and where there is none."""
    out = np.full_like(P, np.nan)
    block = submatrices(P, part)
    finite = np.flatnonzero(finite_rows(block))
    regular = finite[np.linalg.slogdet(block[finite])[0] != 0]
    out[np.ix_(regular, part, part)] = np.linalg.inv(block[regular])
    return out


def _swapped_blocks(n: int) -> Iterator[Guess]:
    """Blocks of three of the covariance of an inertial state in another order; biases at its end, in theirs."""
    names = np.array(["p", "R", "v", "bg", "ba"])
    behind = list(range(3, n // 3))
    for pose in itertools.permutations(range(3)):
        for rest in itertools.permutations(behind):
            order = np.array([*pose, *rest])
            if (np.diff(order) > 0).all():
                continue
            text = ",".join(names[np.argsort(order)])
            components = 3 * order[:, None] + np.arange(3)
            whole = components.ravel().tolist()
            words = f"the blocks of its covariance are in the order {text}; add --covariance-order {text}"
            yield Guess(words, changed(covariance=_components(whole)))


def _singular(runs: Sequence[Poses], axes: Sequence[str], part: list[int]) -> Iterator[Guess]:
    """Cross terms that make the covariance nearly singular, while each component by itself is right."""
    P = submatrices(np.concatenate([p.own.covariance for p in runs]), part)
    P = P[finite_rows(P)]
    if len(part) < 2 or not len(P):
        return
    sigma = np.sqrt(np.abs(np.diagonal(P, axis1=1, axis2=2)))
    with np.errstate(invalid="ignore", divide="ignore"):
        R = P / sigma[:, :, None] / sigma[:, None, :]
    R = R[finite_rows(R)]
    R = R[:: math.ceil(max(R.size * len(part) / WORK, 1.0))]
    if not len(R):
        return
    values, vectors = np.linalg.eigh(R)
    if np.median(values[:, 0]) > SINGULAR:
        return
    v = vectors[:, :, 0]
    share, mean = np.linalg.eigh(v.T @ v / len(v))
    where = "a direction that turns from step to step"
    if share[-1] > SAME:
        v = mean[:, -1] / mean[np.argmax(np.abs(mean[:, -1])), -1]
        direction = " ".join(f"{v[k]:+.2f} {axes[part[k]]}" for k in np.flatnonzero(np.abs(v) > 0.1))
        where = f"the direction {direction} (in standard deviations)"
    words = (
        f"its cross terms are left out: it is nearly singular in {where}; look for lost digits or a correlation of 1"
    )
    yield Guess(words, changed(covariance=_without_cross_terms))


# --- orders ------------------------------------------------------------------------------------------


def _quaternion_states(runs: Sequence[Poses], axes: Sequence[str]) -> Iterator[Guess]:
    """Four components of a state that are a unit quaternion, which has three degrees of freedom."""
    for first in range(len(axes) - 3):
        four = slice(first, first + 4)
        states = [values for p in runs for values in (p.own.estimate, p.true.values)]
        values = np.concatenate(states)[:, four]
        values = values[finite_rows(values)]
        lengths = np.linalg.norm(values, axis=1)
        if not len(values) or (np.abs(lengths - 1.0) > UNIT).any():
            continue
        for w in (3, 0):
            order = {0: "w x y z", 3: "x y z w"}[w]
            words = (
                f"{', '.join(axes[four])} are a unit quaternion ({order}) with three degrees of freedom; give poses, "
                "or a rotation vector with its 3 x 3 covariance"
            )
            yield Guess(words, partial(_rotation_vectors, first=first, w=w), exact=True)


def _rotation_vectors(p: Poses, first: int, w: int) -> Poses:
    """The state with a rotation vector, of the truth beside the estimate, in place of the quaternion."""
    order = np.arange(first, first + 4)
    rest = np.delete(np.arange(p.own.estimate.shape[1]), order)
    if w == 0:
        order = np.roll(order, -1)
    p = p.matched()
    turn = Rotation.from_quat(p.own.estimate[:, order])
    true = Rotation.from_quat(p.true.values[:, order])
    small = (turn.inv() * true).as_rotvec()
    x, y, z, s = turn.as_quat().T
    G = 2.0 * np.array([
        [s, z, -y, -x],
        [-z, s, x, -y],
        [y, -x, s, -z],
    ])  # fmt: skip
    J = np.zeros((len(turn), len(rest) + 3, p.own.estimate.shape[1]))
    J[:, range(len(rest)), rest] = 1.0
    J[:, len(rest) :, order] = np.moveaxis(G, -1, 0)
    P = J @ p.own.covariance @ np.swapaxes(J, 1, 2)
    truth = np.hstack([p.true.values[:, rest], small])
    estimate = np.hstack([p.own.estimate[:, rest], np.zeros_like(small)])
    return p.with_values(estimate=estimate, covariance=P, truth=truth)


def _permuted(axes: Sequence[str], width: int, states: bool = False) -> Iterator[Guess]:
    """Components of the covariance, or of estimates and covariance, in another order; of six in both blocks alike."""
    n = width if len(axes) != 2 * width else 2 * width
    what = "the components of the covariance are {}"
    if states:
        what = "the components of the estimates and of their covariance are {}, beside those of the truth"
    for order, there in _other_orders(axes, width):
        words = what.format(f"in the order {there}{' (rotations alike)' * (n > width)}")
        whole = [*order, *(width + i for i in order)][:n]
        fields = {"covariance": _components(whole)}
        if states:
            fields["estimate"] = _columns(whole)
        yield Guess(f"{words}; write them as {', '.join(axes[:width])}", changed(**fields))


def _block_orders(axes: Sequence[str]) -> Iterator[Guess]:
    """Components of one block of the covariance of poses in space in another order, the other block being right."""
    for first, what in ((3, "rotations"), (0, "positions")):
        same = list(range(6))
        own = axes[first : first + 3]
        for order, there in reversed([*_other_orders(own, 3)]):
            whole = [*same[:first], *(first + i for i in order), *same[first + 3 :]]
            words = f"the {what} of the covariance are in the order {there}; write them as {', '.join(own)}"
            yield Guess(words, changed(covariance=_components(whole)))


def _positions(width: int) -> Iterator[Guess]:
    """Coordinates of the estimates of poses in another order, with the blocks of their covariance or without."""
    axes = "xyz"[:width]
    turned = rest = [2]
    if width == 3:
        turned = [3, 4, 5, 6]
        rest = [3, 4, 5]
    for order, there in _other_orders(axes, width):
        words = f"of the estimates are in the order {there}; write them as {', '.join(axes)}"
        estimate = _columns([*order, *turned])
        covariance = _components([*order, *rest])
        yield Guess(f"the positions {words}", changed(estimate=estimate), fine=False)
        yield Guess(f"positions and covariance {words}", changed(estimate=estimate, covariance=covariance), fine=False)


def _other_orders(axes: Sequence[str], width: int) -> Iterator[tuple[list[int], str]]:
    """Other orders of the first ``width`` axes, with the axes in this order; swaps of two of many, none of too many."""
    same = list(range(width))
    orders: Iterable[Iterable[int]] = itertools.permutations(same)
    if width > ALL_ORDERS:
        orders = (_swapped(same, i, j) for i, j in itertools.combinations(same, 2))
    if width > SWAPS:
        return
    for order in map(list, orders):
        if order != same:
            yield order, ", ".join(axes[order.index(slot)] for slot in same)


def _swapped(order: Sequence[int], i: int, j: int) -> list[int]:
    """An order with two of its places swapped."""
    swapped = list(order)
    swapped[i], swapped[j] = order[j], order[i]
    return swapped


def _orders(convention: str) -> Iterator[Guess]:
    """Blocks of the covariance in the other order, other conventions of the error, and both."""
    swapped = _components([3, 4, 5, 0, 1, 2])
    turned = "the covariance has its two blocks in the other order (--covariance-order)"
    yield Guess(turned, changed(covariance=swapped))
    for other in SPATIAL:
        if other != convention:
            guess = _of_error(other)
            yield guess
            yield Guess(f"{guess.text} and {turned}", changed(covariance=swapped, convention=_declared(other)))


def _of_error(convention: str) -> Guess:
    return Guess(f"the error is '{convention}' (--error {convention})", changed(convention=_declared(convention)))


def _quaternions() -> Iterator[Guess]:
    first = _columns([0, 1, 2, 4, 5, 6, 3])
    for of, names in OF.items():
        words = f"the quaternions of {of} are w x y z; write them x y z w"
        yield Guess(words, changed(**dict.fromkeys(names, first)))
    back = np.array([1.0, 1.0, 1.0, -1.0, -1.0, -1.0, 1.0])
    words = "the quaternions of the estimates turn world into body; invert them"
    yield Guess(words, changed(estimate=lambda values: values * back))


# --- units -------------------------------------------------------------------------------------------


def _headings() -> Iterator[Guess]:
    """Headings in degrees, of one file or of both, with their variances or without."""
    for of, names in OF.items():
        fields: dict[str, Function] = dict.fromkeys(names, lambda poses: poses * [1.0, 1.0, DEGREE])
        fine = "truth" not in names
        volume = 0.0 if fine else float(np.log(DEGREE))
        words = f"the headings of {of}{{}} are in degrees; multiply them by pi / 180".format
        yield Guess(words(""), changed(**fields), fine=fine, volume=volume)
        fields["covariance"] = _times(slice(2, 3), DEGREE)
        yield Guess(words(" and their variances"), changed(**fields), fine=fine, volume=volume)


def _units(width: int, angles: slice) -> Iterator[Guess]:
    """Millimetres and degrees; the first ``width`` components are metres."""
    part = slice(0, width)

    def shrunk(values: Array) -> Array:
        out: Array = values.copy()
        out[:, part] *= MILLI
        return out

    less = _times(part, MILLI)
    words = "its angles are in degrees (deg^2 for rad^2); multiply them by pi / 180"
    yield Guess(words, changed(covariance=_times(angles, DEGREE)))
    words = "its positions are in millimetres (mm^2 for m^2); divide them by 1000"
    yield Guess(words, changed(covariance=less))
    remedy = "in millimetres; divide them by 1000"
    words = f"the positions of the estimates and their covariance are {remedy}"
    yield Guess(words, changed(estimate=shrunk, covariance=less))
    yield Guess(f"the positions of the estimates are {remedy}", changed(estimate=shrunk))
    words = f"the positions of the truth are {remedy}"
    volume = width * float(np.log(MILLI))
    yield Guess(words, changed(truth=shrunk), fine=False, volume=volume)


def worlds_of(runs: Sequence[Poses]) -> list[Guess]:
    """Possible mix-ups of the worlds and bodies of poses, the likelier first; none of other states."""
    kind = runs[0].manifold
    convention = runs[0].convention
    if kind == "vector" or runs[0].own.covariance.shape[-1] > 6:
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


def turns_of(runs: Sequence[Poses], axes: Sequence[str]) -> Iterator[Guess]:
    """Possible mix-ups of the axes of the covariance of positions, and of velocities beside them."""
    blocks = _position_blocks(runs[0], [axis.lower() for axis in axes])
    if not blocks or runs[0].convention not in IN_WORLD:
        return
    if not any(np.ptp(p.own.estimate[:, blocks[0]], axis=0).any() for p in runs if len(p.own.t)):
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
        poses_alone = p.own.covariance.shape[-1] <= 6
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
        n = p.own.covariance.shape[-1]
        own = axes(p, blocks[0])
        T = np.tile(np.eye(n), (len(own), 1, 1))
        for block in blocks:
            T[np.ix_(range(len(own)), block, block)] = own
        return p.with_values(covariance=T @ p.own.covariance @ np.swapaxes(T, 1, 2))

    return Guess(words, change)


def _motion(p: Poses, places: list[int]) -> tuple[Array, Array]:
    """True positions beside the estimates and their changes from sample to sample, (N, d) both.

    Where nothing moves, the motion is that before.
    """
    last = len(p.true.t) - 1
    before = np.clip(np.searchsorted(p.true.t, p.own.t, side="right") - 1, 0, last)
    at = nearest(p.own.t, p.true.t, before)
    true = p.true.values[:, places]
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
    forward = rotations(p.own.estimate, p.manifold).apply([1.0, 0.0, 0.0])
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
