"""Solutions of RTKLIB as truth and as estimates, written as its manual describes them."""

import datetime as dt
from pathlib import Path

import numpy as np
import pytest
from command import consistency
from numpy.testing import assert_allclose, assert_array_equal
from recorded import notes_of
from test_layouts import STEPS, drive, lines, nees_of, tum

import consistency as cs
from consistency.referee.readers.formats.positions import axes_at, centred, leap_seconds, read_solution

START = dt.datetime(2024, 3, 5, 10, 0, 0)  # of GPS, 18 s ahead of UTC
EPOCH = 1709632800.0 - 18.0
PLACE = np.array([47.3977, 8.5456, 488.2])
HEADER = """% program   : RTKPOST ver.2.4.3
% pos mode  : kinematic
%
% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)
%  {clock}                  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m) age(s)  ratio
"""  # noqa: E501
LOCAL = """%  GPST              e-baseline(m)  n-baseline(m)  u-baseline(m)   Q  ns   sde(m)   sdn(m)   sdu(m)  sden(m)  sdnu(m)  sdue(m) age(s)  ratio
"""  # noqa: E501


def signed_root(value):
    return float(np.sign(value) * np.sqrt(abs(value)))


def stamps(clock="GPST", weeks=False):
    ahead = {"GPST": 0.0, "UTC": -18.0, "JST": 9 * 3600 - 18.0}[clock]
    times = [START + dt.timedelta(seconds=ahead + 0.25 * k) for k in range(STEPS)]
    if not weeks:
        return [f"{t:%Y/%m/%d %H:%M:%S}.{t.microsecond // 1000:03d}" for t in times]
    since = [(t - dt.datetime(1980, 1, 6)).total_seconds() for t in times]
    return [f"{int(s // 604800)} {s % 604800:.3f}" for s in since]


def solution(path, place, P, clock="GPST", weeks=False):
    """Geodetic places (N, 3) with covariances (N, 3, 3) of east, north, up."""
    rows = []
    for when, (latitude, longitude, height), C in zip(stamps(clock, weeks), place, P, strict=True):
        stated = [C[1, 1], C[0, 0], C[2, 2], C[0, 1], C[0, 2], C[1, 2]]
        roots = " ".join(repr(signed_root(value)) for value in stated)
        rows.append(f"{when} {float(latitude)!r} {float(longitude)!r} {float(height)!r}   1  9 {roots} 0.00 12.3")
    Path(path).write_text(HEADER.format(clock=clock) + "\n".join(rows) + "\n", encoding="utf-8")
    return path


def flight():
    """Places (N, 3) some hundred metres apart, and covariances (N, 3, 3) with cross terms of both signs."""
    rng = np.random.default_rng()
    place = PLACE + np.column_stack([rng.normal(size=(STEPS, 2)) * 1e-3, 20 * rng.normal(size=STEPS)])
    root = 0.05 * rng.normal(size=(STEPS, 3, 3))
    return place, root @ np.swapaxes(root, 1, 2) + 1e-4 * np.eye(3)


def plane(place, origin):
    """East, north, up (N, 3) from an origin, by closed formulas of WGS 84 written out again."""
    a, b = 6378137.0, 6356752.314245179
    out = []
    for latitude, longitude, h in np.vstack([origin, place]):
        p, q = np.radians([latitude, longitude])
        n = a * a / np.sqrt((a * np.cos(p)) ** 2 + (b * np.sin(p)) ** 2)
        out.append(
            [(n + h) * np.cos(p) * np.cos(q), (n + h) * np.cos(p) * np.sin(q), (n * b * b / a / a + h) * np.sin(p)]
        )
    d = np.array(out[1:]) - out[0]
    p, q = np.radians(origin[:2])
    east = np.array([-np.sin(q), np.cos(q), 0.0])
    up = np.array([np.cos(p) * np.cos(q), np.cos(p) * np.sin(q), np.sin(p)])
    return np.column_stack([d @ east, d @ np.cross(up, east), d @ up])


