"""Logs as CSV: written with --format csv, read wherever a log is, the same to the last bit, refused in one sentence."""

import numpy as np
import pytest

import consistency as cs
from consistency.bench.runs.montecarlo import simulate_log
from consistency.bench.store.recorded_log import read_log
from consistency.commands import main
from consistency.referee.errors import InputError
from consistency.referee.system import read_manifest
from consistency.stereo.characterising.sources import is_log

NAMES = ("controls", "observations", "truth", "landmarks")


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Folders parquet and csv of the same trials."""
    folder = tmp_path_factory.mktemp("logs")
    world = cs.load_scenario("herath2007-xyz").variant("tiny", truth__steps=25)
    for form in ("parquet", "csv"):
        simulate_log(world, 3, 71, folder / form, form=form)
    return folder


@pytest.fixture
def log(logs, tmp_path):
    """A copy of the log as CSV."""
    for file in (logs / "csv").iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    return tmp_path


def test_a_log_as_csv_is_the_same_to_the_last_bit(logs):
    assert {file.name for file in (logs / "csv").iterdir()} == {
        "manifest.json", "sensor.toml", *(f"{name}.csv" for name in NAMES),
    }  # fmt: skip
    assert read_manifest(logs / "csv")["tables"] == read_manifest(logs / "parquet")["tables"] == sorted(NAMES)
    one, two = read_log(logs / "parquet"), read_log(logs / "csv")
    for a, b in zip(one.trials, two.trials, strict=True):
        for field in ("start", "controls", "first", "landmark", "z", "truth", "landmarks"):
            np.testing.assert_array_equal(getattr(a, field), getattr(b, field))
    assert one.belief == two.belief
    assert set(two.sha256) == {"sensor.toml", *(f"{name}.csv" for name in NAMES)}
    assert is_log(logs / "csv")
    assert not is_log(logs)


def test_the_commands_write_and_read_it(tmp_path, capsys):
    def done(*arguments):
        with pytest.raises(SystemExit) as end:
            main(list(arguments))
        return end.value.code

    out, results = str(tmp_path / "log"), str(tmp_path / "results")
    assert not done("simulate", "herath2007-xyz", "--runs", "2", "--format", "csv", "--out", out)
    assert not done("run", "--log", out, "--filter", "ekf-xyz", "--jobs", "1", "--out", results)
    assert done("simulate", "herath2007-xyz", "--format", "xlsx", "--out", str(tmp_path / "other")) == 2
    assert "--format xlsx: must be parquet or csv" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()


def test_a_table_of_each_form_will_do(logs, log):
    (log / "truth.csv").unlink()
    (log / "truth.parquet").write_bytes((logs / "parquet/truth.parquet").read_bytes())
    (log / "landmarks.csv").unlink()
    found = read_log(log)
    assert found.landmarks is None
    assert found.trials[0].truth is not None


def edit(change, name="controls"):
    """Change the lines of a table."""

    def apply(folder):
        path = folder / f"{name}.csv"
        path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")

    return apply


def cell(row, column, value, name="controls"):
    def change(lines):
        fields = lines[row + 1].split(",")
        fields[column] = value
        lines[row + 1] = ",".join(fields)
        return lines

    return edit(change, name)


def both(folder):
    (folder / "controls.parquet").write_bytes(b"")


def folder_in_its_place(folder):
    (folder / "controls.csv").unlink()
    (folder / "controls.csv").mkdir()


REFUSED = {
    "missing column": (edit(lambda lines: [line.rsplit(",", 1)[0] for line in lines]), "column 'omega' is missing"),
    "column twice": (
        edit(lambda lines: [f"{lines[0]},dt", *(f"{line},1" for line in lines[1:])]),
        "'dt' is duplicated",
    ),
    "semicolons": (edit(lambda lines: [line.replace(",", ";") for line in lines]), "column 'run' is missing"),
    "short row": (edit(lambda lines: [*lines[:4], lines[4].rsplit(",", 1)[0], *lines[5:]]), "cannot be read as CSV"),
    "word": (cell(3, 2, "fast"), "cannot be read as CSV"),
    "empty cell": (cell(3, 2, ""), r"column 'dt', row 3: not a finite number"),
    "not finite": (cell(3, 2, "inf"), r"column 'dt', row 3: not a finite number"),
    "too large": (cell(3, 3, "1e40"), r"column 'v', row 3: too large a number"),
    "no whole number": (cell(3, 1, "4.5"), r"column 'step', row 3: not a whole number"),
    "stray observation": (cell(0, 1, "99", "observations"), r"observations\.csv: row 0: controls\.csv has no such run"),
    "empty": (lambda folder: (folder / "controls.csv").write_text("") and None, "column 'run' is missing"),
    "no text": (lambda folder: (folder / "controls.csv").write_bytes(b"\x80\x81") and None, "cannot be read as CSV"),
    "both forms": (both, r"holds controls\.parquet and controls\.csv; take one of them away"),
    "a folder": (folder_in_its_place, r"controls\.csv: is not a file"),
    "neither": (lambda folder: (folder / "controls.csv").unlink(), r"controls\.parquet: missing"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_wrong_with_a_table_is_said(name, log):
    change, match = REFUSED[name]
    read_log(log)
    change(log)
    with pytest.raises(InputError, match=match) as refusal:
        read_log(log)
    assert "\n" not in str(refusal.value)
