"""Positions as GNSS receivers and total stations give them: a truth of positions alone, and the ellipsoid."""

from __future__ import annotations

import datetime as dt
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.errors import InputError
from consistency.referee.geometry import matrices, propagated, to_left
from consistency.referee.readers.alignment import skew
from consistency.referee.readers.formats.text_blocks import LineParser, Lines, increasing, parsed
from consistency.referee.readers.options import Reading, flag_of
from consistency.referee.readers.runs_to_record import symmetric
from consistency.referee.readers.truth_matching import AXES, Poses, finite_rows, make_poses
from consistency.referee.types import Array

SAME = 1e-9  # of quaternions
FEWEST = 3  # estimates of a run
TURNED = 0.5  # rad: a turn that is not an error of a constant orientation
BEYOND = 10.0  # sigma, likewise
WINDING = 0.01  # 1 less the mean direction of a path
ALIGNED = 0.25  # the part of it that is left in the body's axes
A = 6378137.0  # m, semi-major axis of WGS 84 (NIMA TR8350.2, table 3.1)
F = 1.0 / 298.257223563  # its flattening
E2 = F * (2.0 - F)
GPS = dt.datetime(1980, 1, 6)  # begin of its weeks
UNIX = dt.datetime(1970, 1, 1)
LEAPS = (  # days from which GPS time is one second more ahead of UTC (IERS, Bulletin C)
    "1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01", "1991-01-01", "1992-07-01",
    "1993-07-01", "1994-07-01", "1996-01-01", "1997-07-01", "1999-01-01", "2006-01-01", "2009-01-01", "2012-07-01",
    "2015-07-01", "2017-01-01",
)  # fmt: skip
AHEAD = {"GPST": 0.0, "UTC": 0.0, "JST": 9 * 3600.0}  # s of the clocks of RTKLIB before UTC, leap seconds aside
GEODETIC = ("latitude(deg)", "longitude(deg)", "height(m)")
SEXAGESIMAL = ("latitude(d'\")", "longitude(d'\")", "height(m)")  # degrees, minutes and seconds apart
ANGLES = SEXAGESIMAL[:2]
CENTRED = ("x-ecef(m)", "y-ecef(m)", "z-ecef(m)")
BASELINE = ("e-baseline(m)", "n-baseline(m)", "u-baseline(m)")
STATED = {
    GEODETIC: "sdn sde sdu sdne sdeu sdun",
    SEXAGESIMAL: "sdn sde sdu sdne sdeu sdun",
    CENTRED: "sdx sdy sdz sdxy sdyz sdzx",
    BASELINE: "sde sdn sdu sden sdnu sdue",
}  # deviations, and the roots of cross terms
AXIS_OF_LETTER = {"e": 0, "n": 1, "u": 2, "x": 0, "y": 1, "z": 2}
QUALITY = {1: "fixed", 2: "float", 3: "SBAS", 4: "DGPS", 5: "single", 6: "PPP"}


def require_positions(path: Path, poses: Sequence[Poses], r: Reading) -> None:
    """Refuse what does not go with a truth of positions alone.

    Raises
    ------
    InputError
        Some runs have a truth with orientations, or an option needs one.
    """
    alone = f"{poses[0].source.files[1]} holds positions alone"
    if any(one.manifold != "vector" for one in poses):
        raise InputError(f"{path}: the truth of some runs has orientations, of others none; judge them apart")
    if r.runs.relative is not None:
        raise InputError(f"--relative: needs a truth with orientations; {alone}")
    if r.matching.align not in (None, "posyaw", "posyaw-all"):
        raise InputError(f"--align {r.matching.align}: needs a truth with orientations; {alone}")
    for axis in r.components.axes or ():
        if axis not in AXES[:3]:
            raise InputError(f"--axes {','.join(r.components.axes or ())}: '{axis}' has no truth; {alone}")


def position_note(truth: Path | str, lever_arm: Sequence[float] | None) -> str:
    """A note on the point of the body that is judged."""
    at = "the origin of the body; --lever-arm x,y,z names another point"
    if lever_arm is not None:
        at = f"the point ({', '.join(f'{each:g}' for each in lever_arm)}) m of the body"
    return f"{truth}: the truth has no orientation, so that the position alone is judged, of {at}"


