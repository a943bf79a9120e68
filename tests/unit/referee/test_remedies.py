"""What is said of odd files that a newcomer may have, beside those of test_layouts and test_wrong_inputs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_layouts import lines

import consistency as cs
from consistency.referee.readers.formats.named_columns import fields_of, require_units
from consistency.referee.readers.formats.sheet import TableRows
from consistency.referee.readers.matching import unit_apart

T = 100.0 + 0.1 * np.arange(60)
P = np.array([[0.04, 0.01, 0.005], [0.01, 0.09, -0.01], [0.005, -0.01, 0.01]])


@pytest.mark.parametrize(
    ("unit", "name"), [(10**3, "milliseconds"), (10**6, "microseconds"), (10**9, "nanoseconds"), (1, "")]
)
def test_the_unit_that_makes_times_overlap_is_named(unit: int, name: str) -> None:
    for longer in (T, np.arange(600.0)):  # a truth may begin earlier and end later
        said = [unit_apart(unit * T, longer, ("a", "b")), unit_apart(longer, unit * T, ("b", "a"))]
        assert said == [f"; a seems to be in {name}, and has to be in seconds" if name else ""] * 2
    assert not unit_apart(T, T + 5000.0, ("a", "b"))
    assert "; b seems to be in nanoseconds" in unit_apart(T, 1.7e18 + T, ("a", "b"))  # of 1970


@pytest.mark.parametrize("heading", ["heading", "theta"])
def test_a_lower_triangle_is_a_covariance(heading: str, inside: Path) -> None:
    e = np.random.default_rng().normal(size=(len(T), 3)) * [0.2, 0.3, 0.1]
    places = [(0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)]
    names = ",".join(f"P_{'xyh'[i]}{'xyh'[j]}" for i, j in places)
    lines("est.csv", f"t,x,y,{heading},{names}", [T, *-e.T, *(np.full(len(T), P[i, j]) for i, j in places)])
    lines("truth.csv", f"t,x,y,{heading}", [T, *np.zeros((3, len(T)))])
    record = cs.read("est.csv", truth="truth.csv")
    np.testing.assert_allclose(record.nees[0], np.einsum("ti,ti->t", e, np.linalg.solve(P, e.T).T), rtol=1e-9)
    assert not record.parts


@pytest.mark.parametrize(
    ("name", "header", "rows", "said"),
    [
        (
            "o.csv",
            "t,v [m/s],omega [deg/s]",
            "0,1,2\n1,1,2\n",
            r"o\.csv: column 'omega \[deg/s\]' is in deg/s; units are",
        ),
        ("o.csv", "t x y heading P_xx", "0 1 2 3 4\n", r"there are: t x y heading P_xx; separate columns by commas"),
        (
            "o.csv",
            "t;x;y;heading",
            "0,5;1;2;3\n",
            r"o\.csv, line 2: column 't': not a number with a decimal point",
        ),
        ("o.txt.gz", "", "", r"o\.txt\.gz: unknown kind of file; .*; unpack it$"),
        ("f.ulg", "", "", r"f\.ulg: unknown kind of file; .*; flight logs are for 'consistency monitor'$"),
        (
            "d/0.csv",
            "t,x,y,heading",
            "0,1,2,3\n",
            r"d: holds no \.txt .*; tables of several runs go into one file with a",
        ),
    ],
)
def test_a_refusal_names_the_remedy(name: str, header: str, rows: str, said: str, inside: Path) -> None:
    Path("d").mkdir()
    Path(name).write_text(f"{header}\n{rows}")
    lines("truth.csv", "t,x,y,heading", [T, T, T, T])
    with pytest.raises(cs.InputError, match=said):
        cs.read(name.split("/")[0], truth="truth.csv")


def test_units_of_the_si_and_other_words_are_let_pass() -> None:
    require_units(["t [ns]", "v (m/s)", "omega[rad/s]", "P_xx [m^2]", "x [cmd]", "x (degraded)"], Path("o.csv"))
    for name in ("v (km/h)", "P_hh [deg^2]", "yaw [ ° ]", "pitch (degrees)", "z [CM]"):
        with pytest.raises(cs.InputError, match=r"o\.csv: column .* units are SI and radians"):
            require_units([name], Path("o.csv"))


def test_a_list_in_a_cell() -> None:
    cells = np.empty(1, object)
    cells[0] = [0.01, 0.0]
    with pytest.raises(
        cs.InputError, match=r"row 0: column 'P': a list, of which each number needs a column of its own"
    ):
        TableRows(Path("e.parquet"), {"P": cells}, np.arange(1), "row").numbers("P")
    assert fields_of('t, "[0.01, 0.0]","x"') == ["t", "[0.01, 0.0]", "x"]
    assert fields_of('"t" "x"') == ["t", "x"]


def test_a_solution_of_positions_is_called_so(inside: Path) -> None:
    head = "%  UTC latitude(deg) longitude(deg) height(m) Q sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m)\n"
    rows = (f"2023/11/14 22:13:2{k}.000 47.4 8.5 488.0 1 0.1 0.1 0.2 0 0 0\n" for k in range(3))
    Path("a.pos").write_text(head + "".join(rows))
    record = cs.read("a.pos", truth="a.pos")
    assert not any("OpenVINS" in note for note in record.notes)
    assert any(note.endswith("the default of this layout, positions alone") for note in record.notes)
