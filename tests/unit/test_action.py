"""The GitHub Action: its file holds what GitHub demands, and its steps do what they promise in the worked repository.

The steps are run by bash as the runner does: inputs become the variables that ``env:`` names.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import forks
import pytest
import typer
from documents import ROOT

import consistency as cs
from consistency.bench.runs.reproduce_findings import sibling
from consistency.commands.app import app

pytest.importorskip("yaml", reason="PyYAML (the extra vision) is not installed")
import action
from action import FILE, STEP_KEYS, STEPS

REPOSITORY = ROOT / "docs/examples/repository"
WORKFLOWS = [ROOT / ".github/workflows/ci.yml", REPOSITORY / ".github/workflows/consistency.yml"]
OF_THE_GATE = "import consistency.referee.show.as_md"
EXPRESSION = re.compile(r"\$\{\{\s*(.*?)\s*\}\}")


# --- what GitHub demands ------------------------------------------------------------------------------


def test_the_action_is_a_composite_one():
    assert set(FILE) == {"name", "description", "inputs", "outputs", "runs"}
    assert FILE["runs"]["using"] == "composite"
    assert set(FILE["runs"]) == {"using", "steps"}
    for name, value in FILE["inputs"].items():
        assert re.fullmatch(r"[a-z][a-z-]*", name)
        assert set(value) == {"description", "default"}
        assert isinstance(value["default"], str)
    for value in FILE["outputs"].values():
        assert set(value) == {"description", "value"}


@pytest.mark.parametrize("step", STEPS, ids=lambda step: step["name"])
def test_a_step_of_the_action(step):
    """``shell`` is demanded of each ``run``; an expression in a script would be pasted into it."""
    assert set(step) <= STEP_KEYS
    assert ("run" in step) != ("uses" in step)
    assert ("shell" in step) == ("run" in step)
    assert not EXPRESSION.search(step.get("run", ""))
    assert "run" in step or re.fullmatch(r"[\w./-]+@v\d+", step["uses"])


def test_inputs_are_used_and_what_is_used_exists():
    text = "\n".join(part.text for part in expressions(FILE))
    assert set(re.findall(r"inputs\.([\w-]+)", text)) == set(FILE["inputs"])
    ids = {step["id"] for step in STEPS if "id" in step}
    assert set(re.findall(r"steps\.([\w-]+)\.", text)) <= ids
    told = set(re.findall(r'output\("(\w+)"', (action.FOLDER / "gate.py").read_text()))
    assert set(re.findall(r"steps\.gate\.outputs\.(\w+)", text)) == told == set(FILE["outputs"])
    read = set(re.findall(r'(?:environ\.get|words)\("(\w+)"', (action.FOLDER / "gate.py").read_text()))
    assert read - {"GITHUB_OUTPUT", "GITHUB_STEP_SUMMARY"} == set(STEPS[1]["env"])


@dataclass(frozen=True)
class Part:
    text: str


def expressions(value, key=""):
    """What GitHub evaluates in a value: what stands in ``${{ }}``, and all of an ``if``."""
    if isinstance(value, dict):
        return [part for name, inner in value.items() for part in expressions(inner, str(name))]
    if isinstance(value, list):
        return [part for inner in value for part in expressions(inner)]
    return [Part(str(value))] if key == "if" else [Part(found) for found in EXPRESSION.findall(str(value))]


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_workflow_gives_inputs_that_the_action_has(path):
    """Those in the documents are among the blocks of test_documents.py."""
    text = path.read_text()
    action.require_uses(text)
    with pytest.raises(AssertionError):
        action.require_uses(text.replace(" tests: ", " test: "))


# --- what its steps do --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    status: int
    summary: str
    outputs: dict[str, str]
    log: str


def run_action(workspace, bash=True, **inputs):
    """The steps in order, up to the first that fails: by bash, or scripts of Python alone in a fork, in less time."""
    given = {name: str(value["default"]) for name, value in FILE["inputs"].items()}
    given |= {name.replace("_", "-"): value for name, value in inputs.items()}
    assert set(given) == set(FILE["inputs"])
    paths = {name: workspace.parent / name for name in ("GITHUB_OUTPUT", "GITHUB_STEP_SUMMARY")}
    for path in paths.values():
        path.write_text("")
    log, status = "", 0
    for step in STEPS:
        if "run" not in step or (step["name"] == "Install" and given["install"] == "false"):
            continue
        values = {key: evaluated(value, given) for key, value in step.get("env", {}).items()}
        environment = os.environ | {key: str(path) for key, path in paths.items()} | values
        environment |= {
            "GITHUB_ACTION_PATH": str(action.FOLDER),
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        }
        script = workspace.parent / "step.sh"
        script.write_text(step["run"])
        at = workspace / evaluated(step.get("working-directory", "."), given)
        if bash:
            words = ["bash", "--noprofile", "--norc", "-eo", "pipefail", str(script)]  # as the runner calls it
            done = subprocess.run(words, cwd=at, env=environment, capture_output=True, text=True, timeout=300)
        else:
            code = f"import os, runpy; os.environ.update({environment}); runpy.run_path(sys.argv[0], None, '__main__')"
            done = forks.done(OF_THE_GATE, code, str(action.FOLDER / "gate.py"), cwd=at)
        status, log = done.returncode, log + done.stdout + done.stderr
        if status:
            break
    found = re.findall(r"(\w+)<<(\w+)\n(.*?)\n\2\n", paths["GITHUB_OUTPUT"].read_text(), re.DOTALL)
    return Outcome(status, paths["GITHUB_STEP_SUMMARY"].read_text(), {name: text for name, _, text in found}, log)


def evaluated(text, inputs):
    return EXPRESSION.sub(lambda match: inputs[match[1].removeprefix("inputs.")], text)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    """A copy of the worked repository, with a change of its filter, and its trials; one for each change."""

    @cache
    def make(sigma_fix="0.3"):
        at = tmp_path_factory.mktemp("runner") / "workspace"
        shutil.copytree(REPOSITORY, at, ignore=shutil.ignore_patterns("__pycache__", "*.csv"))
        text = (at / "cart/ekf.py").read_text()
        assert "SIGMA_FIX = 0.3" in text
        (at / "cart/ekf.py").write_text(text.replace("SIGMA_FIX = 0.3", f"SIGMA_FIX = {sigma_fix}"))
        subprocess.run([sys.executable, "simulate.py"], cwd=at, check=True)
        return at

    return make


(USE,) = action.require_uses((REPOSITORY / ".github/workflows/consistency.yml").read_text())
INPUTS = {name.replace("-", "_"): value for name, value in USE["with"].items()} | {"install": "false"}


def test_an_honest_filter_passes(workspace):
    """False-alarm rate 1e-3 of the estimates, but their seed is the repository's; the gates have 1e-6."""
    done = run_action(workspace(), **INPUTS)
    assert done.status == 0, done.log
    assert done.summary.startswith("## Consistency: pass\n\n| what | verdict |")
    lines = done.summary.splitlines()[4:-1]
    assert [line.split(" | ")[1] for line in lines] == [
        "consistent", "overconfident (expected)", "consistent", "not worse",
    ]  # fmt: skip
    assert all(len(re.findall(r"(?<!\\)\|", line)) == 6 for line in lines)
    assert all(re.fullmatch(r"x[12]\.\d+ \[\d.*\]", line.split(" | ")[2]) for line in lines[:3])
    report = Path(done.outputs["report"])
    assert (done.outputs["verdict"], report.name) == ("pass", "consistency-report")
    assert {"gates.json", "estimates"} == {path.name for path in report.iterdir()}
    assert (report / "estimates/report.html").exists()


