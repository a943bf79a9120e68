"""Poses in space by the names of their columns, as EuRoC, exports of bags and tables of pandas have them."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence
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
RECORDED = ("field_header_stamp",)  # names whose times are in ns: rostopic echo -p
LABELS = (("x", "y", "z", "roll", "pitch", "yaw"), ("x", "y", "z", "rx", "ry", "rz"), ("x", "y", "z", "a", "b", "c"))
MOVING_LABELS = ("vx", "vy", "vz", "bgx", "bgy", "bgz", "bax", "bay", "baz")  # behind those of a pose
PREFIXES = ("p_", "p", "cov_", "cov", "t")  # before two labels
DEVIATIONS = ("sigma_{}", "std_{}", "s{}", "s_{}", "sd_{}", "sigma{}", "std{}", "stddev_{}", "sd{}",
              "{}_sd", "{}_std", "{}_sigma")  # standard, not squared  # fmt: skip
VARIANCES = ("var_{}", "var{}", "{}_var", "variance_{}")
TRUE = ("true_{}", "{}_true", "truth_{}", "{}_truth", "gt_{}", "{}_gt")  # of a truth beside the estimates
OWN = ("{}", "{}_est", "est_{}", "{}_hat", "{}_estimate", "estimate_{}", "{}_estimated", "estimated_{}")
OTHER = "other"  # in place of the name of a column that does not count
APART = {"p": ("x", "y", "z"), "q": ("r", "p", "y")}  # two triangles of cnspy: position, rotation
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


# --- names -------------------------------------------------------------------------------------------


def roles_of(names: Sequence[str], where: Path) -> Roles | None:
    """Which columns make up a pose, or a position without a quaternion; None without a position or a time.

    Columns of a truth beside the estimates, as ``true_x`` beside ``x``, are not looked at.

    Raises
    ------
    InputError
        Several columns would do.
    """
    true = [stem_of(name, TRUE) for name in names]
    if any(true):
        own = [OTHER if word else stem_of(name, OWN[1:]) or name for name, word in zip(names, true, strict=True)]
        if (roles := _roles(own, where)) is not None:
            return roles
    return _roles(names, where)


def true_roles_of(names: Sequence[str], where: Path) -> Roles | None:
    """Which columns make up a true pose, with its quaternion, beside estimates; None where there is none.

    Raises
    ------
    InputError
        Several columns would do.
    """
    clock = clock_of(names)
    times = () if clock is None else clock[0]
    words = [stem_of(name, TRUE) or (name if i in times else OTHER) for i, name in enumerate(names)]
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
    plain = [plain_name(name) for name in names]
    quaternion = _family(plain, QUATERNIONS, "xyzw", where)
    position = _family(plain, POSITIONS, "xyz", where)
    clock = clock_of(names)
    if position is None or clock is None:
        return None
    asl = plain[position[0]] == "p_rs_r_x" or (len(plain) == 17 and plain[-3:] == ["bax", "bay", "baz"])
    kind = "poses by the names of their columns"
    if asl:
        kind = "EuRoC truth"
    rest: tuple[int, ...] = ()
    if quaternion:
        rest = _rest(plain)
    else:
        kind = kind.replace("poses", "positions")
    covariance, squared = _covariance(plain, len(rest)), False
    if not covariance:
        covariance = _deviations(plain, len(rest), VARIANCES)
        squared = bool(covariance)
    return Roles(*clock, position, quaternion or (), covariance, kind, rest, squared)


def naming(name: str) -> str:
    """What a refusal says of a column whose name is not known."""
    return f"--columns {name}=NAME says what it is called, in a truth --truth-columns"


def plain_name(name: str) -> str:
    """A name in lower case without its unit, words joined by one underscore."""
    name = re.sub(r"[\[(]([^\]\d)][^\])]*)?[\])]", "", name.lower())
    return re.sub(r"[^a-z0-9]+", "_", name).strip("_")


def _family(plain: list[str], spellings: Sequence[str], parts: str, where: Path) -> tuple[int, ...] | None:
    """Places of the columns that are spelled alike, one for each part; None without them."""
    for spelling in spellings:
        found: list[list[int]] = []
        for part in parts:
            name = spelling.format(part)
            exact = [i for i, other in enumerate(plain) if other == name]
            longer = [i for i, other in enumerate(plain) if spelling in INNER and other.endswith(f"_{name}")]
            found.append(exact or longer)
        if not all(found):
            continue
        if many := next((places for places in found if len(places) > 1), []):
            name = spelling.format(parts[found.index(many)])
            raise InputError(
                f"{where}: {len(many)} columns are '{name}'; leave one pose in the file, or choose by name: "
                f"{naming(parts[found.index(many)])}"
            )
        return tuple(places[0] for places in found)
    return None


def clock_of(names: Sequence[str]) -> tuple[tuple[int, ...], int | None] | None:
    """Places of the time, and how many of its units are a second, where its name says it; None without a time."""
    plain = [plain_name(name) for name in names]
    bare = [re.sub(rf"_({'|'.join(UNITS)})$", "", name) for name in plain]
    for seconds, rest in HALVES:
        for i, j in itertools.permutations(range(len(plain)), 2):
            if plain[i].endswith(seconds) and plain[j] == plain[i][: -len(seconds)] + rest:
                return (i, j), 1
    for clock in CLOCKS:
        for i, name in enumerate(bare):
            if name == clock or (clock == "header_stamp" and name.endswith(clock)):
                return (i,), unit_in(names[i])
    return None


def unit_in(name: str) -> int | None:
    """How many of the units that the name of a time states are a second; None where it states none."""
    if stated := re.search(r"[\[(_ ]\s*(s|sec|ms|us|ns|nsec)\s*[\])]?$", name.lower()):
        return UNITS[stated[1]]
    return 10**9 if plain_name(name) in RECORDED else None


def places_of(names: Sequence[str], spellings: Sequence[Sequence[str]]) -> tuple[int, ...] | None:
    """Places of columns, the first one there of the spellings of each; a longer name may end in one of two words."""
    plain = [plain_name(name) for name in names]
    found = []
    for each in spellings:
        there = [plain.index(name) for name in each if name in plain]
        there += [i for i, name in enumerate(plain) for end in each if "_" in end and name.endswith(f"_{end}")]
        if not there:
            return None
        found.append(there[0])
    return tuple(found)


def _rest(plain: list[str]) -> tuple[int, ...]:
    """Places of a velocity, and of both biases where they are there."""
    found = []
    for spellings in MOVING:
        there = ([spelling.format(axis) for axis in "xyz"] for spelling in spellings)
        places = [tuple(map(plain.index, names)) for names in there if all(plain.count(name) == 1 for name in names)]
        found.append(next(iter(places), ()))
    if all(found):
        return (*found[0], *found[1], *found[2])
    return found[0]


def numbered(name: str) -> bool:
    """Whether a column has a number of a covariance, and not the names of two components."""
    return any(pattern.fullmatch(name.lower()) for pattern in (NUMBERED, BY_INDEX))


def _covariance(plain: list[str], rest: int) -> tuple[int, ...]:
    """Places of the columns of a covariance of a pose and ``rest`` more, or of the pose alone; none without one."""
    for labels, prefix in itertools.product(_labels(rest), PREFIXES):
        if found := _places(plain, _pairs(prefix, labels, len(labels))):
            return found
    blocks = [_places(plain, _pairs(prefix, APART[prefix], 3)) for prefix in ("q", "p")]
    if all(blocks):
        return (*blocks[0], *blocks[1])
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
        if set(names := [spelling.format(label) for label in labels]) <= set(plain):
            return tuple(plain.index(name) for name in names)
    return ()


def _numbered(plain: list[str], pattern: re.Pattern[str], sizes: Sequence[int]) -> tuple[int, ...]:
    """Places of numbered columns of a covariance, as many as one of the ``sizes``; none without them."""
    stated: dict[str, dict[tuple[int, int], int]] = {}
    for i, name in enumerate(plain):
        if (number := pattern.fullmatch(name)) and "twist" not in number[1]:
            place = int(number[2]), int(number[3] or -1)
            stated.setdefault(number[1], {})[place] = i
    for places in stated.values():
        if len(places) in sizes:
            return tuple(places[key] for key in sorted(places))
    return ()


def _pairs(prefix: str, labels: Sequence[str], n: int = 6) -> Iterator[tuple[str, str]]:
    """Names of the entries of an upper triangle, each with that of its mirror image."""
    join = "_" if prefix.endswith("_") else ""
    for i, j in itertools.combinations_with_replacement(range(n), 2):
        yield f"{prefix}{labels[i]}{join}{labels[j]}", f"{prefix}{labels[j]}{join}{labels[i]}"


def _places(plain: list[str], pairs: Iterator[tuple[str, str]]) -> tuple[int, ...]:
    found = []
    for names in pairs:
        there = [plain.index(name) for name in names if name in plain]
        if not there:
            return ()
        found.append(there[0])
    return tuple(found)


# --- numbers -----------------------------------------------------------------------------------------


def require_units(names: Sequence[str], path: Path) -> None:
    """Refuse columns whose names state a unit that is not of the SI, such as ``heading [deg]``."""
    for name in names:
        if found := OTHER_UNITS.search(name):
            raise InputError(
                f"{path}: column '{name}' is in {found[1].strip()}; units are SI and radians: convert and rename it"
            )
