"""Which columns of a file are what: places of columns by their meaning, found by the names of :mod:`spellings`."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from consistency.referee.column_names import POSE
from consistency.referee.errors import InputError
from consistency.referee.readers.formats import spellings as known
from consistency.referee.readers.formats.spellings import (
    Clock,
    alike,
    clock_of,
    naming,
    places_of,
    plain_name,
    plain_names,
    stem_of,
)

# --- states of a table -------------------------------------------------------------------------------


def is_pose(axes: Sequence[str]) -> bool:
    """Whether a state is a pose in the plane: x, y, heading."""
    return list(axes) == POSE


def state_columns(names: Sequence[str], axes: Sequence[str], spellings: Sequence[str]) -> dict[str, int]:
    """Places of the components of a state that are there, under their own names or spelled like ``est_{}``."""
    once = places_of(names)
    words_of: Sequence[tuple[str, ...]] = [(plain_name(axis),) for axis in axes]
    if is_pose(axes):
        words_of = known.PLANE
    found = {}
    for axis, words in zip(axes, words_of, strict=True):
        if "{}" in spellings and axis in names:
            found[axis] = names.index(axis)
            continue
        for spelling, word in itertools.product(spellings, words):
            if spelling.format(word) in once:
                found[axis] = once[spelling.format(word)]
                break
    return found


def rates_in(names: Sequence[str]) -> tuple[int, ...]:
    """Places of a speed and a turn rate; none without both. A longer name may end in one of two words."""
    plain = plain_names(names)
    found = []
    for words in (known.SPEEDS, known.TURNS):
        there = [plain.index(word) for word in words if word in plain]
        ends = tuple(f"_{word}" for word in words if "_" in word)
        there += [place for place, name in enumerate(plain) if name.endswith(ends)]
        found += there[:1]
    return tuple(found) if len(found) == 2 else ()


class Entries(NamedTuple):
    """Columns of a covariance, or of standard deviations on its diagonal, by row and column."""

    places: Mapping[tuple[int, int], int]
    squared: bool = True  # False of deviations
    renamed: bool = False  # they have other names than those of docs/files.md

    def without_cross_terms(self, n: int) -> bool:
        """Whether each of n components is stated by itself; a single variance is a whole covariance."""
        is_diagonal = n > 1 and set(self.places) == _diagonal(n)
        return is_diagonal or not self.squared

    def in_order(self, n: int) -> tuple[int, ...]:
        """Places of the upper triangle, row by row, or of n components by themselves; none where one is not there."""
        pairs = list(itertools.combinations_with_replacement(range(n), 2))
        if self.without_cross_terms(n):
            pairs = [(i, i) for i in range(n)]
        found = [self.places.get((i, j), self.places.get((j, i))) for i, j in pairs]
        there = tuple(place for place in found if place is not None)
        return there if len(there) == len(pairs) else ()


def entry_name(axes: Sequence[str], i: int, j: int) -> str:
    """Name of an entry of a covariance in docs/files.md: ``P_a_b``, or ``P_xh`` of poses in the plane."""
    if is_pose(axes):
        return f"P_{'xyh'[i]}{'xyh'[j]}"
    return f"P_{axes[i]}_{axes[j]}"


def covariance_columns(names: Sequence[str], axes: Sequence[str]) -> Entries:
    """Columns of the covariance of a state: those of docs/files.md where these have all variances or deviations.

    Of several other spellings that with most columns counts; deviations count where no covariance is there.
    """
    words = [tuple(plain_names(axes))]
    if is_pose(words[0]):
        words = [("x", "y", heading) for heading in (*known.HEADINGS, *known.SHORT_HEADINGS)]
    for first in (1, 0):
        words.append(tuple(map(str, range(first, first + len(axes)))))
    return next(_stated(names, axes, words, known.COVARIANCES))


def _stated(
    names: Sequence[str], axes: Sequence[str], words: Sequence[Sequence[str]], spellings: Sequence[str]
) -> Iterator[Entries]:
    """What states the covariance of a state, the likelier first; at last what there is, which may be nothing.

    Parameters
    ----------
    words : for the components, in other spellings than those of docs/files.md
    """
    n = len(axes)
    exact = {name: place for place, name in enumerate(names)}
    once = places_of(names)
    own = entries_of(exact, axes, "P_{}_{}")
    if is_pose(axes):
        own = entries_of(exact, "xyh", "P_{}{}") | own
    if _diagonal(n) <= set(own):
        yield Entries(own)
    if not own and (deviations := alike(exact, axes, known.DEVIATIONS)):
        yield Entries(_by_pairs(deviations), squared=False)
    best: dict[tuple[int, int], int] = {}
    for labels in words:
        variances = _variances(once, labels)
        for spelling in spellings:
            if not variances and spelling.format(labels[0], labels[0]) not in once:
                continue
            found = {**variances, **entries_of(once, labels, spelling)}
            if _diagonal(n) <= set(found) and len(found) > len(best):
                best = found
    if len(best) > n:
        yield Entries(best, renamed=True)
    for labels in words:
        if not own and (deviations := alike(once, labels, known.DEVIATIONS)):
            yield Entries(_by_pairs(deviations), squared=False, renamed=True)
    yield Entries(best or own, renamed=bool(best))


def _diagonal(n: int) -> set[tuple[int, int]]:
    return {(i, i) for i in range(n)}


def _variances(once: Mapping[str, int], labels: Sequence[str]) -> dict[tuple[int, int], int]:
    """Places of variances under names of their own, by row and column."""
    found = {}
    for i, label in enumerate(labels):
        for place in alike(once, [label], known.VARIANCES):
            found[i, i] = place
    return found


def _by_pairs(places: Sequence[int]) -> dict[tuple[int, int], int]:
    """Places of components by themselves, by row and column."""
    return {(i, i): place for i, place in enumerate(places)}


def entries_of(places: Mapping[str, int], words: Sequence[str], spelling: str) -> dict[tuple[int, int], int]:
    """Places of the entries of a covariance by row and column.

    None where two entries have one name, as P111 of eleven components, which may be P(1,11) or P(11,1).
    """
    found = {}
    names = set()
    for i, j in itertools.product(range(len(words)), repeat=2):
        name = spelling.format(words[i], words[j])
        if name in names:
            return {}
        names.add(name)
        if name in places:
            found[i, j] = places[name]
    return found


# --- poses in space ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class PoseColumns:
    """Columns of a pose in space, by their places."""

    clock: Clock
    position: tuple[int, ...]  # (3,)
    quaternion: tuple[int, ...]  # (4,), x, y, z, w; none of positions alone
    covariance: tuple[int, ...] = ()  # n^2, its upper triangle, or 12: rotation, then position; or n deviations
    kind: str = "poses by the names of their columns"
    rest: tuple[int, ...] = ()  # (3,), a velocity, or (9,), biases of gyroscope and accelerometer, too
    squared: bool = False  # the deviations are variances

    @property
    def is_tum(self) -> bool:
        """Whether they are the first columns of a TUM trajectory."""
        first = self.clock.places + self.position + self.quaternion
        return first == tuple(range(8)) and self.clock.unit in (None, 1)


def pose_columns(names: Sequence[str], where: Path) -> PoseColumns | None:
    """The columns of a pose, or of a position without a quaternion; None without a position or a time.

    Columns of a truth beside the estimates, as ``true_x`` beside ``x``, are not looked at.

    Raises
    ------
    InputError
        Several columns would do.
    """
    are_true = [bool(stem_of(name, known.TRUE)) for name in names]
    found = None
    if any(are_true):
        own = [stem_of(name, known.OWN[1:]) or name for name in names]
        found = _pose_columns([known.OTHER if true else name for name, true in zip(own, are_true, strict=True)], where)
    return found or _pose_columns(names, where)


def true_pose_columns(names: Sequence[str], where: Path) -> PoseColumns | None:
    """The columns of a true pose, with its quaternion, beside estimates; None where there is none.

    Raises
    ------
    InputError
        Several columns would do.
    """
    words = [stem_of(name, known.TRUE) or known.OTHER for name in names]
    clock = clock_of(names)
    if clock is not None:
        for place in clock.places:
            words[place] = stem_of(names[place], known.TRUE) or names[place]
    return _pose_columns(words, where)


def _pose_columns(names: Sequence[str], where: Path) -> PoseColumns | None:
    plain = plain_names(names)
    quaternion = _family(plain, known.QUATERNIONS, "xyzw", where)
    position = _family(plain, known.POSITIONS, "xyz", where)
    clock = clock_of(names)
    if not position or clock is None:
        return None
    kind = "poses by the names of their columns"
    if plain[position[0]] == "p_rs_r_x" or (len(plain) == 17 and plain[-3:] == known.EUROC_END):
        kind = "EuRoC truth"
    elif not quaternion:
        kind = "positions by the names of their columns"
    once = places_of(names)
    rest: tuple[int, ...] = ()
    if quaternion:
        moving = [alike(once, "xyz", spellings) for spellings in known.MOVING]
        rest = moving[0]
        if all(moving):
            rest = tuple(itertools.chain.from_iterable(moving))
    covariance, squared = _pose_covariance(names, len(rest))
    return PoseColumns(clock, position, quaternion, covariance, kind, rest, squared)


def _family(plain: Sequence[str], spellings: Sequence[str], parts: str, where: Path) -> tuple[int, ...]:
    """Places of the columns that are spelled alike, one for each part; none without them."""
    for spelling in spellings:
        found = [_places_like(plain, spelling.format(part), spelling in known.INNER) for part in parts]
        if not all(found):
            continue
        for part, places in zip(parts, found, strict=True):
            if len(places) > 1:
                many = f"{len(places)} columns are '{spelling.format(part)}'"
                advice = "leave one pose in the file, or choose by name"
                raise InputError(f"{where}: {many}; {advice}: {naming(part)}")
        return tuple(places[0] for places in found)
    return ()


def _places_like(plain: Sequence[str], name: str, in_longer: bool) -> list[int]:
    """Places of a name, or of longer ones that end in it."""
    exact = [place for place, other in enumerate(plain) if other == name]
    if exact or not in_longer:
        return exact
    return [place for place, other in enumerate(plain) if other.endswith(f"_{name}")]


def _pose_covariance(names: Sequence[str], rest: int) -> tuple[tuple[int, ...], bool]:
    """Places of the columns of a covariance of a pose and ``rest`` more, or of the pose alone; none without one.

    Also whether they are variances alone.
    """
    spellings = (*known.COVARIANCES, known.CNSPY)
    for n in sorted({6, 6 + min(rest, 3), 6 + rest}, reverse=True):
        words = [(*labels, *known.MOVING_LABELS[: n - 6]) for labels in known.LABELS]
        variances: tuple[int, ...] = ()
        for found in _stated(names, words[0], words, spellings):
            places = found.in_order(n)
            if found.squared and len(places) == n:
                variances = places
            elif places:
                return places, False
        if places := _numbered(names, n):
            return places, False
        if variances:
            return variances, True
    once = places_of(names)
    rotation = Entries(entries_of(once, "rpy", "q{}{}")).in_order(3)
    position = Entries(entries_of(once, "xyz", "p{}{}")).in_order(3)
    return (rotation + position if rotation and position else ()), False


def _numbered(names: Sequence[str], n: int) -> tuple[int, ...]:
    """Places of numbered columns of a covariance, all n^2 of them or its upper triangle; none without them."""
    stated: dict[str, dict[tuple[int, int], int]] = {}
    for place, name in enumerate(plain_names(names)):
        number = known.NUMBERED.fullmatch(name)
        if number and "twist" not in number[1]:
            stated.setdefault(number[1], {})[int(number[2]), int(number[3] or -1)] = place
    for places in stated.values():
        if len(places) in (n * n, n * (n + 1) // 2):
            return tuple(places[key] for key in sorted(places))
    return ()


def is_numbered(name: str) -> bool:
    """Whether a column has a number of a covariance, and not the names of two components."""
    return known.NUMBERED.fullmatch(name.lower()) is not None