@pytest.mark.slow
def test_an_overconfident_filter_fails(workspace):
    done = run_action(workspace("0.2"), **{**INPUTS, "fail_on": "worse", "tests": ""})
    assert done.status == 1, done.log
    assert done.outputs["verdict"] == "fail"
    assert re.search(
        r"\| estimates.csv: estimates \| overconfident \| x1\.\d+ \[1\.\d+, \d\.\d+\] \| 120 ", done.summary
    )
    assert "covariance too small by" in done.summary
    assert "| worse |" in done.summary
    assert "::error" in done.log


def test_a_gate_that_fails_is_in_the_summary(workspace):
    done = run_action(workspace("0.15"), install="false", tests="tests -k consistent")
    assert (done.status, done.outputs["verdict"]) == (1, "fail")
    assert "test_the_ekf_is_consistent | overconfident | x" in done.summary


def test_runs_of_a_program_get_a_report(tmp_path):
    """Three runs decide nothing, so the job fails."""
    at = tmp_path / "workspace"
    at.mkdir()
    row = "printf 'step,a,P_a_a,true_a\\n1,0.{seed},1,0\\n2,0.{run},1,0\\n' > estimates.csv"
    cs.monte_carlo(["sh", "-c", row], 3, out=at / "gate", state=["a"])
    done = run_action(at, bash=False, install="false", estimates="gate")
    assert (done.status, done.outputs["verdict"]) == (1, "fail")
    assert "| gate: sh | undecided |" in done.summary
    assert (at / "consistency-report/gate/report.html").exists()


