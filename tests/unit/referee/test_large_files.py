"""Text files are read in blocks: the same as line by line, with the same refusals, in memory of the numbers alone."""

import tracemalloc
from contextlib import contextmanager
from unittest import mock

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_array_equal, assert_equal

from consistency.referee.diagnostics.whitening import FEWER as ROWS
from consistency.referee.errors import InputError
from consistency.referee.readers.formats import text_blocks
from consistency.referee.readers.formats.sheet import read_sheet
from consistency.referee.readers.formats.text_blocks import read_numbers
from consistency.referee.readers.runs_to_record import symmetric

LAYOUT = "t and two numbers"


@pytest.fixture(params=["by numpy", "by pyarrow"], autouse=True)
def reader_of_numbers(request, monkeypatch):
    """Numbers of a short file are read as those of a large one, too."""
    if request.param == "by pyarrow":
        monkeypatch.setattr(text_blocks, "LARGE", -1)


@contextmanager
def blocks_of(size):
    with mock.patch.object(text_blocks, "BLOCK", size):
        yield


def numbers_of(path, size):
    """Values and lines, or what is refused."""
    with blocks_of(size):
        try:
            lines = read_numbers(path, (3, 4), LAYOUT)
        except InputError as error:
            return str(error)
    return lines.values.tolist(), lines.line.tolist()


def line_by_line(text):
    """Values and lines as Python has them."""
    rows = enumerate(text.removeprefix("\ufeff").splitlines(), 1)
    rows = [(number, line) for number, line in rows if line.strip() and "#" not in line]
    values = np.array([list(map(float, line.replace(",", " ").split())) for _, line in rows])
    values[values > 1e30] = np.inf
    return values.tolist(), [number for number, _ in rows]


NUMBERS = {
    "plain": "1 2 3\n2 3 4\n3 4 5\n",
    "no end": "1 2 3\n2 3 4\n3 4 5",
    "windows": "1 2 3\r\n2 3 4\r\n3 4 5\r\n",
    "old mac": "1 2 3\r2 3 4\r3 4 5\r",
    "commas": "1, 2,3\n2,3 ,4\n3,4,5\n",
    "comments": "# t a b\n1 2 3\n\n  # more\n2 3 4\n   \n3 4 5\n\n",
    "marked": "\ufeff1 2 3\n2 3 4\n3 4 5\n",
    "separators": "1 2 3\x1c2 3 4\u20283 4 5\n",
    "not finite": "1 nan 3\n2 -inf 4\n3 1e40 Infinity\n",
    "grouped": "1 2_000 3\n2 3 4\n3 4 5\n",
    "digits": "1 2 ٣\n2 3 4\n3 4 5\n",
    "word": "1 2 3\n2 3 x4\n3 4 5\n",
    "hexadecimal": "1 2 3\n2 3 0x4\n3 4 5\n",
    "glued": "1 2 3\n2 3.4.5\n3 4 5\n",
    "short": "1 2 3\n2 3\n3 4 5\n",
    "wider": "1 2 3\n2 3 4 5\n3 4 5\n",
    "all wide": "1 2 3 4 5\n2 3 4 5 6\n",
    "unequal sums": "1 2 3 4\n2 3\n3 4 5\n",
    "equal letters": "1 2 34\n2 3 4 5\n",
    "lone return": "1 2 3\n2 3\r4\n3 4 5\n",
    "back": "1 2 3\n3 3 4\n2 4 5\n",
    "twice": "1 2 3\n2 3 4\n2 4 5\n",
    "no time": "1 2 3\nnan 3 4\n2 4 5\n",
    "empty": "",
    "only comments": "# a\n\n#b\n",
}


@pytest.mark.parametrize("name", NUMBERS)
def test_numbers_in_blocks_are_those_line_by_line(name, tmp_path):
    path = tmp_path / "a.txt"
    path.write_text(NUMBERS[name], encoding="utf-8", newline="")
    whole = numbers_of(path, 2**22)
    for size in (4, 7, 13):
        assert_equal(numbers_of(path, size), whole)
    refused = (
        "word, hexadecimal, glued, short, wider, all wide, unequal sums, equal letters, lone return, back, twice, "
    )
    refused += "no time, empty, only comments"
    assert isinstance(whole, str) == (name in refused.split(", "))
    if not isinstance(whole, str):
        assert_equal(whole, line_by_line(NUMBERS[name]))


