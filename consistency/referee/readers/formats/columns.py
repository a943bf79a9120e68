"""Which columns of a file are what.

Places of columns are found by their meaning, under every spelling that is known; one that is missing is added here.
Names of the user's own (``--columns``) are put in place of a file's.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from consistency.referee.column_names import POSE
from consistency.referee.errors import InputError
from consistency.referee.readers.places import listed

POSITIONS = ("p_rs_r_{}", "p_{}", "p{}", "t_{}", "t{}", "pos_{}", "position_{}", "translation_{}", "{}")
QUATERNIONS = ("q_rs_{}", "q_{}", "q{}", "quat_{}", "orientation_{}", "rotation_{}")
MOVING = (
    ("v_rs_r_{}", "v_{}", "v{}", "vel_{}", "velocity_{}"),
    ("b_w_rs_s_{}", "bg_{}", "bg{}", "bw_{}", "bw{}", "b_g_{}", "gyro_bias_{}"),
    ("b_a_rs_s_{}", "ba_{}", "ba{}", "b_a_{}", "accel_bias_{}"),
)  # velocity, biases of gyroscope and accelerometer
FAMILIES = (POSITIONS, QUATERNIONS, *MOVING)
INNER = ("position_{}", "translation_{}", "orientation_{}", "rotation_{}")  # which a longer name may end in
HEADINGS = ("heading", "theta", "yaw", "orientation", "psi")
SHORT_HEADINGS = ("h", "th", "t")  # in names of a covariance alone
RUNS = ("run_id", "drive", "trial", "seq", "sequence", "episode", "flight", "session", "realization", "mc")
PLANE = (("x", "tx", "px"), ("y", "ty", "py"), HEADINGS)  # of a pose in the plane
SPEEDS = ("v", "speed", "velocity", "forward_velocity", "linear_velocity", "linear_x", "vx", "v_x")
TURNS = ("omega", "w", "yaw_rate", "yawrate", "turn_rate", "angular_velocity", "angular_z", "wz", "w_z")
PLAIN = ("{}",)
OWN = ("{}", "{}_est", "est_{}", "{}_hat", "{}_estimate", "estimate_{}", "{}_estimated", "estimated_{}")
TRUE = ("true_{}", "{}_true", "truth_{}", "{}_truth", "gt_{}", "{}_gt")  # of a truth beside the estimates
OTHER = "other"  # in place of the name of a column that does not count
CLOCKS = ("header_stamp", "stamp", "timestamp", "timestamps", "t", "time", "")  # pandas leaves its index without a name
HALVES = (("secs", "nsecs"), ("sec", "nsec"), ("sec", "nanosec"))
UNITS = {"s": 1, "sec": 1, "ms": 10**3, "us": 10**6, "ns": 10**9, "nsec": 10**9}  # in a second
RECORDED = "field_header_stamp"  # whose times are in ns: rostopic echo -p
COVARIANCES = ("p_{}_{}", "p_{}{}", "p{}_{}", "p{}{}", "cov_{}_{}", "cov_{}{}", "cov{}{}")
DEVIATIONS = (
    "sigma_{}", "std_{}", "s{}", "s_{}", "sd_{}", "sigma{}", "std{}", "stddev_{}", "sd{}", "{}_sd", "{}_std", "{}_sigma"
)  # standard, not squared  # fmt: skip
VARIANCES = ("var_{}", "var{}", "{}_var", "variance_{}")
LABELS = (("x", "y", "z", "roll", "pitch", "yaw"), ("x", "y", "z", "rx", "ry", "rz"), ("x", "y", "z", "a", "b", "c"))
MOVING_LABELS = ("vx", "vy", "vz", "bgx", "bgy", "bgz", "bax", "bay", "baz")  # behind those of a pose
CNSPY = "t{}{}"  # of a covariance of a pose; two blocks of it are p{}{} and q{}{}
NUMBERED = re.compile(r"(.*?(?:covariance|cov|p))_?(\d+)(?:_(\d+))?")  # pose_covariance_17, cov_0_0, P11
EUROC_END = ["bax", "bay", "baz"]  # of the 17 columns of EuRoC under short names
_OTHER = r"deg(?:rees?)?|°|mm|cm|km(?:/?h)?|mph|kph|ft|feet|rpm"
OTHER_UNITS = re.compile(rf"[\[(]\s*((?:{_OTHER})(?![a-z_])[^\])]*)[\])]", re.IGNORECASE)  # than SI and rad


Columns = Mapping[str, str]  # names of columns here, and those in a file

# --- states of a table -------------------------------------------------------------------------------


def is_pose(axes: Sequence[str]) -> bool:
    """Whether a state is a pose in the plane: x, y, heading."""
    return list(axes) == POSE


def run_column(names: Sequence[str]) -> str | None:
    """The column that numbers the runs by its name; None where there is none, or a column ``run``."""
    plain = plain_names(names)
    return None if "run" in plain else next((names[plain.index(word)] for word in RUNS if word in plain), None)


def state_columns(names: Sequence[str], axes: Sequence[str], spellings: Sequence[str]) -> dict[str, int]:
    """Places of the components of a state that are there, under their own names or spelled like ``est_{}``."""
    once = places_of(names)
    words_of: Sequence[tuple[str, ...]] = [(plain_name(axis),) for axis in axes]
    if is_pose(axes):
        words_of = PLANE
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
    for words in (SPEEDS, TURNS):
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
        words = [("x", "y", heading) for heading in (*HEADINGS, *SHORT_HEADINGS)]
    for first in (1, 0):
        words.append(tuple(map(str, range(first, first + len(axes)))))
    return next(_stated(names, axes, words, COVARIANCES))


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
    if not own and (deviations := alike(exact, axes, DEVIATIONS)):
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
        if not own and (deviations := alike(once, labels, DEVIATIONS)):
            yield Entries(_by_pairs(deviations), squared=False, renamed=True)
    yield Entries(best or own, renamed=bool(best))


def _diagonal(n: int) -> set[tuple[int, int]]:
    return {(i, i) for i in range(n)}


def _variances(once: Mapping[str, int], labels: Sequence[str]) -> dict[tuple[int, int], int]:
    """Places of variances under names of their own, by row and column."""
    found = {}
    for i, label in enumerate(labels):
        for place in alike(once, [label], VARIANCES):
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
    are_true = [bool(stem_of(name, TRUE)) for name in names]
    found = None
    if any(are_true):
        own = [stem_of(name, OWN[1:]) or name for name in names]
        found = _pose_columns([OTHER if true else name for name, true in zip(own, are_true, strict=True)], where)
    return found or _pose_columns(names, where)


def true_pose_columns(names: Sequence[str], where: Path) -> PoseColumns | None:
    """The columns of a true pose, with its quaternion, beside estimates; None where there is none.

    Raises
    ------
    InputError
        Several columns would do.
    """
    words = [stem_of(name, TRUE) or OTHER for name in names]
    clock = clock_of(names)
    if clock is not None:
        for place in clock.places:
            words[place] = stem_of(names[place], TRUE) or names[place]
    return _pose_columns(words, where)


def _pose_columns(names: Sequence[str], where: Path) -> PoseColumns | None:
    plain = plain_names(names)
    quaternion = _family(plain, QUATERNIONS, "xyzw", where)
    position = _family(plain, POSITIONS, "xyz", where)
    clock = clock_of(names)
    if not position or clock is None:
        return None
    kind = "poses by the names of their columns"
    if plain[position[0]] == "p_rs_r_x" or (len(plain) == 17 and plain[-3:] == EUROC_END):
        kind = "EuRoC truth"
    elif not quaternion:
        kind = "positions by the names of their columns"
    once = places_of(names)
    rest: tuple[int, ...] = ()
    if quaternion:
        moving = [alike(once, "xyz", spellings) for spellings in MOVING]
        rest = moving[0]
        if all(moving):
            rest = tuple(itertools.chain.from_iterable(moving))
    covariance, squared = _pose_covariance(names, len(rest))
    return PoseColumns(clock, position, quaternion, covariance, kind, rest, squared)


def _family(plain: Sequence[str], spellings: Sequence[str], parts: str, where: Path) -> tuple[int, ...]:
    """Places of the columns that are spelled alike, one for each part; none without them."""
    for spelling in spellings:
        found = [_places_like(plain, spelling.format(part), spelling in INNER) for part in parts]
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
    spellings = (*COVARIANCES, CNSPY)
    for n in sorted({6, 6 + min(rest, 3), 6 + rest}, reverse=True):
        words = [(*labels, *MOVING_LABELS[: n - 6]) for labels in LABELS]
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
        number = NUMBERED.fullmatch(name)
        if number and "twist" not in number[1]:
            stated.setdefault(number[1], {})[int(number[2]), int(number[3] or -1)] = place
    for places in stated.values():
        if len(places) in (n * n, n * (n + 1) // 2):
            return tuple(places[key] for key in sorted(places))
    return ()


def is_numbered(name: str) -> bool:
    """Whether a column has a number of a covariance, and not the names of two components."""
    return NUMBERED.fullmatch(name.lower()) is not None


# --- names -------------------------------------------------------------------------------------------


def naming(name: str) -> str:
    """What a refusal says of a column whose name is not"""
    return f"--columns {name}=NAME says what it is called, in a truth --truth-columns"


def plain_name(name: str) -> str:
    """A name in lower case without its unit, words joined by one underscore."""
    name = re.sub(r"[\[(]([^\]\d)][^\])]*)?[\])]", "", name.lower())
    return re.sub(r"[^a-z0-9]+", "_", name).strip("_")


def plain_names(names: Iterable[str]) -> list[str]:
    return list(map(plain_name, names))


def places_of(names: Iterable[str]) -> dict[str, int]:
    """Places of plain names, without those that several columns have."""
    plain = plain_names(names)
    count = Counter(plain)
    return {name: place for place, name in enumerate(plain) if count[name] == 1}


def alike(places: Mapping[str, int], words: Sequence[str], spellings: Sequence[str]) -> tuple[int, ...]:
    """Places of all the words under the first spelling that has them all; none without one."""
    for spelling in spellings:
        names = list(map(spelling.format, words))
        if set(names) <= set(places):
            return tuple(map(places.__getitem__, names))
    return ()


def stem_of(name: str, spellings: Sequence[str]) -> str:
    """What a name has in the place of ``{}`` of a spelling; "" of other names."""
    plain = plain_name(name)
    for spelling in spellings:
        before, _, after = spelling.partition("{}")
        if plain.startswith(before) and plain.endswith(after) and len(plain) > len(before + after):
            return plain[len(before) : len(plain) - len(after)]
    return ""


def require_units(names: Iterable[str], path: Path) -> None:
    """Refuse columns whose names state a unit that is not of the SI, such as ``heading [deg]``."""
    for name in names:
        if found := OTHER_UNITS.search(name):
            what = f"column '{name}' is in {found[1].strip()}"
            raise InputError(f"{path}: {what}; units are SI and radians: convert and rename it")


# --- the time ----------------------------------------------------------------------------------------


class Clock(NamedTuple):
    """Columns of a time, by their places."""

    places: tuple[int, ...]  # one, or seconds and nanoseconds
    unit: int | None  # in a second; None where the name says none


def clock_of(names: Sequence[str]) -> Clock | None:
    """The columns of the time; None without one."""
    plain = plain_names(names)
    for seconds, rest in HALVES:
        for place, name in enumerate(plain):
            other = name[: -len(seconds)] + rest
            if name.endswith(seconds) and other in plain:
                return Clock((place, plain.index(other)), 1)
    bare = list(map(without_unit, plain))
    for clock in CLOCKS:
        for place, name in enumerate(bare):
            if name == clock or (clock == "header_stamp" and name.endswith(clock)):
                return Clock((place,), unit_in(names[place]))
    return None


def without_unit(plain: str) -> str:
    """The plain name of a time without its unit."""
    return re.sub(rf"_({'|'.join(UNITS)})$", "", plain)


def unit_in(name: str) -> int | None:
    """How many of the units that the name of a time states are a second; None where it states none."""
    if stated := re.search(r"[\[(_ ]\s*(s|sec|ms|us|ns|nsec)\s*[\])]?$", name.lower()):
        return UNITS[stated[1]]
    return 10**9 if plain_name(name) == RECORDED else None


# --- names of the user's own -------------------------------------------------------------------------


class Named(NamedTuple):
    """A name of a column, and its place in the file."""

    name: str
    place: int


def renamed(names: Sequence[str], columns: Columns | None, where: Path) -> list[Named]:
    """Names of columns, with those of ``columns`` in place of the file's own, in the order of the file.

    Of a column that is named several times the further names stand at the end. A column that is not named there, but
    would play the same part, is hidden behind another name. A name here with a ``*`` stands for all columns that begin
    or end alike. A time keeps the unit that its name in the file states.

    Raises
    ------
    InputError
        A column is not there, or two get the same name.
    """
    new: dict[int, str] = {}
    more = []
    for name, old in (columns or {}).items():
        places = _places(names, old)
        if not places:
            what = f"has no column '{old}', which is to be read as '{name}'"
            raise InputError(f"{where}: {what}; there are: {listed(names, 12)}")
        for place, rest in places.items():
            require_units([names[place]], where)
            own = _with_unit(name.replace("*", rest), names[place])
            if new.setdefault(place, own) != own:
                more.append(Named(own, place))
    given = [*new.values(), *(each.name for each in more)]
    taken = set(chain.from_iterable(map(_alike, given)))
    out = []
    for place, name in enumerate(names):
        if place not in new and _plays(name, taken):
            name = f"{name} not used"
        out.append(Named(new.get(place, name), place))
    out += more
    for name in given:
        if sum(each.name == name for each in out) > 1:
            raise InputError(f"{where}: two columns are named '{name}'")
    return out


def columns_of_axes(axes: Sequence[str], columns: Columns | None) -> dict[str, str]:
    """What the file of ``columns`` calls the columns of components, by component."""
    names = {}
    for new, old in (columns or {}).items():
        before, _, after = new.partition("*")
        for axis in axes:
            rest = axis[len(before) : len(axis) - len(after)]
            if new.replace("*", rest) == axis:
                names[axis] = old.replace("*", rest)
    return names


def _places(names: Sequence[str], old: str) -> dict[int, str]:
    """Places of the columns of a name, or of all that a ``*`` stands for, with what stands in its place."""
    if "*" not in old:
        if old in names:
            return {names.index(old): ""}
        plain = plain_names(names)
        return {plain.index(plain_name(old)): ""} if plain_name(old) in plain else {}
    before, _, after = old.partition("*")
    found = {}
    for place, name in enumerate(names):
        if name.startswith(before) and name.endswith(after) and len(name) > len(before + after):
            found[place] = name[len(before) : len(name) - len(after)]
    return found


def _with_unit(name: str, old: str) -> str:
    """A name of a time with the unit that the file states, if it states none itself."""
    unit = unit_in(old)
    if clock_of([name]) is None or unit_in(name) is not None or unit is None:
        return name
    words = {value: word for word, value in reversed(UNITS.items())}
    return f"{name}_{words[unit]}"


def _alike(name: str) -> list[str]:
    """All spellings of the part that a column plays."""
    if clock_of([name]) is not None:
        return [*CLOCKS, *chain.from_iterable(HALVES)]
    plain = plain_name(name)
    words = [plain]
    for family in FAMILIES:
        for part in "xyzw":
            same = [spelling.format(part) for spelling in family]
            if plain in same:
                words += same
    return words


def _plays(name: str, words: set[str]) -> bool:
    """Whether a column has one of some spellings: with a unit, in a longer name, or in an estimate's name."""
    plain = plain_name(name)
    own = {plain, without_unit(plain), stem_of(name, OWN[1:]) or plain}
    ends = tuple(f"_{word}" for word in words if "_" in word)
    return bool(own & words) or plain.endswith(ends)
