"""Which columns make up a pose in space, by their names, as EuRoC, exports of bags and tables of pandas have them."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from consistency.referee.errors import InputError

POSITIONS = ("p_rs_r_{}", "p_{}", "p{}", "t_{}", "t{}", "pos_{}", "position_{}", "translation_{}", "{}")
QUATERNIONS = ("q_rs_{}", "q_{}", "q{}", "quat_{}", "orientation_{}", "rotation_{}")
MOVING = (
    ("v_rs_r_{}", "v_{}", "v{}", "vel_{}", "velocity_{}"),
    ("b_w_rs_s_{}", "bg_{}", "bg{}", "bw_{}", "bw{}", "b_g_{}", "gyro_bias_{}"),
    ("b_a_rs_s_{}", "ba_{}", "ba{}", "b_a_{}", "accel_bias_{}"),
)  # velocity, biases of gyroscope and accelerometer
INNER = ("position_{}", "translation_{}", "orientation_{}", "rotation_{}")  # which a longer name may end in
CLOCKS = ("header_stamp", "stamp", "timestamp", "timestamps", "t", "time", "")  # pandas leaves its index without a name
HALVES = (("secs", "nsecs"), ("sec", "nsec"), ("sec", "nanosec"))
UNITS = {"s": 1, "sec": 1, "ms": 10**3, "us": 10**6, "ns": 10**9, "nsec": 10**9}  # in a second
RECORDED = "field_header_stamp"  # whose times are in ns: rostopic echo -p
LABELS = (("x", "y", "z", "roll", "pitch", "yaw"), ("x", "y", "z", "rx", "ry", "rz"), ("x", "y", "z", "a", "b", "c"))
MOVING_LABELS = ("vx", "vy", "vz", "bgx", "bgy", "bgz", "bax", "bay", "baz")  # behind those of a pose
PREFIXES = ("p_", "p", "cov_", "cov", "t")  # before two labels
DEVIATIONS = (
    "sigma_{}", "std_{}", "s{}", "s_{}", "sd_{}", "sigma{}", "std{}", "stddev_{}", "sd{}", "{}_sd", "{}_std", "{}_sigma"
)  # standard, not squared  # fmt: skip
VARIANCES = ("var_{}", "var{}", "{}_var", "variance_{}")
TRUE = ("true_{}", "{}_true", "truth_{}", "{}_truth", "gt_{}", "{}_gt")  # of a truth beside the estimates
OWN = ("{}", "{}_est", "est_{}", "{}_hat", "{}_estimate", "estimate_{}", "{}_estimated", "estimated_{}")
OTHER = "other"  # in place of the name of a column that does not count
EUROC_END = ["bax", "bay", "baz"]  # of the 17 columns of EuRoC under short names
_OTHER = r"deg(?:rees?)?|°|mm|cm|km(?:/?h)?|mph|kph|ft|feet|rpm"
OTHER_UNITS = re.compile(rf"[\[(]\s*((?:{_OTHER})(?![a-z_])[^\])]*)[\])]", re.IGNORECASE)  # than SI and rad
NUMBERED = re.compile(r"(.*?)(?:covariance|cov)_?(\d+)(?:_(\d+))?")
BY_INDEX = re.compile(r"(.*?)p_?(\d+)(?:_(\d+))?")  # P11, ..., P66


@dataclass(frozen=True)
class Roles:
    """Which columns are what, by their places."""

    time: tuple[int, ...]  # one, or seconds and nanoseconds
    unit: int | None  # in a second; None where the name says none
    position: tuple[int, ...]  # (3,)
    quaternion: tuple[int, ...]  # (4,), x, y, z, w; none of positions alone
    covariance: tuple[int, ...] = ()  # n^2, its upper triangle, or 12: rotation, then position; or n deviations
    kind: str = "poses by the names of their columns"
    rest: tuple[int, ...] = ()  # (3,), a velocity, or (9,), biases of gyroscope and accelerometer, too
    squared: bool = False  # the deviations are variances

    @property
    def is_tum(self) -> bool:
        """Whether they are the first columns of a TUM trajectory."""
        return self.time + self.position + self.quaternion == tuple(range(8)) and self.unit in (None, 1)


def roles_of(names: Sequence[str], where: Path) -> Roles | None:
    """Which columns make up a pose, or a position without a quaternion; None without a position or a time.

    Columns of a truth beside the estimates, as ``true_x`` beside ``x``, are not looked at.

    Raises
    ------
    InputError
        Several columns would do.
    """
    own: list[str] = []
    has_truth = False
    for name in names:
        is_true = bool(stem_of(name, TRUE))
        own.append(OTHER if is_true else stem_of(name, OWN[1:]) or name)
        has_truth |= is_true
    roles = _roles(own, where) if has_truth else None
    return roles or _roles(names, where)


def true_roles_of(names: Sequence[str], where: Path) -> Roles | None:
    """Which columns make up a true pose, with its quaternion, beside estimates; None where there is none.

    Raises
    ------
    InputError
        Several columns would do.
    """
    words = [stem_of(name, TRUE) or OTHER for name in names]
    clock = clock_of(names)
    if clock is not None:
        for place in clock[0]:
            words[place] = stem_of(names[place], TRUE) or names[place]
    return _roles(words, where)


def stem_of(name: str, spellings: Sequence[str]) -> str:
    """What a name has in the place of ``{}`` of a spelling; "" of other names."""
    plain = plain_name(name)
    for spelling in spellings:
        before, _, after = spelling.partition("{}")
        if plain.startswith(before) and plain.endswith(after) and len(plain) > len(before + after):
            return plain[len(before) : len(plain) - len(after)]
    return ""


def _roles(names: Sequence[str], where: Path) -> Roles | None:
    plain = plain_names(names)
    quaternion = _family(plain, QUATERNIONS, "xyzw", where)
    position = _family(plain, POSITIONS, "xyz", where)
    clock = clock_of(names)
    if not position or clock is None:
        return None
    what = "poses"
    by = "by the names of their columns"
    if plain[position[0]] == "p_rs_r_x" or (len(plain) == 17 and plain[-3:] == EUROC_END):
        what = "EuRoC"
        by = "truth"
    rest: tuple[int, ...] = ()
    if quaternion:
        rest = _rest(plain)
    elif what == "poses":
        what = "positions"
    covariance = _covariance(plain, len(rest))
    variances: tuple[int, ...] = ()
    if not covariance:
        variances = _deviations(plain, len(rest), VARIANCES)
    return Roles(*clock, position, quaternion, covariance or variances, f"{what} {by}", rest, bool(variances))


# --- names -------------------------------------------------------------------------------------------


def naming(name: str) -> str:
    """What a refusal says of a column whose name is not known."""
    return f"--columns {name}=NAME says what it is called, in a truth --truth-columns"


def plain_name(name: str) -> str:
    """A name in lower case without its unit, words joined by one underscore."""
    name = re.sub(r"[\[(]([^\]\d)][^\])]*)?[\])]", "", name.lower())
    return re.sub(r"[^a-z0-9]+", "_", name).strip("_")


def plain_names(names: Iterable[str]) -> list[str]:
    return list(map(plain_name, names))


def spelled(spelling: str, words: Iterable[str]) -> list[str]:
    """A spelling such as ``true_{}`` of each word."""
    return list(map(spelling.format, words))


def all_places(plain: Sequence[str], wanted: Sequence[str]) -> tuple[int, ...]:
    """Places of all the wanted names, of each the first one; none where a name is not there."""
    if not set(wanted) <= set(plain):
        return ()
    return tuple(map(plain.index, wanted))


def only_places(plain: Sequence[str]) -> dict[str, int]:
    """Places of the names that are there once."""
    count = Counter(plain)
    return {name: place for place, name in enumerate(plain) if count[name] == 1}


def clock_of(names: Sequence[str]) -> tuple[tuple[int, ...], int | None] | None:
    """Places of the time, and how many of its units are a second, where its name says it; None without a time."""
    plain = plain_names(names)
    for seconds, rest in HALVES:
        for place, name in enumerate(plain):
            other = name[: -len(seconds)] + rest
            if name.endswith(seconds) and other in plain:
                return (place, plain.index(other)), 1
    bare = list(map(without_unit, plain))
    for clock in CLOCKS:
        for place, name in enumerate(bare):
            if name == clock or (clock == "header_stamp" and name.endswith(clock)):
                return (place,), unit_in(names[place])
    return None


def without_unit(plain: str) -> str:
    """The plain name of a time without its unit."""
    return re.sub(rf"_({'|'.join(UNITS)})$", "", plain)


def unit_in(name: str) -> int | None:
    """How many of the units that the name of a time states are a second; None where it states none."""
    if stated := re.search(r"[\[(_ ]\s*(s|sec|ms|us|ns|nsec)\s*[\])]?$", name.lower()):
        return UNITS[stated[1]]
    return 10**9 if plain_name(name) == RECORDED else None


def places_of(names: Sequence[str], spellings: Sequence[Sequence[str]]) -> tuple[int, ...] | None:
    """Places of columns, the first one there of the spellings of each; a longer name may end in one of two words."""
    plain = plain_names(names)
    found = []
    for words in spellings:
        there = [plain.index(word) for word in words if word in plain]
        ends = tuple(f"_{word}" for word in words if "_" in word)
        there += [place for place, name in enumerate(plain) if name.endswith(ends)]
        if not there:
            return None
        found.append(there[0])
    return tuple(found)


def numbered(name: str) -> bool:
    """Whether a column has a number of a covariance, and not the names of two components."""
    return any(pattern.fullmatch(name.lower()) for pattern in (NUMBERED, BY_INDEX))


def require_units(names: Iterable[str], path: Path) -> None:
    """Refuse columns whose names state a unit that is not of the SI, such as ``heading [deg]``."""
    for name in names:
        if found := OTHER_UNITS.search(name):
            what = f"column '{name}' is in {found[1].strip()}"
            raise InputError(f"{path}: {what}; units are SI and radians: convert and rename it")


# --- parts of a pose ---------------------------------------------------------------------------------


def _family(plain: list[str], spellings: Sequence[str], parts: str, where: Path) -> tuple[int, ...]:
    """Places of the columns that are spelled alike, one for each part; none without them."""
    for spelling in spellings:
        found = [_places_like(plain, name, spelling in INNER) for name in spelled(spelling, parts)]
        if not all(found):
            continue
        for part, places in zip(parts, found, strict=True):
            if len(places) > 1:
                many = f"{len(places)} columns are '{spelling.format(part)}'"
                advice = "leave one pose in the file, or choose by name"
                raise InputError(f"{where}: {many}; {advice}: {naming(part)}")
        return tuple(places[0] for places in found)
    return ()


def _places_like(plain: list[str], name: str, in_longer: bool) -> list[int]:
    """Places of a name, or of longer ones that end in it."""
    exact = [place for place, other in enumerate(plain) if other == name]
    if exact or not in_longer:
        return exact
    return [place for place, other in enumerate(plain) if other.endswith(f"_{name}")]


def _rest(plain: list[str]) -> tuple[int, ...]:
    """Places of a velocity, and of both biases where they are there."""
    once = list(only_places(plain))
    found = []
    for spellings in MOVING:
        there = [names for spelling in spellings if set(names := spelled(spelling, "xyz")) <= set(once)]
        found.append(all_places(plain, there[0]) if there else ())
    velocity, gyroscope, accelerometer = found
    if gyroscope and accelerometer and velocity:
        return velocity + gyroscope + accelerometer
    return velocity


def _covariance(plain: list[str], rest: int) -> tuple[int, ...]:
    """Places of the columns of a covariance of a pose and ``rest`` more, or of the pose alone; none without one."""
    for labels, prefix in itertools.product(_labels(rest), PREFIXES):
        if found := _triangle(plain, prefix, labels):
            return found
    rotation, position = _triangle(plain, "q", ("r", "p", "y")), _triangle(plain, "p", ("x", "y", "z"))  # of cnspy
    if rotation and position:
        return rotation + position
    sizes = [size for n in _sizes(rest) for size in (n * n, n * (n + 1) // 2)]
    return (
        _numbered(plain, NUMBERED, sizes) or _deviations(plain, rest, DEVIATIONS) or _numbered(plain, BY_INDEX, sizes)
    )


def _sizes(rest: int) -> list[int]:
    """Numbers of components that a covariance of a pose and ``rest`` more may have, the largest first."""
    return sorted({6, 6 + min(rest, 3), 6 + rest}, reverse=True)


def _labels(rest: int) -> list[tuple[str, ...]]:
    """Words for the components of a pose and ``rest`` more."""
    return [(*labels, *MOVING_LABELS[: n - 6]) for n in _sizes(rest) for labels in LABELS]


def _deviations(plain: list[str], rest: int, spellings: Sequence[str]) -> tuple[int, ...]:
    """Places of the standard deviations, or variances, of all components; none without them."""
    for labels, spelling in itertools.product(_labels(rest), spellings):
        if found := all_places(plain, spelled(spelling, labels)):
            return found
    return ()


def _numbered(plain: list[str], pattern: re.Pattern[str], sizes: Sequence[int]) -> tuple[int, ...]:
    """Places of numbered columns of a covariance, as many as one of the ``sizes``; none without them."""
    stated: dict[str, dict[tuple[int, int], int]] = {}
    for place, name in enumerate(plain):
        number = pattern.fullmatch(name)
        if number and "twist" not in number[1]:
            stated.setdefault(number[1], {})[int(number[2]), int(number[3] or -1)] = place
    for places in stated.values():
        if len(places) in sizes:
            return tuple(places[key] for key in sorted(places))
    return ()


def _triangle(plain: list[str], prefix: str, labels: Sequence[str]) -> tuple[int, ...]:
    """Places of the entries of an upper triangle, or of their mirror images; none where one is not there."""
    join = "_" if prefix.endswith("_") else ""
    found: list[int] = []
    for a, b in itertools.combinations_with_replacement(labels, 2):
        there = all_places(plain, [f"{prefix}{a}{join}{b}"]) or all_places(plain, [f"{prefix}{b}{join}{a}"])
        if not there:
            return ()
        found += there
    return tuple(found)