def test_every_number_of_many_lines_is_read_to_the_last_bit(tmp_path):
    values = np.random.default_rng(3).standard_normal((2000, 3)).cumsum(axis=0)
    values[:, 0] = np.arange(2000)
    path = tmp_path / "a.txt"
    path.write_text("".join(" ".join(map(repr, row)) + "\n" for row in values.tolist()), encoding="utf-8")
    assert_array_equal(read_numbers(path, (3, 4), LAYOUT).values, values)


def test_the_line_of_a_fault_far_down_is_named(tmp_path):
    path, rows = tmp_path / "a.txt", [f"{k} 2 3" for k in range(1, 400)]
    for line, bad, what in (
        (7, "7 2", "has 2 columns"),
        (390, "390 two 3", "not a number"),
        (399, "398 2 3", "duplicated"),
    ):
        path.write_text("# t a b\n" + "\n".join([*rows[: line - 1], bad, *rows[line:]]) + "\n", encoding="utf-8")
        for size in (50, 2**22):
            found = numbers_of(path, size)
            assert isinstance(found, str)
            assert f"a.txt, line {line + 1}: " in found
            assert what in found


def test_text_that_is_none_is_refused_wherever_it_stands(tmp_path):
    path = tmp_path / "a.txt"
    path.write_bytes(b"1 2 3\n" * 9 + b"2 3 \x80\n")
    for size in (20, 2**22):
        found = numbers_of(path, size)
        assert isinstance(found, str)
        assert "not a text file" in found


TABLES = {
    "plain": "step,a,filter\n1,2.5,x\n2,3,y\n3,4,x\n",
    "semicolons": "step;a;filter\n1; 2.5;x\n2;3;y\n",
    "tabs": "step\ta\tfilter\n\t2.5\tx\n2\t\ty\n",
    "tabs alone": "step\ta\tfilter\n1\t2.5\tx\n\t\t\n2\t3\ty\n",
    "comments": "# made\n\nstep,a,filter\n1,2.5,x\n# half\n2,3,y\n\n",
    "quotes": 'step,a,filter\n1,2.5,"x, y"\n2,3,y\n',
    "windows": "step,a,filter\r\n1,2.5,x\r\n2,3,y\r\n",
    "mixed": "step,a,filter\n1,2,x\n2,,y\n3,nan,z\n4,bad,z\n5,7.25,z\n",
    "numbered": "step,a,filter\n1,2,1\n2,3,two\n3,4,1\n",
    "empty column": "step,a,filter\n1,,x\n2,,y\n3,5,x\n",
    "one column": "a\n1\n2\n",
    "short": "step,a,filter\n1,2,x\n2,3\n",
    "long": "step,a,filter\n1,2,x\n2,3,y,z\n",
    "quoted lines": 'step,a,filter\n1,2,"x\ny"\n2,3,y\n',
    "header alone": "step,a,filter\n",
    "empty": "",
}


def table_of(path, size):
    """Cells as readers take them, numbers or text, and their lines."""
    with blocks_of(size):
        try:
            sheet = read_sheet(path)
        except InputError as error:
            return str(error)
    return {name: [cell(each) for each in cells] for name, cells in sheet.data.items()}, sheet.line.tolist()