def point_positions(poses: Poses, lever: Sequence[float] | None, blocks: bool) -> Poses:
    """Estimated positions p + R l of a point of the body beside its true ones, with their covariances to first order.

    Parameters
    ----------
    poses : estimates in space; their truth (M, 3 or more) begins with the position
    lever : (3,), m, from the origin of the body to the point, in the axes of the body; None for the origin
    blocks : position and rotation are stated apart, or as deviations, so that their cross-covariance is not known

    Raises
    ------
    InputError
        The covariance of the point depends on cross terms that are not stated.
    """
    arm = np.zeros(3) if lever is None else np.asarray(lever, float)
    if blocks and (arm.any() or poses.convention == "right"):
        option = "--lever-arm" if arm.any() else "--error right"
        what = "moves errors of the rotation into that of the position, whose cross terms are not stated"
        raise InputError(f"{poses.own.place[0]}: {option} {what}; give covariances of whole poses")
    T = np.full((len(poses.own.t), 4, 4), np.nan)
    finite = finite_rows(poses.own.estimate)
    T[finite] = matrices(poses.own.estimate[finite, :7])
    point = poses.own.estimate[:, :3] + T[:, :3, :3] @ arm
    of_truth = poses.true.covariance
    if of_truth is not None:
        of_truth = of_truth[:, :3, :3]
    J = _jacobian(poses.convention, T, arm)
    return poses.with_values(
        estimate=point,
        covariance=propagated(J, poses.own.covariance),
        truth=poses.true.values[:, :3],
        manifold="vector",
        convention="vector",
        cross=None,
        true_covariance=of_truth,
    )


def placeholder(poses: Sequence[Poses]) -> tuple[bool, str]:
    """Whether a truth has one orientation in place of none, and a note where it may have.

    It is the same in every row of every run, while the estimates turn by more than their covariance allows. They turn
    with the path where the direction of a run's true way is the same in the axes of the estimated body.

    Parameters
    ----------
    poses : runs in space
    """
    quaternions = np.concatenate([one.true.values[:, 3:7] for one in poses])
    if (np.abs(np.abs(quaternions @ quaternions[0]) - 1.0) > SAME).any():
        return False, ""
    turns = [turn for one in poses if (turn := _turning(one)) is not None]
    if not turns or np.median([turn[0] for turn in turns]) < TURNED:
        return False, ""
    angle, *lengths = np.transpose(turns)
    text = "the truth has the same orientation in every row, while the estimates turn by"
    text = f"{text} {np.rad2deg(np.median(angle)):.0f} degrees"
    way, body = map(_winding, lengths)
    if way > WINDING and body < ALIGNED * way:
        return True, f"{text} with the path: it is read as positions alone"
    return False, f"{text}; if it is a placeholder, give a truth of t x y z, or judge --axes x,y,z"


def _winding(lengths: Array) -> float:
    """1 - the mean length of mean directions; 0 where nothing moves."""
    known = lengths[np.isfinite(lengths)]
    return 1.0 - float(known.mean()) if len(known) else 0.0


def _turning(one: Poses) -> tuple[float, float, float] | None:
    """By how much the estimates of a run turn beyond their covariance, rad; lengths of two mean directions.

    They are of the true way in the world and in the axes of the estimated body, NaN where it stands still. None where
    too few rows have a truth.
    """
    known = one.known()
    finite = finite_rows(one.own.estimate[known.rows])
    rows = known.rows[finite]
    true = known.truth[finite, :3]
    if len(rows) < FEWEST:
        return None
    R = Rotation.from_quat(one.own.estimate[rows, 3:7])
    variance = np.trace(one.own.covariance[rows, 3:6, 3:6], axis1=1, axis2=2)
    sigma = np.sqrt(np.abs(variance))
    turned = (R[0].inv() * R).magnitude()
    turn = float(np.max(np.where(turned > BEYOND * sigma, turned, 0.0)))
    way = np.diff(true, axis=0)
    size = np.linalg.norm(way, axis=1)
    moving = size > 0.1 * np.median(size)
    if not moving.any():
        return turn, np.nan, np.nan
    way = way[moving] / size[moving, None]
    in_body = R[:-1][moving].inv().apply(way)
    of_way = float(np.linalg.norm(way.mean(axis=0)))
    return turn, of_way, float(np.linalg.norm(in_body.mean(axis=0)))


