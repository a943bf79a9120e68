"""What readers of each kind refuse or take as it is, which the fuzzer would not find again soon; one sentence each."""

import json
import os
import shutil
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hostile import STEPS, write_all
from mutations import bomb, claimed
from recorded import read_recordings

import consistency as cs
from consistency.bench.store.parquet import read_parquet
from consistency.bench.sweeps.sweep_file import load_sweep
from consistency.referee.parsing import one_line, read_json, read_text, read_toml, reading, require_room
from consistency.referee.system import data_folder
from consistency.referee.verdicts.compare_sources import read_baseline


def read(path, **options):
    """The recording of the first estimator."""
    return read_recordings(Path(path), **options)[0]


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    folder = tmp_path_factory.mktemp("boundary")
    write_all(folder)
    return folder


@pytest.fixture
def files(valid, tmp_path):
    return Path(shutil.copytree(valid, tmp_path / "files"))


# --- tables of estimates ----------------------------------------------------------------------------


def change_row_5(path, value):
    """Another x in the sixth row of a table."""
    table = pd.read_csv(path, dtype=str)
    table.loc[5, "x"] = value
    table.to_csv(path, index=False)


@pytest.mark.parametrize("value", ["1e308", "-1e308", "3e30", "inf"])
def test_an_estimate_beyond_all_measure_is_a_failed_run(files, value):
    change_row_5(files / "table" / "est.csv", value)
    recording = read(files / "table" / "est.csv", truth=files / "table" / "truth.csv")
    assert [(failure.run, failure.step) for failure in recording.failures] == [(0, 6)]
    assert "not finite" in recording.failures[0].reason
    assert np.nanmax(recording.errors.nees) < 1e6


def test_a_truth_beyond_all_measure_is_refused(files):
    change_row_5(files / "table" / "truth.csv", "1e308")
    with pytest.raises(cs.InputError, match=r"truth\.csv, line 7: column 'x': not a finite number \(1e\+?308\)"):
        read(files / "table" / "est.csv", truth=files / "table" / "truth.csv")


def test_large_numbers_of_a_trajectory(files):
    path = files / "tum" / "cov.txt"
    lines = path.read_text(encoding="utf-8").splitlines()
    lines[4] = " ".join([lines[4].split()[0], *["1e308"] * 36])
    path.write_text("\n".join(lines), encoding="utf-8")
    at = files / "tum"
    recording = read(at / "est.tum", truth=at / "truth.tum", covariance=path)
    assert [failure.step for failure in recording.failures] == [5]


# --- Parquet ----------------------------------------------------------------------------------------


def test_notes_of_other_programs_change_nothing(files):
    """They may make a column the index of the table, or give it another type."""
    path = files / "results" / "truth.parquet"
    before = read_parquet(path.parent, "truth")
    notes = {"index_columns": ["step"], "columns": [], "column_indexes": [], "pandas_version": "2"}
    table = pq.read_table(path).replace_schema_metadata({"pandas": json.dumps(notes)})
    pq.write_table(table, path)
    pd.testing.assert_frame_equal(read_parquet(path.parent, "truth"), before)


@pytest.mark.parametrize(
    "column, said",
    [
        (pa.array([2**60 + 1] * 117), r"column 'run', row 0: not a whole number"),
        (pa.array([True] * 117), r"column 'run' cannot be read as numbers \(bool\)"),
        (pa.array([True, None] + [False] * 115), r"column 'run' cannot be read as numbers \(object\)"),
        (pa.array([[0]] * 117), r"column 'run'.*not a|column 'run' cannot be read as numbers"),
        (pa.array([0] * 117, pa.timestamp("ns")), r"column 'run' cannot be read as numbers"),
    ],
    ids=["large", "bool", "bool with gaps", "list", "time"],
)
def test_a_column_of_runs_is_of_whole_numbers(files, column, said):
    path = files / "results" / "truth.parquet"
    table = pq.read_table(path)
    pq.write_table(table.set_column(0, "run", column), path)
    with pytest.raises(cs.InputError, match=rf"truth\.parquet: {said}"):
        read_parquet(path.parent, "truth")


# --- archives ---------------------------------------------------------------------------------------


def test_a_small_archive_of_a_gigabyte_is_refused_before_it_is_read(files):
    bomb(files / "archive" / "est.npz", np.random.default_rng(0))
    with pytest.raises(cs.InputError, match=r"est\.npz: would take 0\.625 GiB in memory"):
        read(files / "archive" / "est.npz")


