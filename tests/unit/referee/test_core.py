"""What judges files loads arrays, statistics and the command line alone: in a process where nothing else is found."""

import json

import forks
import numpy as np
import pytest

HEAVY = (
    "cv2", "filelock", "filterpy", "joblib", "llvmlite", "matplotlib", "numba", "pandas", "pyarrow",
    "threadpoolctl", "tomli_w", "typst", "yaml",
)  # fmt: skip
RUNS, STEPS = 30, 12
WITHOUT = f"""
import contextlib, io, numpy, scipy.stats, scipy.linalg, scipy.special, typer

sys.modules |= dict.fromkeys({HEAVY})  # neither found nor imported
"""
LOADED = """
rooms = {name.split(".")[1] for name in sys.modules if name.startswith("consistency.")}
assert not rooms & {"filters", "models", "scenario", "simulation", "runs"}, rooms
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
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


def said(folder, code):
    """Standard output of code where the heavy packages are not found."""
    done = forks.done(WITHOUT, code, "-c", cwd=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_commands_on_files(folder):
    code = """
from consistency.commands import main

def run(*words):
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.suppress(SystemExit):
        main(list(words))
    return out.getvalue()

print(run("analyse", "bold.csv", "--truth", "truth.csv", "--json").replace("\\n", " "))
print("baseline in" in run("baseline", "old.csv", "--truth", "truth.csv", "--out", "old.json"))
print("not shown to be less consistent" in run("compare", "est.csv", "old.json", "--truth", "truth.csv"))
print("no alarm" in run("monitor", "est.csv", "--run", "3", "--innovations", "optimal"))
print("runs" in run("plan", "--dof", "3"))
"""
    verdict, *others = said(folder, code + LOADED).splitlines()
    assert json.loads(verdict)["bold"]["status"] == "overconfident"
    assert others == ["True"] * 4


def test_a_verdict_loads_what_it_needs(folder):
    """Not readers of other files, nor questions that are not asked."""
    code = """
from consistency.commands import main

with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
    main(["analyse", "est.csv", "--truth", "truth.csv"])
print(*(name.removeprefix("consistency.referee.") for name in sys.modules if name.startswith("consistency")))
"""
    ours = said(folder, code).split()
    assert len(ours) <= 79
    assert {"readers.formats.table", "diagnostics.scale"} <= {*ours}
    assert not {*ours} & {
        "readers.formats.ros_bag", "readers.formats.tum", "readers.formats.archives",
        "readers.pipeline.relative_motions",
        "readers.mix_ups.known", "readers.alignment", "diagnostics.comparison", "diagnostics.maps",
        "diagnostics.monitor", "diagnostics.uncertain_truth",
    }  # fmt: skip


def test_gates_and_records(folder):
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


def test_parquet_without_its_reader(folder):
    (folder / "est.parquet").write_bytes(b"PAR1")
    code = """
from consistency.referee.errors import InputError
import consistency as cs
try:
    cs.read("est.parquet", truth="truth.csv")
except InputError as error:
    print(error)
"""
    assert said(folder, code).startswith("est.parquet: Parquet needs pyarrow: pip install ")


REPORT = """
from consistency.commands import main

with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as err:
    try:
        main(["analyse", "bold.csv", "--truth", "truth.csv", "--report", "{out}", "--fail-on", "inconsistent"])
    except SystemExit as end:
        status = end.code
print(status, err.getvalue().splitlines()[-1])
"""


def test_a_report_without_its_packages(folder):
    status, _, line = said(folder, REPORT.format(out="look") + LOADED).partition(" ")
    assert status == "1"
    told = "consistency: pictures and the PDF need matplotlib, typst: pip install "
    assert line.startswith(told)
    assert {path.name for path in (folder / "look").iterdir()} == {"manifest.json", "report.html", "verdict.json"}
    page = (folder / "look" / "report.html").read_text("utf-8")
    assert "<h1>Estimator consistency: bold.csv</h1>" in page
    assert "bold is overconfident: covariance too small by x" in page
    verdict = json.loads((folder / "look" / "verdict.json").read_text("utf-8"))["bold"]
    for reason in verdict["reasons"]:
        is_left_out = reason.startswith("noncredibility index") or "questions at a false-alarm rate" in reason
        assert (reason.split(";")[0] in page.replace("&gt;", ">")) != is_left_out
    assert "Error convention so2" in page
    assert "<script" not in page
    assert "<figure" not in page


def test_a_picture_needs_matplotlib_alone(folder):
    said(folder, 'del sys.modules["matplotlib"]\n' + REPORT.format(out="shown") + LOADED)
    page = (folder / "shown" / "report.html").read_text("utf-8")
    assert page.count('<div class="chart"') >= 3
    assert "pip install" not in page


def test_a_plot_says_what_it_needs(folder):
    code = """
import consistency as cs
verdict = cs.judge(cs.read("est.csv", truth="truth.csv"))
print("<figure" in verdict._repr_html_())
try:
    verdict.plot()
except cs.InputError as error:
    print(error)
"""
    picture, plot = said(folder, code).splitlines()
    assert picture == "False"
    assert plot.startswith("a plot needs matplotlib: pip install ")