def fixed(own: Fixes, true: Lines, r: Reading, of_truth: Array | None = None) -> Poses:
    """Estimated positions without orientations beside the true ones, in one plane.

    Parameters
    ----------
    of_truth : (M, 3 or more, 3 or more), covariance of the truth, which begins with the position

    Raises
    ------
    InputError
        An option needs orientations, or the covariance from elsewhere.
    """
    if given := r.given(("covariance", "covariance_order", "error", "lever_arm")):
        raise InputError(f"{flag_of(given[0])}: does not go with {own.path}, of positions with their own covariances")
    if of_truth is not None:
        of_truth = of_truth[:, :3, :3]
    P = symmetric(own.covariances, own.place)
    return make_poses(
        place=own.places,
        t=own.t,
        estimate=own.values[:, 1:4],
        covariance=P,
        stated=np.ones(len(P), bool),
        true_t=true.t,
        truth=true.values[:, 1:4],
        manifold="vector",
        convention="vector",
        max_dt=r.matching.tolerance,
        true_covariance=of_truth,
    )


def _jacobian(convention: str, T: Array, arm: Array) -> Array:
    """Error of the point by the error of the pose, (N, 3, 6): R (rho - arm x phi) by its left error (rho, phi)."""
    R = T[:, :3, :3]
    by_left = np.concatenate([R, -R @ skew(arm)], axis=-1)
    return np.asarray(by_left @ to_left(T, convention))


@dataclass(frozen=True)
class Fixes(Lines):
    """Positions with covariances: t, s since 1970 in UTC, three numbers of the place, and 9 of the covariance.

    The place is latitude and longitude, degrees, and height, m, with ``geodetic``; else east, north, up, m. The
    covariance is that of east, north and up there, m^2.
    """

    geodetic: bool = True
    alone: bool = False  # deviations are stated without cross terms

    @property
    def covariances(self) -> Array:
        """(N, 3, 3)."""
        return self.values[:, 4:].reshape(-1, 3, 3)

    def local(self, origin: Array | None = None) -> tuple[Array, Array]:
        """Positions (N, 3) and covariances (N, 3, 3) in the plane that touches the ellipsoid in ``origin``."""
        place = self.values[:, 1:4]
        if not self.geodetic:
            return place, self.covariances
        start = place[0] if origin is None else origin
        turn = axes_at(start)
        between = turn @ np.swapaxes(axes_at(place), -1, -2)
        return (centred(place) - centred(start)) @ turn.T, _turned(between, self.covariances)


def centred(place: Array) -> Array:
    """Latitude, longitude, degrees, and height, m, (..., 3), to x, y, z from the centre of the earth, m."""
    latitude, longitude, height = np.moveaxis(np.asarray(place, float), -1, 0)
    phi = np.deg2rad(latitude)
    lam = np.deg2rad(longitude)
    N = A / np.sqrt(1.0 - E2 * np.sin(phi) ** 2)
    out = (N + height) * np.cos(phi)
    z = (N * (1.0 - E2) + height) * np.sin(phi)
    return np.stack([out * np.cos(lam), out * np.sin(lam), z], axis=-1)


def geodetic(point: Array) -> Array:
    """Latitude, longitude, degrees, and height, m, (..., 3), of x, y, z from the centre of the earth, m.

    The latitude is the fixed point of tan phi = (z + e^2 N sin phi) / p, which each round brings e^2 nearer.
    """
    x, y, z = np.moveaxis(np.asarray(point, float), -1, 0)
    p = np.hypot(x, y)
    phi = np.arctan2(z, (1.0 - E2) * np.hypot(x, y))
    for _ in range(8):
        s = np.sin(phi)
        phi = np.arctan2(z + E2 * A * s / np.sqrt(1.0 - E2 * s**2), p)
    s = np.sin(phi)
    height = p * np.cos(phi) + z * s - A * np.sqrt(1.0 - E2 * s**2)
    lam = np.arctan2(y, x)
    return np.stack([np.rad2deg(phi), np.rad2deg(lam), height], axis=-1)