def test_an_array_that_claims_more_than_it_holds_is_refused(files):
    for seed in range(8):
        path = shutil.copy(files / "archive" / "nees.npz", files / "copy.npz")
        claimed(Path(path), np.random.default_rng(seed))
        with pytest.raises(cs.InputError, match=r"copy\.npz: is not a NumPy archive, damaged"):
            read(path)


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_packed_archive_holds_the_same(files, method):
    path = files / "archive" / "nees.npz"
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(files / "packed.npz", "w", method) as new:
        for name in old.namelist():
            new.writestr(name, old.read(name))
    assert np.array_equal(read(files / "packed.npz").errors.nees, read(path).errors.nees)


@pytest.mark.parametrize("key", ["errors", "covariances", "nis", "nis_dof"])
def test_complex_numbers_are_refused(files, key):
    path = files / "archive" / "est.npz"
    with np.load(path) as archive:
        data = dict(archive)
    np.savez(path, **data | {key: data[key] + 0j})
    with pytest.raises(cs.InputError, match=rf"key '{key}' holds complex128, not numbers"):
        read(path)


# --- cameras ----------------------------------------------------------------------------------------


def test_a_singular_matrix_of_a_camera_is_named(files):
    from consistency.stereo.visual_odometry.calibration_files import read_calibration

    path = files / "kitti" / "calib.txt"
    path.write_text(path.read_text(encoding="utf-8").replace("P1: 700", "P1: 0"), encoding="utf-8")
    with pytest.raises(cs.InputError, match=r"calib\.txt: key 'P1': the matrix of its camera is singular"):
        read_calibration(path)


@pytest.mark.parametrize(
    "text, said",
    [
        ("[" * 20_000, "nested too deep"),
        ("%YAML:1.0\n---\nK1: " + "[" * 1_000_000, "nested too deep"),
        ("K1: " + "- " * 20_000, "nested too deep"),
        ("a: &a [1, 1]\nK1: [*a, *a]\n", "aliases"),
        ("K1: 1\nK1: 2\n", "key 'K1' is duplicated"),
        ("K1: 2020-99-99\n", "cannot be read as YAML"),
        ("K1: [1" + "0" * 400 + "]\n", "key 'K1': must be numbers"),
        ("x" * (2**20 + 1), "at most 1 MiB are read"),
    ],
    ids=["brackets", "OpenCV", "lists", "aliases", "twice", "date", "number", "large"],
)  # fmt: skip
def test_yaml_that_is_hostile(tmp_path, text, said):
    pytest.importorskip("yaml")
    pytest.importorskip("cv2")
    from consistency.stereo.visual_odometry.calibration_files import read_calibration

    path = tmp_path / "c.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(cs.InputError, match=rf"c\.yaml: .*{said}"):
        read_calibration(path)


# --- baselines and sweeps ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "key, value, said",
    [
        ("runs", [2**63, 1], "filters.one.runs.0"),
        ("runs", [0] * 9, "a run is duplicated"),
        ("dof", 10**400, "filters.one.dof"),
        ("dof", True, "filters.one.dof"),
        ("nees", [1.0], "not equally long"),
        ("nees", [-1.0] * 9, "filters.one.nees.0"),
        ("squared", [[1.0]] * 9, "not equally long"),
        ("failures", -1, "filters.one.failures"),
    ],
    ids=str,
)
def test_a_changed_baseline_is_refused(files, key, value, said):
    path = files / "baseline" / "base.json"
    data = json.loads(path.read_text(encoding="utf-8"))
    assert len(read_baseline(path).filters["one"].runs) == len(data["filters"]["one"]["nees"])
    data["filters"]["one"][key] = value
    path.write_text(json.dumps(data), encoding="utf-8")
    with pytest.raises(cs.InputError, match=rf"base\.json: damaged; write it again \(.*{said}"):
        read_baseline(path)


def test_a_grid_of_more_cells_than_there_is_room_for(files):
    path = files / "sweep" / "sweep.toml"
    values = ", ".join(str(k / 1000) for k in range(1, 301))
    text = path.read_text(encoding="utf-8").split("[grid]")[0]
    path.write_text(f"{text}[grid]\nspeed = [{values}]\nodometry = [{values}]\n", encoding="utf-8")
    with pytest.raises(cs.InputError, match=r"sweep\.toml: key 'grid': makes 90000 cells; at most 20000"):
        load_sweep(path)


