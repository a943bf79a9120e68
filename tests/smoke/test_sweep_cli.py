"""``sweep`` in processes of its own."""

import pandas as pd
import pytest
from own_process import consistency

from consistency.bench.scenario import data_folder

SWEEP = """
summary = "Two densities"
base = "small.toml"
filters = ["ekf-uvd"]
[rule]
max_runs = 12
[grid]
range = [3.0, 4.0]
density = [0.2]
"""


@pytest.fixture(scope="module")
def at(tmp_path_factory):
    """A folder with ``small.toml``, a short world, and ``grid.toml``, a sweep of it."""
    folder = tmp_path_factory.mktemp("sweep")
    text = (data_folder("scenarios") / "herath2007-stereo.toml").read_text()
    (folder / "small.toml").write_text(text.replace("steps = 500", "steps = 40"))
    (folder / "grid.toml").write_text(SWEEP)
    (folder / "zero.toml").write_text(SWEEP.replace("range = [3.0, 4.0]", "baseline = [0.0]"))
    return folder


@pytest.fixture(scope="module")
def out(at):
    done = consistency("sweep", "grid.toml", "--out", "out", "--jobs", "1", cwd=at)
    assert "out/report.pdf" in done.stdout
    return at / "out"


def test_a_sweep_leaves_a_map_and_a_report(out):
    assert list(pd.read_csv(out / "map.csv")["range"]) == [3.0, 4.0]
    assert (out / "report.pdf").read_bytes().startswith(b"%PDF")
    page = (out / "report.html").read_text().split("<main")[1].split("<script")[0]
    assert "://" not in page.replace("http://www.w3.org", "")


def test_the_same_command_has_nothing_to_do(out):
    before = {path: path.stat().st_mtime_ns for path in out.glob("cells/*/*/*")}
    again = consistency("sweep", "grid.toml", "--out", "out", cwd=out.parent)
    assert "2 of 2 are there already" in again.stderr
    assert {path: path.stat().st_mtime_ns for path in before} == before
    consistency("sweep", "out", cwd=out.parent)


BAD = {
    "baseline of 0": (("sweep", "zero.toml", "--out", "o"), "zero.toml: key 'grid.baseline': values must be positive"),
    "no folder": (("sweep", "grid.toml"), "--out: missing"),
    "no such sweep": (("sweep", "regimes", "--out", "o"), "did you mean 'regime'"),
    "wrong filter": (("sweep", "grid.toml", "--filter", "kf", "--out", "o"), "filters that fit"),
    "jobs": (("sweep", "grid.toml", "--out", "o", "--jobs", "0"), "jobs must be at least 1"),
    "folder with options": (("sweep", ".", "--overwrite"), "only reported again"),
    "no sweep's folder": (("sweep", "."), "manifest.json: missing"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_input(out, refused, case):
    arguments, expected = BAD[case]
    assert expected in refused(out.parent, *arguments)