WRONG = {
    "nothing to judge": ({}, "neither tests nor estimates are given"),
    "no such file": ({"estimates": "nowhere.csv"}, "estimates: nowhere.csv: no such file"),
    "no truth": ({"estimates": "estimates.csv"}, "estimates: estimates.csv: exit status 2; the log says why"),
    "unknown fail-on": ({"tests": "tests", "fail_on": "always"}, "fail-on: must be one of inconsistent, worse, noth"),
    "two to compare": ({"estimates": "a.csv\nb.csv", "compare_with": "old.json"}, "compare-with: needs one entry"),
    "worse than what": ({"estimates": "estimates.csv", "fail_on": "worse"}, "worse than what?"),
    "no such tests": ({"tests": "nowhere"}, "tests: nowhere: pytest ended with exit status 4"),
    "no test": ({"tests": "tests -k nothing_of_that_name"}, "no test was found"),
    "no gate": ({"tests": "test_plain.py"}, "no gate ran"),
    "open quote": ({"tests": "'tests"}, "tests: No closing quotation"),
    "a file for the reports": ({"tests": "tests", "report": "simulate.py"}, "is not a folder"),
    "no such baseline": ({"estimates": "estimates.csv", "compare_with": "old.json"}, "compare-with: old.json: no such"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_wrong_inputs(workspace, case):
    """Exit 2 and one line that names the input, in the log and in the summary."""
    inputs, expected = WRONG[case]
    at = workspace()
    (at / "test_plain.py").write_text("def test_plain():\n    pass\n")
    done = run_action(at, bash=case == "nothing to judge", install="false", **inputs)
    assert done.status == 2, done.log
    (line,) = re.findall(r"^::error title=Consistency gate::(.*)$", done.log, re.MULTILINE)
    assert expected in line
    assert done.outputs["verdict"] == "unusable"
    assert done.summary.startswith("## Consistency: unusable\n")
    assert "Traceback" not in done.log


@pytest.fixture
def gate():
    return sibling(str(action.FOLDER / "action.yml"), "gate")


@pytest.mark.parametrize(
    "tests, consistent, no_worse, fail_on, status, verdict",
    [
        (True, True, True, "inconsistent", 0, "pass"), (False, True, True, "inconsistent", 1, "fail"),
        (True, False, True, "inconsistent", 1, "fail"), (True, True, False, "inconsistent", 1, "fail"),
        (True, False, True, "worse", 0, "pass"), (False, True, True, "worse", 1, "fail"),
        (True, True, False, "worse", 1, "fail"), (False, False, False, "nothing", 0, "fail"),
    ],
)  # fmt: skip
def test_what_fails_the_job(
    gate, tests, consistent, no_worse, fail_on, status, verdict,
    tmp_path, monkeypatch,
):  # fmt: skip
    for name, good in (("run_tests", tests), ("judge", consistent), ("compare", no_worse)):
        monkeypatch.setattr(gate, name, lambda *given, good=good: (good, [gate.Row("what", "verdict", "", "1", "why")]))
    for name in ("old.json", "est.csv"):
        (tmp_path / name).touch()
    monkeypatch.chdir(tmp_path)
    given = {"TESTS": "tests", "ESTIMATES": " est.csv \n\n", "COMPARE_WITH": "old.json", "FAIL_ON": fail_on}
    for name, value in {**given, "GITHUB_OUTPUT": "out.txt", "GITHUB_STEP_SUMMARY": "summary.md"}.items():
        monkeypatch.setenv(name, value)
    assert gate.main() == status
    assert f"\n{verdict}\n" in (tmp_path / "out.txt").read_text()
    assert (tmp_path / "summary.md").read_text().count("| what | verdict |") == 1 + 3


def test_a_cell_of_the_summary_cannot_break_the_table(gate):
    row = gate.Row("test[a|b]", "failed", "", "1", "<img src=x>\nand `code` & more")
    line = gate.markdown("fail", [row]).splitlines()[4]
    assert line == "| test\\[a\\|b] | failed |  | 1 | &lt;img src=x> and \\`code\\` &amp; more |"


def test_names_are_no_commands_of_the_runner(gate, tmp_path, monkeypatch, capfd):
    """A runner takes a line that begins with :: for a command, unless a mark has stopped that."""
    hostile = "ekf\n::add-mask::x\r::warning::y\x1b[2J"
    (tmp_path / "loud.py").write_text("import sys; print('::set-output name=a::b', file=sys.stderr); print('{}')")
    call = f"import gate; assert gate.run('loud', {hostile!r}) == (0, '{{}}\\n')"
    environment = os.environ | {"PYTHONPATH": f"{action.FOLDER}:{tmp_path}"}
    together = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    log = subprocess.run([sys.executable, "-c", call], env=environment, **together, check=True).stdout
    assert "::set-output" in log
    assert commands(log) == []
    monkeypatch.setattr(gate, "read_inputs", lambda: gate.Inputs(["tests"], [], [], "", "inconsistent", tmp_path))
    monkeypatch.setattr(gate, "run_tests", lambda given: (False, [gate.Row(hostile, "failed", "", "1", hostile)]))
    for name in ("GITHUB_OUTPUT", "GITHUB_STEP_SUMMARY"):
        monkeypatch.setenv(name, str(tmp_path / name))
    assert gate.main() == 1
    monkeypatch.setattr(gate, "read_inputs", lambda: (_ for _ in ()).throw(gate.Unusable(f"{hostile} of 5%0A")))
    assert gate.main() == 2
    assert "\x1b" not in (said := "".join(capfd.readouterr()))
    assert commands(said) == [
        "::error title=Consistency gate::an estimator test failed; the summary has the verdicts",
        "::error title=Consistency gate::ekf ::add-mask::x ::warning::y [2J of 5%250A",
    ]


def commands(log):
    """Those that the runner obeys, as its ActionCommandManager does."""
    found, mark = [], ""
    for line in map(str.strip, re.split("[\r\n]", log)):
        if mark:
            mark = "" if line == f"::{mark}::" else mark
        elif line.startswith("::stop-commands::"):
            mark = line.removeprefix("::stop-commands::")
        elif line.startswith("::"):
            found.append(line)
    return found


def test_options_that_compare_lacks_are_left_out(gate):
    options = ["--truth", "t.csv", "--detect", "2", "--tolerance=1.1", "--error", "so2"]
    assert gate.shared(options) == ["--truth", "t.csv", "--error", "so2"]
    lacking = {option for option in options_of("analyse") - options_of("compare") if option in gate.OF_ANALYSE}
    assert lacking == set(gate.OF_ANALYSE)


def options_of(name):
    command = typer.main.get_command(app).commands[name]
    return {option for parameter in command.params for option in parameter.opts}


def test_an_input_is_never_run_by_the_shell(workspace):
    at = workspace()
    hostile = '$(touch broken) `touch broken`; touch broken #"'
    names = ("estimates", "compare_with", "report", "tests", "options", "fail_on")
    assert run_action(at, install="false", **dict.fromkeys(names, hostile)).status == 2
    for name in names:
        done = run_action(at, bash=False, **{"install": "false", "estimates": "estimates.csv", name: hostile})
        assert done.status == 2, name
    assert not (at / "broken").exists()


def test_installs_what_is_asked_for(workspace, tmp_path, monkeypatch):
    """By a stand-in for pip: the version of the action itself by default."""
    bin = tmp_path / "bin"
    bin.mkdir()
    fake = bin / "python"
    fake.write_text(f'#!/bin/sh\nprintf "%s\\n" "$@" >> {tmp_path}/said\nexit 3\n')
    fake.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(fake))
    at = tmp_path / "empty"
    at.mkdir()
    assert run_action(at, tests="tests").status == 3
    *_, source, pytest_ = (tmp_path / "said").read_text().split("\n")[:-1]
    assert pytest_ == "pytest"
    assert Path(source.removesuffix("[report]")).resolve() == ROOT
    assert source.endswith("[report]")
    assert run_action(at, tests="tests", package="filter-consistency==0.1.0; touch broken").status == 3
    assert "filter-consistency==0.1.0; touch broken\npytest\n" in (tmp_path / "said").read_text()
    assert not (at / "broken").exists()