def test_one_bad_step_sizes_nothing(files):
    path = files / "results" / "estimates.parquet"
    table = pd.read_parquet(path)
    table.loc[STEPS - 1, "step"] = 10**12
    table.to_parquet(path, index=False)
    with pytest.raises(cs.InputError, match=r"estimates\.parquet: step 1000000000000 of run 0"):
        cs.analyse(cs.read_results(path.parent))


# --- results ----------------------------------------------------------------------------------------


def edited(files, column, new):
    """Results in which one number of a step was changed."""
    path = files / "results" / "estimates.parquet"
    table = pd.read_parquet(path).astype({column: float})
    table.loc[40, column] = new
    table.to_parquet(path, index=False)
    return path.parent


@pytest.mark.parametrize(
    "column, new, said",
    [
        ("x", 1e61, "column 'x', row 40: too large a number"),
        ("P_xx", -1e300, "column 'P_xx', row 40: too large a number"),
        ("nees", 1e61, "column 'nees', row 40: too large a number"),
        ("nis", np.inf, "column 'nis', row 40: not a finite number"),
        ("nis_dof", 2.0**31, "column 'nis_dof', row 40: too large a number"),
        ("x", 1e40, "estimates of 'one', run 3, step 5: the NEES is not that of the error"),
        ("P_yy", 1e-200, "estimates of 'one', run 3, step 5: the NEES is not that of the error"),
    ],
)
def test_numbers_whose_squares_would_overflow_are_refused(files, column, new, said):
    folder = edited(files, column, new)
    with pytest.raises(cs.InputError, match=said):
        cs.analyse(cs.read_results(folder))


def test_large_numbers_that_go_together_are_judged(files):
    """Without a warning, as the whole suite treats them as errors; the verdict is on what is there."""
    with np.errstate(all="raise", under="ignore"):
        verdict = cs.analyse(cs.read_results(edited(files, "nees", 1e60)))["one"]
    assert verdict.status in ("overconfident", "heavy-tailed", "inconsistent", "undecided")


@pytest.mark.parametrize("name", ["est.npz", "nees.npz"])
def test_degrees_of_freedom_beyond_whole_numbers_are_refused(files, name):
    path = files / "archive" / name
    with np.load(path) as archive:
        arrays = dict(archive)
    key = "nis_dof" if name == "est.npz" else "dof"
    for value in (2.0**31, np.float16(np.inf), 1e300, np.float32(2.5)):
        np.savez(path, **arrays | {key: np.array(value)})
        with pytest.raises(cs.InputError, match="whole number"):
            read(path)


def test_counts_of_rows_that_disagree_are_refused(files):
    """The number of rows of a group, which no checksum is over, is one less: a row would be passed over."""
    path = files / "results" / "truth.parquet"
    content = path.read_bytes()
    rows = pq.read_metadata(path).num_rows
    group = b"\x16" + varint(rows)
    at = content.rindex(group)
    path.write_bytes(content[:at] + b"\x16" + varint(rows - 1) + content[at + len(group) :])
    with pytest.raises(cs.InputError, match=r"truth\.parquet: .*numbers of rows do not agree"):
        read_parquet(path.parent, "truth")


def varint(value):
    """A whole number as the compact protocol of Thrift has it."""
    coded, out = 2 * value, b""
    while coded > 127:
        coded, out = coded >> 7, out + bytes([coded & 127 | 128])
    return out + bytes([coded])


def test_a_number_of_a_grid_that_no_float_holds_is_refused(files):
    path = files / "sweep" / "sweep.toml"
    text = path.read_text(encoding="utf-8").replace("odometry = [", f"odometry = [\n    {10**400},")
    path.write_text(text, encoding="utf-8")
    with pytest.raises(cs.InputError, match=r"key 'grid\.odometry'"):
        load_sweep(path)