@pytest.mark.parametrize("name", TABLES)
def test_tables_in_blocks_are_those_line_by_line(name, tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(TABLES[name], encoding="utf-8", newline="")
    whole = table_of(path, 2**22)
    assert isinstance(whole, str) == (name in {"short", "long", "quoted lines", "header alone", "empty"})
    for size in (1, 20):
        found = table_of(path, size)
        if isinstance(whole, str) or isinstance(found, str):
            assert type(found) is type(whole)
            assert name == "quoted lines" or found == whole
            continue
        assert found == whole


def cell(value):
    try:
        number = float(str(value))
    except ValueError:
        return value
    return None if np.isnan(number) else number


# --- cells as files have them: a number, no number, or none ----------------------------------------

CELLS = {
    "1.5": 1.5, " 2": 2.0, "3 ": 3.0, "+1.0": 1.0, ".5": 0.5, "1e400": np.inf, "-Infinity": -np.inf, "1e31": np.inf,
    "18446744073709551616": 2.0**64, '"4.0"': 4.0, '"4.0" ': 4.0,
    "": np.nan, "  ": np.nan, "NA": np.nan, "nan": np.nan, "null": np.nan, "None": np.nan, '""': np.nan,
    **dict.fromkeys(("abc", "1_0", "\uff11", "0x1A", "1e", "5%", '"1.0"x', '"1,0"', "2020-01-01"), "not a number"),
}  # fmt: skip


@pytest.mark.parametrize("plain", [True, False])
@pytest.mark.parametrize("text", CELLS)
def test_a_cell(text, plain, tmp_path):
    (tmp_path / "a.csv").write_text(f"x,y\n1,{text}\n2,3\n" + ("" if plain else "# a comment\n"), encoding="utf-8")
    sheet, expected = read_sheet(tmp_path / "a.csv"), CELLS[text]
    if isinstance(expected, str):
        with pytest.raises(InputError, match=f"a.csv, line 2: column 'y': {expected} "):
            sheet.numbers("y")
    else:
        assert_array_equal(sheet.numbers("y"), [expected, 3.0])
        assert sheet.empty("y").tolist() == [bool(np.isnan(expected)), False]


@pytest.mark.parametrize(
    "rows, sentence",
    [
        ("True\nFALSE\n", "line 2: column 'x': a truth value or a date, which is to be written as a number .True."),
        ("1\nTrue\n", "line 3: column 'x': not a number .True."),
        ("1e300\n2\n", "line 2: column 'x': not a finite number"),
        ("9007199254740994\n2\n", "line 2: column 'x': a number too large to be counted exactly"),
    ],
)
def test_a_column_of_whole_numbers(rows, sentence, tmp_path):
    (tmp_path / "a.csv").write_text("x\n" + rows)
    with pytest.raises(InputError, match=sentence):
        read_sheet(tmp_path / "a.csv").numbers("x", whole=True)


@pytest.mark.parametrize("name", ["NA", ""])
def test_an_empty_name_of_a_filter(name, tmp_path):
    (tmp_path / "a.csv").write_text(f"x,filter\n1,a\n2,{name}\n")
    with pytest.raises(InputError, match=r"a\.csv, line 3: column 'filter' is empty"):
        read_sheet(tmp_path / "a.csv")


def test_a_table_of_parquet_is_that_of_text(tmp_path):
    frame = pd.DataFrame({"x": [1, 2, 3], "y": [0.5, None, 2.0], "z": ["1", None, "b"], "b": [True, False, True]})
    frame["filter"] = pd.Categorical(["1", "2", "1"])
    frame.to_parquet(tmp_path / "a.parquet")
    frame.to_csv(tmp_path / "a.csv", index=False)
    one, other = read_sheet(tmp_path / "a.parquet"), read_sheet(tmp_path / "a.csv")
    assert list(one.data) == list(other.data)
    for name in ("x", "y"):
        assert_array_equal(one.numbers(name), other.numbers(name))
    assert one.texts("filter").tolist() == other.texts("filter").tolist() == ["1", "2", "1"]
    for column, what in (("z", "not a number .b."), ("b", "a truth value or a date")):
        for sheet in (one, other):
            with pytest.raises(InputError, match=what):
                sheet.numbers(column)


def test_memory_is_that_of_the_numbers(tmp_path):
    """Lines of text and their fields took twenty times as much as the numbers."""
    rng = np.random.default_rng(90125)
    values = np.column_stack([np.arange(60_000.0), rng.normal(size=(60_000, 3))])
    np.savetxt(tmp_path / "a.txt", values, fmt="%.9g")
    np.savetxt(tmp_path / "a.csv", values, fmt="%.9g", delimiter=",", header="t,x,y,z", comments="")
    with blocks_of(2**16):
        for read in (lambda: read_numbers(tmp_path / "a.txt", (4,), ""), lambda: read_sheet(tmp_path / "a.csv")):
            read()  # what is loaded the first time
            tracemalloc.start()
            read()
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
            assert peak < 5 * values.nbytes


def test_matrices_are_looked_at_in_pieces_alike():
    rng = np.random.default_rng(4077)
    root = rng.normal(size=(ROWS + 3, 2, 2))
    P = root @ np.swapaxes(root, -1, -2) + 0.1 * np.eye(2)
    assert np.array_equal(symmetric(P, str), 0.5 * (P + np.swapaxes(P, 1, 2)))
    P[ROWS + 1, 0, 1] += 1.0
    with pytest.raises(InputError, match=rf"^row {ROWS + 1}: the covariance is not symmetric"):
        symmetric(P, lambda row: f"row {row}")
