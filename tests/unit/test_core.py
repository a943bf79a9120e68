"""What judges files loads arrays, statistics and the command line alone: in a process where nothing else is found."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from consistency.errors import InputError
from consistency.geometry.conventions import se3_log
from consistency.recording.hints import hints
from consistency.recording.sheet import read_sheet
from consistency.verdicts.baselines import _known

HEAVY = (
    "bokeh", "cv2", "filelock", "filterpy", "jinja2", "joblib", "llvmlite", "matplotlib", "numba", "pandas", "pyarrow",
    "threadpoolctl", "tomli_w", "typst", "yaml",
)  # fmt: skip
RUNS, STEPS = 30, 12
WITHOUT = f"""
import contextlib, io, sys

class Gone:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {HEAVY}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Gone())
"""
LOADED = """
rooms = {name.split(".")[1] for name in sys.modules if name.startswith("consistency.")}
assert not rooms & {"filters", "models", "scenario", "simulation", "runs"}, rooms
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("core")
    rng = np.random.default_rng(1)
    for name, scale in (("est", 1.0), ("old", 1.0), ("bold", 3.0)):
        rows = ["run,step,x,y,heading,P_xx,P_xy,P_xh,P_yy,P_yh,P_hh,nis,nis_dof"]
        for run in range(RUNS):
            for step in range(1, STEPS + 1):
                x, y, heading = scale * np.array([0.1, 0.1, 0.03]) * rng.standard_normal(3)
                rows.append(f"{run},{step},{x},{y},{heading},0.01,0,0,0.01,0,0.0009,{rng.chisquare(2)},2")
        (folder / f"{name}.csv").write_text("\n".join(rows))
    truth = [f"{step},0,0,0" for step in range(1, STEPS + 1)]
    (folder / "truth.csv").write_text("\n".join(["step,x,y,heading", *truth]))
    return folder


def said(folder: Path, code: str) -> str:
    """Standard output of code where the heavy packages are not found."""
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT + code], cwd=folder, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_commands_on_files(folder: Path) -> None:
    code = """
from consistency.cli import main

def run(*words):
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.suppress(SystemExit):
        main(list(words))
    return out.getvalue()

print(run("analyse", "bold.csv", "--truth", "truth.csv", "--json").replace("\\n", " "))
print("baseline in" in run("baseline", "old.csv", "--truth", "truth.csv", "--out", "old.json"))
print("not found less consistent" in run("compare", "est.csv", "old.json", "--truth", "truth.csv"))
print("no alarm" in run("monitor", "est.csv", "--run", "3", "--innovations", "optimal"))
print("runs" in run("plan", "--dof", "3"))
"""
    verdict, *others = said(folder, code + LOADED).splitlines()
    assert json.loads(verdict)["bold"]["status"] == "overconfident"
    assert others == ["True"] * 4


def test_gates_and_records(folder: Path) -> None:
    code = """
import numpy as np
import consistency as cs
from consistency.testing import assert_consistent

rng = np.random.default_rng(2)
assert_consistent(rng.standard_normal((200, 5, 2)), np.broadcast_to(np.eye(2), (200, 5, 2, 2)), false_alarm=1e-6)
record = cs.read("est.csv", truth="truth.csv")
print(cs.judge(record).status)
monitor = cs.Monitor()
print(monitor.update(1.0, 2))
"""
    assert said(folder, code + LOADED).split() == ["consistent", "None"]


def test_parquet_without_its_reader(folder: Path) -> None:
    (folder / "est.parquet").write_bytes(b"PAR1")
    code = """
from consistency.errors import InputError
import consistency as cs
try:
    cs.read("est.parquet", truth="truth.csv")
except InputError as error:
    print(error)
"""
    assert said(folder, code).strip() == "est.parquet: Parquet needs pandas: pip install pandas pyarrow"


def test_the_logarithm_of_a_motion_in_space() -> None:
    """Beside the exponential of its matrix."""
    twist = np.array([0.3, -1.2, 2.0, 0.4, -0.7, 1.1])
    generator = np.zeros((4, 4))
    generator[:3, 3], (a, b, c) = twist[:3], twist[3:]
    generator[:3, :3] = [[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]]
    motion = expm(generator)
    pose = np.concatenate([motion[:3, 3], Rotation.from_matrix(motion[:3, :3]).as_quat()])
    np.testing.assert_allclose(se3_log(pose), twist, atol=1e-12)


def test_a_quoted_row_with_too_few_fields(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text('x,y,z\n"1",2\n')
    with pytest.raises(InputError, match="line 2: has 2 columns, the header has 3"):
        read_sheet(tmp_path / "a.csv")


def test_an_unknown_key_of_a_baseline() -> None:
    with pytest.raises(ValueError, match=r"key 'filters\.a\.more': unknown"):
        _known({"runs": [], "more": 1}, "filters.a", ("runs",))


def test_no_run_needs_no_hint() -> None:
    assert hints("a", ("x", "y", "heading"), []) == []
