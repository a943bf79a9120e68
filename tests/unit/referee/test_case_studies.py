"""The case studies: verdicts on the stored draws, and the figures that the documents state of them.

A verdict here is not statistical: the draws are stored, so that it is the same each time.
"""

import json
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

import consistency as cs
from consistency.diagnostics import gate_runs

ROOT = Path(__file__).parents[3]
DOCS = ROOT / "docs"
FOLDER = DOCS / "case-studies"
sys.path.insert(0, str(FOLDER))

import linear  # noqa: E402 - in the folder above
import page  # noqa: E402
import study  # noqa: E402

VERSIONS = ("4.2.1", "4.3.0")
EXPECTED = 3.20  # tr(P^-1 P') / 9, with P of preintMeasCov() and P' of residualCovariance() of 4.3.0 without noise
ROWS = {  # of gtsam_imu.py, and their archives
    "the factor at the truth": "",
    "a tenth of the turn, 0.2 rad": "-tenth",
    "the preintegrated vector with `preintMeasCov()`": "-vector",
    "the residual with `preintMeasCov()`": "-raw",
}
KEPT = json.loads(page.KEPT.read_text("utf-8"))
STUDIES = KEPT["studies"]
CASES = sorted(path.stem for path in FOLDER.glob("*.py") if "\nCASE = " in path.read_text("utf-8"))


@cache
def verdict(version, kind=""):
    return cs.judge(cs.read(FOLDER / f"gtsam-{version}{kind}.npz"))


def ratio(version, kind=""):
    found = verdict(version, kind)
    low, high = found.inflation_interval
    return f"x{found.inflation:.2f} [{low:.2f}, {high:.2f}]"


# --- what is kept, and the documents -----------------------------------------------------------------


def test_the_documents_are_what_the_kept_verdicts_make_of_the_templates():
    """No figure is typed."""
    for path, text in page.pages().items():
        assert path.read_text("utf-8") == text, f"run python docs/case-studies/page.py: {path}"


def test_each_script_is_kept_and_short():
    assert {key.split()[0] for key in STUDIES} == set(CASES)
    for case in CASES:
        assert len((FOLDER / f"{case}.py").read_text("utf-8").splitlines()) <= 60, case


@pytest.mark.parametrize("key", STUDIES)
def test_controls_are_consistent_and_second_arguments_agree(key):
    """With as many runs as a plan asks for; all that is found at fault is argued twice, but for two approximations."""
    kept = STUDIES[key]
    assert "failed" not in kept
    for row in kept["rows"]:
        assert row["runs"] >= gate_runs(row["dof"], 1.5, 0.01 / row.get("parts", 1), 0.95), row
        if row["role"] == "control":
            assert row["status"] == "consistent", row
        elif row["status"] != "consistent" and not key.startswith(("filterpy_ensemble", "gtsam_isam2")):
            assert any(each["row"] == row["row"] for each in kept["arguments"]), row
    assert all(each["agrees"] for each in kept["arguments"]), kept["arguments"]


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("row", ROWS)
def test_kept_figures_of_gtsam_are_those_of_the_archives(row, version):
    kept = page.row_of(STUDIES, "gtsam_imu " + ("old" if version == "4.2.1" else "new"), row)
    assert page.ratio(kept["ratio"]) == ratio(version, ROWS[row])


@pytest.mark.parametrize("path", sorted((FOLDER / "draws").glob("*.npz")), ids=lambda path: path.stem)
def test_the_referee_says_of_the_draws_what_is_kept(path):
    with np.load(path) as stored:
        (key,) = {"covariances", "deviations"} & {*stored}
        errors, stated, axes = stored["errors"], stored[key], stored["axes"].tolist()
    named = {
        study.archive(key.split()[0], kept["version"], row["row"]): row
        for key, kept in STUDIES.items() for row in kept["rows"]
    }  # fmt: skip
    kept = named[path.name]
    found = study.told(study.verdict(kept["row"], errors, stated, axes))
    assert (found["status"], found["failed"], found["runs"]) == (kept["status"], kept["failed"], kept["runs"])
    assert_allclose(found["ratio"], kept["ratio"], rtol=1e-3)
    assert path.stat().st_size <= study.LARGEST_ARCHIVE


