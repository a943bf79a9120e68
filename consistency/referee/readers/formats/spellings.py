"""Names that columns have in files: every spelling that is known, and the units and clocks that names tell of.

A spelling that is missing is added here. Names of the user's own (``--columns``) are put in place of a file's.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from consistency.referee.errors import InputError
from consistency.referee.readers.places import listed

# --- spellings ---------------------------------------------------------------------------------------

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


Columns = Mapping[str, str]  # names of columns here, and those in a file


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