def test_the_ellipsoid():
    """At the equator, at a pole, and orthonormal axes; a closed path in the plane is closed."""
    assert_allclose(centred(np.array([0.0, 90.0, 10.0])), [0.0, 6378147.0, 0.0], atol=1e-6)
    assert_allclose(centred(np.array([90.0, 12.0, 10.0]))[2], 6356752.314245 + 10.0, atol=1e-5)
    turn = axes_at(PLACE)
    assert_allclose(turn @ turn.T, np.eye(3), atol=1e-15)
    assert_allclose(np.cross(turn[0], turn[1]), turn[2], atol=1e-15)


@pytest.mark.parametrize("clock, weeks", [("GPST", False), ("GPST", True), ("UTC", False), ("JST", False)])
def test_times_are_utc(clock, weeks, tmp_path):
    place, P = flight()
    read = read_solution(Path(solution(str(tmp_path / "rover.pos"), place, P, clock, weeks)))
    assert_allclose(read.t, EPOCH + 0.25 * np.arange(STEPS), atol=1e-6)
    assert_array_equal(read.values[:, 1:4], place)
    assert_allclose(read.values[:, 4:].reshape(-1, 3, 3), P, rtol=1e-12)
    assert "18 leap seconds less" in read.note if clock == "GPST" else f"times of {clock} as UTC" in read.note
    assert read.note.endswith(f"{STEPS} fixed")


def test_leap_seconds():
    """IERS: 0 in 1980, 13 in 2000, 17 up to the end of 2016, 18 since."""
    at = [dt.datetime(1980, 6, 1), dt.datetime(2000, 1, 1), dt.datetime(2016, 12, 31), dt.datetime(2017, 1, 2)]
    assert [leap_seconds((day - dt.datetime(1970, 1, 1)).total_seconds()) for day in at] == [0, 13, 17, 18]
    new_year = (dt.datetime(2017, 1, 1) - dt.datetime(1970, 1, 1)).total_seconds()
    assert [leap_seconds(new_year + s) for s in (17.5, 18.0)] == [17, 18]


def test_a_solution_against_a_solution(inside, capsys):
    """Both in the plane of the first true place; a covariance is turned from its own place into it."""
    place, P = flight()
    off = place + np.random.default_rng().normal(size=place.shape) * [5e-7, 5e-7, 0.05]
    estimates, truth = solution("rover.pos", off, P), solution("base.pos", place, 1e-6 * P)
    record = cs.read(estimates, truth=truth)
    e = plane(place, place[0]) - plane(off, place[0])
    turn = axes_at(place[0]) @ np.swapaxes(axes_at(off), 1, 2)
    expected = nees_of(e, turn @ P @ np.swapaxes(turn, 1, 2))
    assert_allclose(record.errors.nees[0], expected, rtol=1e-6)  # places of 6e6 m hold errors of 0.05 m to 1e-8
    _, err = consistency(capsys, "analyse", estimates, "--truth", truth)
    assert (
        "rover.pos: read as a solution of RTKLIB, 15 columns, times of GPS as UTC, 18 leap seconds less; 12 fixed"
        in err
    )
    assert "base.pos: x is east, y north, z up from its first place" in err


@pytest.mark.parametrize("name", ["Q", "ns", "ratio", "age"])
def test_columns_of_a_solution_make_groups(name, inside):
    place, P = flight()
    rover, base = (
        Path(solution("rover.pos", place + np.array([1e-7, 1e-7, 0.01]), P)),
        solution("base.pos", place, 1e-6 * P),
    )
    lines = rover.read_text().splitlines()
    head = next(k for k, line in enumerate(lines) if line.startswith("%  GPST"))
    names = lines[head][1:].split()
    column = next(k for k, word in enumerate(names) if word.partition("(")[0] == name) + 1  # a time is two
    values = []
    for k in range(head + 1, len(lines)):
        cells = lines[k].split()
        values.append(1 + k % 2)
        cells[column] = str(values[-1])
        lines[k] = " ".join(cells)
    rover.write_text("\n".join(lines) + "\n")
    record = cs.read(rover, truth=base, by=name)
    assert record.runs.by[0].tolist() == values
    assert record.groups.names == (f"{name} <= 1", f"{name} > 1")
    with pytest.raises(cs.InputError, match=r"by=q: .*rover\.pos has no such column; there are: Q, ns, sdn, .*ratio"):
        cs.read(rover, truth=base, by="q")


