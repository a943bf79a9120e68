"""Result folders: written whole or not at all, read back to the bit, and refused clearly when damaged."""

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from misbehaving import Still

import consistency as cs
from consistency.bench.runs.montecarlo import simulate_log
from consistency.bench.runs.results_to_records import record_of
from consistency.bench.store.parquet import check_column
from consistency.bench.types import Gaussian
from consistency.referee.column_names import COLUMNS
from consistency.referee.system import require_free

TABLES = ("estimates", "failures", "truth", "landmarks", "map")


class Sleepy(Still):
    """Stays where it started, and breaks in step 5."""

    def pose(self, state):
        return Gaussian(state, np.eye(3) if self.step < 5 else -np.eye(3))


@pytest.fixture(scope="module")
def results(xyz):
    return cs.run_trials(xyz, ["ekf-xyz", Sleepy("sleepy")], runs=4, seed=2, jobs=1)


@pytest.fixture(scope="module")
def written(results, tmp_path_factory):
    folder = tmp_path_factory.mktemp("results") / "out"
    results.write(folder)
    return folder


@pytest.fixture
def folder(written, tmp_path):
    """A copy to be damaged."""
    return Path(shutil.copytree(written, tmp_path / "copy"))


# --- round trip ----------------------------------------------------------------------------------


def test_read_gives_back_what_was_written(xyz, results, written):
    back = cs.read_results(written)
    assert back.scenario == xyz
    for name in TABLES:
        pd.testing.assert_frame_equal(getattr(back, name), getattr(results, name), check_exact=True)
    digests = {name: hashlib.sha256((written / f"{name}.parquet").read_bytes()).hexdigest() for name in TABLES}
    contents = {name: {"rows": len(getattr(results, name)), "sha256": digests[name]} for name in TABLES}
    tables = {"tables": sorted(TABLES), "contents": contents}
    assert back.manifest == json.loads(json.dumps(results.manifest)) | tables
    assert len(back.failures) > 0
    assert back.filters == ["ekf-xyz", "sleepy"]


def test_files_have_the_columns_of_the_contract(written):
    for name in TABLES:
        parquet = pq.ParquetFile(written / f"{name}.parquet")
        assert parquet.schema_arrow.names == [*COLUMNS[name], *(["joint_nees"] if name == "map" else [])]
        if parquet.metadata.num_row_groups:
            assert parquet.metadata.row_group(0).column(0).compression == "ZSTD"
    contract = "filter run step t x y heading P_xx P_xy P_xh P_yy P_yh P_hh nees nis nis_dof"
    assert list(COLUMNS["estimates"]) == contract.split()


def test_manifest_says_where_the_numbers_come_from(written, xyz):
    manifest = json.loads((written / "manifest.json").read_text())
    assert manifest["schema_version"] == 1
    assert manifest["versions"]["numpy"] == np.__version__
    assert (manifest["seed"], manifest["runs"], manifest["complete"]) == (2, 4, True)
    assert manifest["scenario_hash"] == xyz.hash
    assert manifest["failures"] == len(pd.read_parquet(written / "failures.parquet"))
    assert {"command", "git_commit", "wall_time_s", "scenario"} <= set(manifest)


def test_a_failed_run_has_no_rows_from_the_failed_step_on(results):
    rows = results.estimates.query("filter == 'sleepy'")
    assert list(rows["step"]) == [1, 2, 3, 4] * 4
    assert list(results.failures["step"]) == [5] * 4
    assert set(results.failures["reason"]) == {"the pose covariance is not positive definite"}


def test_nees_is_null_only_while_the_pose_is_not_of_full_rank(results):
    table = results.estimates.query("filter == 'ekf-xyz'")
    null = table.loc[table["nees"].isna(), "step"]
    assert set(null) == {1}
    for row in table[table["step"].isin([2, 30])].itertuples():
        truth = results.truth.query("run == @row.run and step == @row.step")[["x", "y", "heading"]].to_numpy()[0]
        e = truth - [row.x, row.y, row.heading]
        e[2] = (e[2] + np.pi) % (2 * np.pi) - np.pi
        P = np.array([[row.P_xx, row.P_xy, row.P_xh], [row.P_xy, row.P_yy, row.P_yh], [row.P_xh, row.P_yh, row.P_hh]])
        assert row.nees == pytest.approx(e @ np.linalg.inv(P) @ e, rel=1e-6)


def test_a_record_puts_every_row_in_its_place(results):
    c = record_of(results, "sleepy")
    assert c.errors.nees.shape == (4, 60)
    assert np.array_equal(np.isfinite(c.errors.nees), np.broadcast_to(np.arange(60) < 4, (4, 60)))
    assert [(failure.run, failure.step) for failure in c.failures] == [(0, 5), (1, 5), (2, 5), (3, 5)]
    row = results.estimates.query("filter == 'sleepy' and run == 2 and step == 3").iloc[0]
    true = results.truth.query("run == 2 and step == 3").iloc[0]
    assert c.errors.error[2, 2, 0] == true["x"] - row["x"]
    assert c.errors.covariance[2, 2, 0, 2] == c.errors.covariance[2, 2, 2, 0] == row["P_xh"]
    assert c.errors.nees[2, 2] == row["nees"]
    assert np.allclose(record_of(results, "ekf-xyz").runs.t, 0.1 * np.arange(1, 61))
    with pytest.raises(cs.InputError, match="filter 'kf' is not in these results; there are: ekf-xyz, sleepy"):
        record_of(results, "kf")