# --- what parsers raise ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "raised, said",
    [
        (KeyError("a"), r"f\.x: damaged \('a'\)"),
        (RecursionError("deep\nly"), r"f\.x: damaged \(nested too deep\)"),
        (MemoryError(), r"f\.x: damaged \(it would take more memory than there is\)"),
        (OSError(13, "Permission denied"), r"f\.x: cannot be read \(Permission denied\)"),
        (OSError("bad page"), r"f\.x: damaged \(bad page\)"),
        (NotImplementedError(), r"f\.x: damaged \(NotImplementedError\)"),
        (cs.InputError("own words"), "own words"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_what_a_parser_raises_is_one_sentence(raised, said):
    with pytest.raises(cs.InputError, match=f"^{said}$"), reading("f.x", "damaged"):
        raise raised


def test_ctrl_c_is_no_damage():
    with pytest.raises(KeyboardInterrupt), reading("f.x"):
        raise KeyboardInterrupt


def test_a_line_is_short_and_printable():
    assert one_line("a\n\x1b[31mb\tc") == "a [31mb c"
    assert len(one_line("x" * 10_000)) == 160


def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.toml")
    with pytest.raises(cs.InputError, match=r"pipe\.toml: is a device, not a file"):
        read_toml(tmp_path / "pipe.toml")


def test_a_folder_and_a_large_file_are_no_text(tmp_path):
    with pytest.raises(cs.InputError, match="is a folder, not a file"):
        read_text(tmp_path, "no text")
    (tmp_path / "large.json").write_bytes(b" " * 5000)
    with pytest.raises(cs.InputError, match=r"large\.json: has 0 MiB; at most 0 MiB are read"):
        read_text(tmp_path / "large.json", "no text", largest=4999)
    assert len(read_text(tmp_path / "large.json", "no text", largest=5000)) == 5000


@pytest.mark.parametrize(
    "text",
    [".".join(["a"] * 20_000) + " = 1", "[" + " . ".join(['"a"'] * 20_000) + "]", "a = " + "[" * 20_000,
     "a = {" + ".".join(["b"] * 20_000) + " = 1}"],
    ids=["key", "table", "list", "inline"],
)  # fmt: skip
def test_toml_that_is_nested_20000_deep_takes_no_memory(tmp_path, text):
    (tmp_path / "deep.toml").write_text(text, encoding="utf-8")
    cs.load_scenario("herath2007-xyz")  # what is imported does not count
    tracemalloc.start()
    with pytest.raises(
        cs.InputError, match=r"deep\.toml: not valid TOML \((nested too deep|a key of more than 64 parts)\)"
    ):
        cs.load_scenario(tmp_path / "deep.toml")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 20 * 2**20


def test_keys_of_64_parts_and_long_words_are_toml(tmp_path):
    path = tmp_path / "long.toml"
    path.write_text(".".join("a" * 64) + f' = 1\ns = "{"x" * 100_000} {". " * 1000}"\n', encoding="utf-8")
    assert len(read_toml(path)["s"]) == 102_001


@pytest.mark.parametrize("text", ['{"a": 1, "a": 2}', "[" * 20_000, "\ufeff{}", '{"a": 1' + "0" * 5000 + "}"])
def test_json_with_a_key_twice_or_worse(tmp_path, text):
    (tmp_path / "m.json").write_text(text, encoding="utf-8")
    with pytest.raises(cs.InputError, match=r"m\.json: not valid JSON \("):
        read_json(tmp_path / "m.json")


def test_room_is_in_proportion_to_the_file(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(bytes(1000))
    require_room(path, 2**29)
    with pytest.raises(cs.InputError, match=r"0\.5 GiB in memory"):
        require_room(path, 2**29 + 1)


# --- what a scenario may size ------------------------------------------------------------------------


def scenario(tmp_path, old, new):
    text = (data_folder("scenarios") / "herath2007-xyz.toml").read_text(encoding="utf-8")
    key = next(line for line in text.splitlines() if line.split("=")[0].strip() in (old, f"{old}_s"))
    path = tmp_path / "world.toml"
    path.write_text(text.replace(key, f"{old} = {new}", 1), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "key, value, said",
    [
        ("steps", 2**63 - 1, r"key 'truth\.steps': Input should be less than or equal to 1000000"),
        ("steps", "1" + "0" * 400, r"key 'truth\.steps': "),
        ("count", 10**9, r"key 'truth\.landmarks\.count': Input should be less"),
        ("count", 10**6, r".*steps times landmarks must be at most 200000000"),
        ("dt", 1e308, r"key 'truth\.dt': Input should be less than or equal to 10{30} "),
    ],
)
def test_a_number_of_a_scenario_sizes_no_arrays(tmp_path, key, value, said):
    with pytest.raises(cs.InputError, match=said):
        cs.load_scenario(scenario(tmp_path, key, value))


def test_a_name_that_no_file_can_have(tmp_path):
    for name in ("x" * 300, "x" * 300 + ".toml", "a\0.toml"):
        with pytest.raises(cs.InputError):
            cs.load_scenario(str(tmp_path / name))