def axes_at(place: Array) -> Array:
    """Rows east, north, up (..., 3, 3) of a place, as directions from the centre of the earth."""
    latitude, longitude, _ = np.moveaxis(np.deg2rad(np.asarray(place, float)), -1, 0)
    s = np.sin(latitude)
    c = np.cos(latitude)
    sl = np.sin(longitude)
    cl = np.cos(longitude)
    zero = np.zeros_like(latitude)
    east = np.stack([-sl, cl, zero], axis=-1)
    north = np.stack([-s * cl, -s * sl, c], axis=-1)
    up = np.stack([c * cl, c * sl, s], axis=-1)
    return np.stack([east, north, up], axis=-2)


def _turned(R: Array, P: Array) -> Array:
    return np.asarray(R @ P @ np.swapaxes(R, -1, -2))


def localised(own: Lines, true: Lines) -> tuple[Lines, Lines, str]:
    """Fixes among estimates and truth as positions in one plane, and a note on it; all else as it is.

    The plane touches the ellipsoid in the first place of the truth, or of the estimates where the truth has none.
    """
    fixes = [each for each in (true, own) if isinstance(each, Fixes) and each.geodetic]
    if not fixes:
        return own, true, ""
    origin = fixes[0].values[0, 1:4]
    at = f"{origin[0]:.7f}, {origin[1]:.7f} degrees, {origin[2]:.2f} m"
    note = f"{fixes[0].path}: x is east, y north, z up from its first place, {at} above the ellipsoid"
    if len(fixes) == 1:
        other = own if fixes[0] is true else true
        note += f"; add --align posyaw-all where {other.path} is in another world, turned about z or of another height"
    return _plain(own, origin), _plain(true, origin), note


def _plain(lines: Lines, origin: Array) -> Lines:
    if not isinstance(lines, Fixes):
        return lines
    place, P = lines.local(origin)
    values = np.column_stack([lines.t, place, P.reshape(-1, 9)])
    return replace(lines, values=values, geodetic=False)


# --- RTKLIB ------------------------------------------------------------------------------------------


def read_solution(path: Path) -> Fixes:
    """A solution of RTKLIB: latitude, longitude, height; x, y, z from the earth's centre; or east, north, up.

    Its deviations are in m. ``sdne`` and the like are the roots of cross terms with the sign of the cross term (RTKLIB
    manual 2.4.2, appendix B.1).

    Raises
    ------
    InputError
        The file has no header that names these columns, a row is broken, or times do not increase.
    """
    solution = _Solution(path)
    found = parsed(solution)
    if not found.parts:
        raise InputError(f"{path}: holds no solution")
    names = ["t", *solution.names]
    values = np.concatenate(found.parts)
    columns = dict(zip(names, values.T, strict=True))
    kind = next((each for each in STATED if set(each) <= set(names)), None)
    if kind is None:
        known = "; ".join(map(", ".join, (GEODETIC, CENTRED, BASELINE)))
        raise InputError(f"{path}: holds none of {known}; have RTKLIB write it with out-solformat =llh, =xyz or =enu")
    t = columns["t"]
    place = np.column_stack([columns[name] for name in kind])
    P = _covariance(path, columns, STATED[kind].split())
    if kind is CENTRED:
        place = geodetic(place)
        P = _turned(axes_at(place), P)
    qualities = "no Q"
    if "Q" in columns:
        counts = Counter(columns["Q"].astype(int).tolist())
        qualities = ", ".join(f"{count} {QUALITY.get(q, f'Q={q}')}" for q, count in sorted(counts.items()))
    read_as = f"read as a solution of RTKLIB, {len(names) + 1} columns, {_clock_note(solution.clock, t)}"
    note = f"{path}: {read_as}; {qualities}"
    values = np.column_stack([t, place, P.reshape(-1, 9)])
    named = {name.partition("(")[0]: columns[name] for name in solution.names if name not in kind}
    lines = Fixes(path, values, found.line, note, cut=found.cut, columns=named, geodetic=kind is not BASELINE)
    increasing(lines)
    return lines