# --- damaged folders -------------------------------------------------------------------------------


@pytest.mark.parametrize("name, keep", zip(TABLES, (0, 3, 200, 200, 200), strict=True))
def test_file_cut_short(folder, name, keep):
    path = folder / f"{name}.parquet"
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(cs.InputError, match=rf"{name}\.parquet: cannot be read, damaged or cut short") as error:
        cs.read_results(folder)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["estimates", "failures", "truth", "landmarks"])
def test_a_table_that_was_written_and_is_gone(folder, name):
    """Without its truth an overconfident filter would pass by the NIS."""
    (folder / f"{name}.parquet").unlink()
    with pytest.raises(cs.InputError, match=rf"{name}\.parquet: missing"):
        cs.read_results(folder)


def test_results_do_not_replace_a_log(folder, uvd, tmp_path):
    simulate_log(uvd, 1, 0, tmp_path / "log")
    with pytest.raises(cs.InputError, match="holds log, not results"):
        cs.read_results(folder).write(tmp_path / "log", overwrite=True)


MANIFESTS = {
    "not JSON": ("{", "not valid JSON"),
    "a list": ("[1]", "schema_version"),
    "no version": ("{}", "schema_version"),
    "another version": ('{"schema_version": 99}', "schema_version"),
    "no filters": ('{"schema_version": 1}', "holds no estimates"),
}


@pytest.mark.parametrize("case", MANIFESTS)
def test_bad_manifest(folder, case):
    text, complaint = MANIFESTS[case]
    (folder / "manifest.json").write_text(text)
    with pytest.raises(cs.InputError, match=complaint) as error:
        cs.read_results(folder)
    assert str(folder) in str(error.value)


def test_no_manifest_and_no_folder(folder, tmp_path):
    (folder / "manifest.json").unlink()
    with pytest.raises(cs.InputError, match=r"manifest\.json: missing"):
        cs.read_results(folder)
    with pytest.raises(cs.InputError, match="nowhere: no such folder"):
        cs.read_results(tmp_path / "nowhere")


# --- writing -----------------------------------------------------------------------------------------


class DiskFull(OSError):
    pass


@pytest.fixture
def full_disk(monkeypatch):
    """The second table does not fit any more."""
    write, calls = pq.ParquetWriter.write_table, []

    def write_table(self, *args, **kwargs):
        calls.append(1)
        if len(calls) > 1:
            raise DiskFull(28, "No space left on device")
        return write(self, *args, **kwargs)

    monkeypatch.setattr(pq.ParquetWriter, "write_table", write_table)


@pytest.mark.usefixtures("full_disk")
def test_an_error_while_overwriting_keeps_the_old_folder(results, folder):
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    for out in (folder, folder.parent / "new"):
        with pytest.raises((DiskFull, cs.InputError), match="No space left"):
            results.write(out, overwrite=True)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]


def test_overwrite_replaces_the_whole_folder(results, folder):
    (folder / "stale.txt").write_text("old")
    results.write(folder, overwrite=True)
    assert not (folder / "stale.txt").exists()
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]
    assert len(cs.read_results(folder).estimates) == len(results.estimates)


def test_existing_folder_is_refused(folder):
    with pytest.raises(cs.InputError, match=r"--out .*copy: exists already; .* --overwrite"):
        require_free(folder, overwrite=False)
    require_free(folder, overwrite=True)
    require_free(folder.parent / "deep" / "out", overwrite=False)
    assert not (folder.parent / "deep").exists()
    (folder.parent / "link").symlink_to(folder.parent / "nowhere")
    with pytest.raises(cs.InputError, match="exists already"):
        require_free(folder.parent / "link", overwrite=False)


def test_overwrite_refuses_what_is_not_ours(tmp_path):
    photos, file = tmp_path / "photos", tmp_path / "notes.txt"
    photos.mkdir()
    (photos / "cat.jpg").write_bytes(b"x")
    file.write_text("x")
    for path in (photos, file):
        with pytest.raises(cs.InputError, match=r"not an output folder of this bench.*not overwritten"):
            require_free(path, overwrite=True)
    assert (photos / "cat.jpg").exists()


@pytest.mark.parametrize("text", ['{"name": "some web page", "icons": []}', "{", "[]"])
def test_overwrite_refuses_the_manifest_of_something_else(tmp_path, text):
    site = tmp_path / "site"
    site.mkdir()
    (site / "manifest.json").write_text(text)
    with pytest.raises(cs.InputError, match="not overwritten"):
        require_free(site, overwrite=True)


def test_place_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(cs.InputError, match=r"--out .*: cannot be written \("):
        require_free(tmp_path / "file" / "below", overwrite=False)


def test_a_square_is_not_negative():
    squares = pd.Series([1.0, np.nan, -2.0], name="nees")
    with pytest.raises(cs.InputError, match="column 'nees', row 12: negative"):
        check_column(Path("map.parquet"), squares, "float64", 10)
    check_column(Path("map.parquet"), squares.rename("x").fillna(0.0), "float64")