def test_unreported_cases_are_neither_in_the_readme_nor_on_the_landing_page():
    for name in ("README.md", "docs/index.md"):
        assert not re.search("pycolmap|Stone ?Soup.*Cubature|pykalman", (ROOT / name).read_text("utf-8")), name


def test_what_is_undecided_is_not_listed_as_a_pass():
    rows = [
        {"row": status, "role": "judged", "status": status, "ratio": [1, 0.9, 1.1], "axes": {}, "failed": 0}
        for status in ("consistent", "undecided", "overconfident")
    ]
    studies = {"some new": {"library": "some", "version": "1", "rows": rows, "arguments": []}}
    assert "| undecided |" not in page.table(studies, "passes").split("\n", 1)[1]
    assert "| undecided |" in page.table(studies, "undecided").split("\n", 2)[2]
    assert [line.split(" | ")[1] for line in page.table(studies, "found").split("\n")[2:]] == ["overconfident"]
    assert page.table({}, "undecided") == "None."


@pytest.mark.parametrize("interval, said", [
    ([2.0, 1.5, 3.0], "too small by x2.00 [1.50, 3.00]"),
    ([0.25, 0.2, 0.5], "too large by x4.00 [2.00, 5.00] (ratio 0.25)"),
    ([117.0, 20.04, 2.4e6], "too small by x117 [20.0, 2e6]"),
])  # fmt: skip
def test_both_directions_in_words(interval, said):
    assert page.words(interval) == said


def test_the_axis_that_decides():
    row = {"status": "heavy-tailed", "ratio": [0.95, 0.9, 1.0], "row": "r", "runs": 9, "failed": 2}
    row["axes"] = {"position": [0.2, 0.1, 0.3], "velocity": [0.1, 0.01, 1.2]}  # the second interval has 1
    assert page.decisive(row) == "position"
    assert page.cells(row) == "heavy-tailed, x0.95 [0.90, 1.00]; position x0.20 [0.10, 0.30]; 2 of 9 runs failed"
    assert page.decisive(row | {"ratio": [0.2, 0.1, 0.3]}) is None
    assert page.decisive(row | {"status": "consistent"}) is None


# --- the frame of the scripts -----------------------------------------------------------------------


def test_a_run_that_breaks_down_is_counted_and_the_rest_is_judged(rng):
    errors, covariances = rng.normal(size=(60, 5, 2)), np.tile(np.eye(2), (60, 5, 1, 1))
    whole = study.verdict("all", errors, covariances, ("a", "b"))
    errors[3, 2], covariances[7, 1] = np.nan, -np.eye(2)
    found = study.verdict("some", errors, covariances, ("a", "b"))
    assert [(each.run, each.step) for each in found.failures] == [(3, 3), (7, 2)]
    assert whole.failures == ()
    assert found.status != "consistent"
    assert found.inflation == pytest.approx(whole.inflation, rel=0.2)


def test_deviations_alone_are_judged_axis_by_axis_with_one_rate(rng, tmp_path):
    case = study.Case("numpy", ("a", "b"), 300, None, None, None)  # type: ignore[arg-type]
    errors, stated, axes = case.rounded(rng.normal(size=(300, 2)) * [1.0, 3.0], np.ones((300, 2)))
    assert (errors.shape, stated.shape, axes) == ((300, 1, 2), (300, 1, 2), ("a", "b"))
    found = study.verdict("x", errors, stated, axes)
    assert found.settings.false_alarm == 0.01
    assert [name for name, part in found.parts.items() if part.faults] == ["b"]  # by a factor of 9, beyond chance
    kept = study.told(found)
    assert (kept["dof"], kept["parts"], kept["status"]) == (1, 2, "overconfident")
    study.keep(tmp_path, "x.npz", errors, stated, axes)
    assert {*np.load(tmp_path / "x.npz")} == {"errors", "deviations", "axes"}
    whole = study.told(study.verdict("x", errors, np.tile(np.eye(2), (300, 1, 1, 1)), axes))
    assert (whole["dof"], whole["parts"]) == (2, 1)