class _Solution(LineParser):
    """A solution while it is read: its clock, and the names of its columns but the time."""

    clock = ""
    names: Sequence[str] = ()

    @property
    def width(self) -> int:
        """Fields of a row: the time has two, and an angle in degrees, minutes and seconds three."""
        return 2 + len(self.names) + 2 * sum(map(ANGLES.count, self.names))

    def is_whole(self, line: str, above: object) -> bool:
        return line.startswith("%") or len(line.replace(",", " ").split()) == self.width

    def part(self, rows: list[list[float]], numbers: list[int]) -> Array:
        return np.array(rows)

    def row(self, number: int, line: str) -> list[float] | None:
        """The time, and numbers under the names of the header."""
        where = f"{self.path}, line {number}"
        fields = line.replace(",", " ").split()
        if line.startswith("%"):
            words = line[1:].split()
            if words and words[0] in AHEAD:
                self.clock = words[0]
                self.names = words[1:]
            return None
        if not self.names:
            raise InputError(f"{where}: stands under no header '%  GPST  latitude(deg) ...'")
        if len(fields) != self.width:
            what = f"its header names a time of two and {self.width - 2} more"
            raise InputError(f"{where}: has {len(fields)} fields; {what}")
        try:
            values = list(map(float, fields[2:]))
        except ValueError:
            raise InputError(f"{where}: a field is not a number ({' '.join(fields[2:])[:60]})") from None
        row = [_time(where, fields[:2], self.clock)]
        for name in self.names:
            if name in ANGLES:
                of = fields[-len(values) :][:3]
                row.append(_degrees(f"{where}: '{' '.join(of)}'", *values[:3]))
                values = values[3:]
            else:
                row.append(values.pop(0))
        return row


def _degrees(which: str, whole: float, minutes: float, seconds: float) -> float:
    """Degrees of an angle; those of -0 degrees are negative."""
    if not (0 <= minutes < 60 and 0 <= seconds <= 60 and whole % 1 == 0):
        raise InputError(f"{which} is not an angle of degrees, minutes and seconds")
    return math.copysign(abs(whole) + minutes / 60.0 + seconds / 3600.0, whole)


def _time(where: str, fields: Sequence[str], clock: str) -> float:
    """Seconds since 1970 in UTC of a date and a time of day, or of a week and its second."""
    date, time = fields
    try:
        if "/" in date:
            hour, minute, seconds = time.split(":")
            year, month, day = map(int, date.split("/"))
            at = dt.datetime(year, month, day, int(hour), int(minute))
            second = float(seconds)
        else:
            at = GPS + dt.timedelta(weeks=int(date))
            second = float(time)
    except (ValueError, OverflowError):
        raise InputError(f"{where}: '{date} {time}' is not a date and time, and no GPS week") from None
    t = (at - UNIX).total_seconds() - AHEAD[clock] + second
    return t - leap_seconds(t) if clock == "GPST" else t


def leap_seconds(t: float) -> int:
    """Seconds that GPS time is ahead of UTC at a time in GPS time, s since 1970."""
    days = [(dt.datetime.fromisoformat(day) - UNIX).total_seconds() for day in LEAPS]
    return sum(t - k >= day for k, day in enumerate(days, 1))


def _clock_note(clock: str, t: Array) -> str:
    if clock != "GPST":
        return f"times of {clock} as UTC"
    count = 0
    while leap_seconds(t[0] + count) != count:
        count += 1
    return f"times of GPS as UTC, {count} leap seconds less"


def _covariance(path: Path, columns: dict[str, Array], stated: Sequence[str]) -> Array:
    """Covariances (N, 3, 3) of east, north, up, or of x, y, z, of deviations and signed roots of cross terms."""
    P = np.empty((len(next(iter(columns.values()))), 3, 3))
    for name in stated:
        if f"{name}(m)" not in columns:
            raise InputError(f"{path}: column '{name}(m)' is missing, of the deviations of the position")
        root = columns[f"{name}(m)"]
        i = AXIS_OF_LETTER[name[2]]
        j = AXIS_OF_LETTER[name[-1]]
        P[:, i, j] = P[:, j, i] = root * np.abs(root)
    return P