def test_a_solution_as_the_truth_of_poses(inside):
    """The position of the estimate in the same plane; where it is in another world a note names the remedy."""
    place, P = flight()
    d = drive(start=EPOCH)
    d.own[:, :3] = plane(place, place[0]) - (d.true - d.own)[:, :3]
    record = cs.read(tum(d), truth=solution("rtk.pos", place, P))
    e = plane(place, place[0]) - d.own[:, :3]
    assert_allclose(record.errors.nees[0], nees_of(e, d.P[:, :3, :3]), rtol=1e-6)
    assert "add --align posyaw-all where est.tum is in another world" in notes_of(record)


def test_the_truth_of_a_solution_has_a_covariance(inside):
    """As it is beside fixes and beside poses, turned into the plane; it counts as 0 unless it is asked for."""
    place, P = flight()
    turn = axes_at(place[0]) @ np.swapaxes(axes_at(place), 1, 2)
    stated = turn @ (0.1 * P) @ np.swapaxes(turn, 1, 2)
    truth, d = solution("rtk.pos", place, 0.1 * P), drive(start=EPOCH)
    d.own[:, :3] = plane(place, place[0])
    for estimates in (solution("rover.pos", place + np.array([1e-7, 1e-7, 0.01]), P), tum(d)):
        record = cs.read(estimates, truth=truth, truth_covariance="columns")
        assert_allclose(record.truth.covariance[0], stated, rtol=1e-6, atol=1e-12)
        without = cs.read(estimates, truth=truth)
        assert without.truth.covariance is None
        said = "rtk.pos: the truth states a covariance of its own, which counts as 0; see --truth-covariance columns"
        assert said in without.origin.notes
        assert said not in record.origin.notes


def test_a_baseline_is_local_already(inside):
    rng = np.random.default_rng()
    _, P = flight()
    true = 30 * rng.normal(size=(STEPS, 3))
    own = true + 0.05 * rng.normal(size=(STEPS, 3))
    rows = []
    for when, point, C in zip(stamps(), own, P, strict=True):
        stated = [C[0, 0], C[1, 1], C[2, 2], C[0, 1], C[1, 2], C[2, 0]]
        rows.append(
            " ".join(
                [when, *(repr(float(v)) for v in point), "2", "7", *(repr(signed_root(v)) for v in stated), "0", "0"]
            )
        )
    Path("enu.pos").write_text(LOCAL + "\n".join(rows))
    truth = lines("truth.txt", "", [EPOCH + 0.25 * np.arange(STEPS), *true.T], " ")
    record = cs.read("enu.pos", truth=truth)
    assert_allclose(record.errors.nees[0], nees_of(true - own, P), rtol=1e-9)
    assert any(note.endswith("12 float") for note in record.origin.notes)


def centred_solution(path, place, P):
    """The same fixes from the centre of the earth, with covariances of x, y, z."""
    header = HEADER.format(clock="GPST")
    for old, new in zip(("latitude(deg)", "longitude(deg)", "height(m)"), "xyz", strict=True):
        header = header.replace(old, f"{new}-ecef(m)")
    for old, new in (("sdn(m)", "sdx(m)"), ("sde(m)", "sdy(m)"), ("sdu(m)", "sdz(m)"), ("sdne", "sdxy"),
                     ("sdeu", "sdyz"), ("sdun", "sdzx")):  # fmt: skip
        header = header.replace(old, new)
    rows = []
    for when, at, C in zip(stamps(), place, P, strict=True):
        turn = axes_at(at)
        C = turn.T @ C @ turn
        roots = [signed_root(v) for v in (C[0, 0], C[1, 1], C[2, 2], C[0, 1], C[1, 2], C[2, 0])]
        numbers = [*map(repr, map(float, centred(at))), "1", "9", *map(repr, roots), "0.00", "12.3"]
        rows.append(" ".join([when, *numbers]))
    Path(path).write_text(header + "\n".join(rows) + "\n", encoding="utf-8")
    return path