def test_cases_that_share_a_control_draw_other_numbers(monkeypatch):
    drawn = []
    for name in ("one.py", "two.py", "one.py"):
        monkeypatch.setattr(sys, "argv", [name])
        seen = []
        case = study.Case(
            "numpy", ("a",), 9, lambda rng, runs, seen=seen: seen.append(rng.random()), None, lambda _: {}
        )  # type: ignore[misc, arg-type]
        assert case.rates(3)["draws"] == len(seen) == 3
        drawn.append(seen)
    assert drawn[0] == drawn[2] != drawn[1]


def test_second_arguments_are_compared():
    rows = [{"row": "r", "ratio": [2.0, 1.8, 2.2], "axes": {"a": [0.5, 0.4, 0.6]}}]
    for argument, agrees in (
        (study.Argument("r", "", 2.3), True), (study.Argument("r", "", 2.5), False),
        (study.Argument("r", "", 1.6), False),
        (study.Argument("r", "", 0.55, axis="a"), True), (study.Argument("r", "", 2.0, axis="a"), False),
        (study.Argument("r", "", [1.0, 2.0], [1.0, 2.0001]), True),
        (study.Argument("r", "", [1.0, 2.0], [1.0, 2.1]), False),
    ):  # fmt: skip
        assert argument.told(rows)["agrees"] == agrees, argument


def test_exact_ratios_of_a_linear_estimator(rng):
    """The Kalman filter has 1, with half of the covariance 2; one of a fixed gain has what 20,000 runs show."""
    F, Q = np.array([[1.0, 0.5], [0.0, 1.0]]), np.array([[0.1, 0.02], [0.02, 0.2]])
    model = linear.Model(np.array([F, 2 * F, F]), np.array([Q, Q, 3 * Q]), 0.5, np.diag([1.0, 2.0]))

    def right(data, scale=1.0):
        errors, covariances = linear.textbook(data)["textbook filter"]
        return errors, scale * covariances

    assert_allclose([each.found for each in linear.STEADY.exact("r", right)], 1.0)
    half = linear.STEADY.exact("r", lambda data: right(data, 0.5))
    assert_allclose([each.found for each in half], 2.0)

    def fixed(data):
        truth, z = data
        return truth - z[..., None] * [0.7, 0.2], np.tile([[2.0, 0.3], [0.3, 1.0]], (len(z), 4, 1, 1))

    errors, P = fixed(model.simulate(rng, 20_000))
    shown = [cs.nees(errors, P).mean() / 2, *(errors**2 / np.diagonal(P, axis1=2, axis2=3)).mean(axis=(0, 1))]
    exact = [each.found for each in model.exact("r", fixed)]
    assert_allclose(exact, shown, rtol=0.1)  # eight standard errors


def test_without_a_python_one_line_and_status_2(tmp_path):
    code = f"import sys; sys.path.insert(0, {str(FOLDER)!r}); import run; run.python()"
    hidden = "import subprocess; subprocess.run = lambda *a, **k: subprocess.CompletedProcess(a, 1); " + code
    done = subprocess.run([sys.executable, "-c", hidden], capture_output=True, text=True, check=False)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert "3.10, 3.11 or 3.12" in done.stderr


def test_an_unknown_case_is_named():
    done = subprocess.run([sys.executable, FOLDER / "run.py", "gtsam"], capture_output=True, text=True, check=False)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert "gtsam_imu" in done.stderr


# --- GTSAM's IMU factor ------------------------------------------------------------------------------


def test_the_factor_of_the_older_version_alone_is_overconfident():
    """Both are judged by the same noise; the interval has the ratio that the two covariances of 4.3.0 give."""
    old, new = (verdict(version) for version in VERSIONS)
    assert (old.status, new.status) == ("overconfident", "consistent")
    assert old.inflation_interval[0] < EXPECTED < old.inflation_interval[1]
    assert new.inflation_interval[0] < 1.0 < new.inflation_interval[1]
    assert verdict("4.2.1", "-tenth").inflation < 1.2


def test_the_figure_of_the_readme_is_that_of_the_archive():
    factor = f"by a factor of {verdict('4.2.1').inflation:.1f}"
    assert factor in " ".join((DOCS.parent / "README.md").read_text("utf-8").split())