def sexagesimal_solution(path, place, P):
    """The same fixes in degrees, minutes and seconds."""
    text = Path(solution(path, place, P)).read_text(encoding="utf-8")
    text = text.replace("(deg)", "(d'\")")
    for value in {float(v) for v in place[:, :2].ravel()}:
        minutes, seconds = divmod(abs(value) * 3600.0, 60.0)
        degrees, minutes = divmod(minutes, 60.0)
        text = text.replace(f" {value!r} ", f" {'-' * (value < 0)}{degrees:.0f} {minutes:02.0f} {seconds:.14f} ")
    Path(path).write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("write", [centred_solution, sexagesimal_solution])
@pytest.mark.parametrize("corner", [PLACE, [-33.5, -0.2, 12.0], [-0.3, 179.9, -20.0], [89.9, -120.0, 5.0]])
def test_other_forms_of_a_place(write, corner, inside):
    assert callable(write)
    place, P = flight()
    place = place - PLACE + np.asarray(corner)
    plain, other = read_solution(Path(solution("a.pos", place, P))), read_solution(Path(write("b.pos", place, P)))
    here, there = plain.local(), other.local(plain.values[0, 1:4])
    assert_allclose(there[0], here[0], atol=2e-8)  # 6e6 m in a double, and degrees of 14 digits
    assert_allclose(there[1], here[1], rtol=1e-7, atol=1e-12)
    assert_array_equal(other.t, plain.t)
    record = cs.read("b.pos", truth=solution("truth.pos", place + np.array([1e-7, 2e-7, 0.05]), 1e-6 * P))
    same = cs.read("a.pos", truth="truth.pos")
    assert_allclose(record.errors.nees, same.errors.nees, rtol=1e-4)


def test_an_angle_that_is_none(tmp_path):
    place, P = flight()
    path = Path(sexagesimal_solution(str(tmp_path / "rover.pos"), place, P))
    lines_of = path.read_text(encoding="utf-8").splitlines()
    fields = lines_of[5].split()
    fields[3] = "61"
    path.write_text("\n".join([*lines_of[:5], " ".join(fields), *lines_of[6:]]), encoding="utf-8")
    with pytest.raises(cs.InputError, match=r"rover\.pos, line 6: '47 61 .*' is not an angle of degrees, minutes and"):
        read_solution(path)


@pytest.mark.parametrize(
    "old, new, said",
    [
        ("latitude(deg)", "latitude(gon)", r"rover\.pos: holds none of latitude\(deg\).*out-solformat =llh, =xyz or"),
        ("sdeu(m)", "other(m)", r"rover\.pos: column 'sdeu\(m\)' is missing"),
        ("GPST", "LOCAL", r"rover\.pos, line 6: stands under no header"),
        ("2024/03/05 10:00:00.250", "2024/13/05 10:00:00.250", r"rover\.pos, line 7: .* is not a date and time"),
        ("2024/03/05 10:00:00.250", "2024/03/05 10:00:00.000", r"rover\.pos, line 7: timestamp .* is duplicated"),
        (" 12.3\n", " 12.3 1\n", r"rover\.pos, line 6: has 16 fields; its header names a time of two and 13 more"),
        ("   1  9 ", "   x  9 ", r"rover\.pos, line 6: a field is not a number"),
    ],
)
def test_what_is_broken_is_one_line(old, new, said, inside):
    place, P = flight()
    solution("truth.pos", place, P)
    text = Path(solution("rover.pos", place, P)).read_text()
    assert old in text
    Path("rover.pos").write_text(text.replace(old, new))
    with pytest.raises(cs.InputError, match=said):
        cs.read("rover.pos", truth="truth.pos")


@pytest.mark.parametrize(
    "options, said",
    [
        ({"lever_arm": [0.0, 0.0, 1.0]}, r"lever_arm: does not go with rover\.pos, of positions with their own"),
        ({"error": "left"}, r"error: does not go with rover\.pos"),
        ({"relative": 2, "motions": True}, r"relative: needs a truth with orientations"),
    ],
)
def test_options_of_orientations_are_refused(options, said, inside):
    place, P = flight()
    solution("truth.pos", place, P)
    with pytest.raises(cs.InputError, match=said):
        cs.read(solution("rover.pos", place, P), truth="truth.pos", **options)  # type: ignore[arg-type]
