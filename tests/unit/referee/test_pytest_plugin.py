"""The pytest plugin, in sessions of its own.

The samples are quantiles, not draws: a gate's p value is what the test asks for, and nothing here is left to chance.
"""

from __future__ import annotations

import json
import subprocess
import sys
import xml.etree.ElementTree as ET
from html.parser import HTMLParser

import pytest
from hypothesis import given
from hypothesis import strategies as st

from consistency.diagnostics import gate_runs
from consistency.referee.gating.session import FIRST, final_rate, in_place_rate, path_fault

SAMPLES = '''
import numpy as np
import pytest
from scipy import optimize, stats

from consistency.diagnostics import compare, judge, make_record, summary
from consistency.testing import ConsistencyError, InsufficientTrials, assert_consistent, assert_not_worse


def nees(runs, factor=1.0):
    """NEES of one step and 3 components: the quantiles of chi-square, times a factor."""
    return factor * stats.chi2.ppf((np.arange(runs) + 0.5) / runs, 3)[:, None]


def nees_with(p, runs):
    """NEES just so much too large that the verdict's p value is p."""
    def excess(log_factor):
        return np.log(judge(make_record("", nees=nees(runs, np.exp(log_factor)), dof=3)).p_value / p)
    return nees(runs, np.exp(optimize.brentq(excess, 0.01, 1.5)))


def gate(values, **options):
    return assert_consistent(nees=values, dof=3, **options)
'''


@pytest.fixture
def session(pytester):
    """A folder with a module of samples; plugins of the outer session that inner ones do not need are off."""
    pytester.makepyfile(samples=SAMPLES)
    # in this process modules of the distribution may be loaded before the inner session looks at them
    filters = "error\n    ignore:Module already imported so cannot be rewritten"
    pytester.makeini(f"[pytest]\naddopts = --strict-markers -p no:cacheprovider\nfilterwarnings =\n    {filters}")
    return pytester


def make(session, tests, name="test_it"):
    session.makepyfile(**{name: "from samples import *\n" + tests})


def run(session, tests, *options):
    """The session of a module of tests."""
    make(session, tests)
    return session.runpytest(*options)


def gates_of(path):
    data = json.loads((path / "gates.json").read_text())
    return list(data["gates"])


# --- the record --------------------------------------------------------------------------------


THREE = """
def test_good(consistency_runs):
    gate(nees(consistency_runs), name="mine")

def test_bad(consistency_runs):
    gate(nees(consistency_runs, 2.0))

def test_few():
    gate(nees(8))

def test_wanted(consistency_runs):
    with pytest.raises(ConsistencyError):
        gate(nees(consistency_runs, 0.5))

def test_without():
    pass
"""


def test_gates_are_summed_up_and_written(session):
    result = run(session, THREE, "--consistency-report=gates.json", "--junitxml=junit.xml")
    result.assert_outcomes(passed=3, failed=2)
    assert result.ret == pytest.ExitCode.TESTS_FAILED
    result.stdout.fnmatch_lines(["E *ConsistencyError: assert_consistent: the estimator is overconfident*"])
    result.stdout.fnmatch_lines(["*InsufficientTrials: *consistency plan --dof 3 --detect 1.5 --false-alarm 0.001*"])
    result.stdout.fnmatch_lines_random(
        [
            "*= consistency gates =*",
            "test_it.py::test_good *assert_consistent *passed *102 *102 *",
            "test_it.py::test_bad *fault found *<1e-6 *",
            "    the estimator is overconfident*covariance too small by x2*",
            "test_it.py::test_few *too few runs *8 *102 *",
            "test_it.py::test_wanted *fault found (expected) *",
            "4 gates, 2 failed, 1 failed as expected; probability that any fails without a fault at most 0.003",
        ]
    )
    gates = {each["test"].split("::")[1]: each for each in gates_of(session.path)}
    assert set(gates) == {"test_good", "test_bad", "test_few", "test_wanted"}
    assert (gates["test_good"]["name"], gates["test_good"]["test_outcome"]) == ("mine", "passed")
    bad = gates["test_bad"]
    assert (bad["outcome"], bad["status"], bad["runs"], bad["needed"]) == ("fault found", "overconfident", 102, 102)
    assert bad["p_value"] < 1e-3
    assert bad["inflation_interval"][0] < bad["inflation"] < bad["inflation_interval"][1]
    assert len(bad["statistics"]["anees"]) == 1
    junit = ET.parse(session.path / "junit.xml").getroot()
    kept = [p for p in junit.iter("property") if p.get("name") == "consistency"]
    assert sorted(json.loads(p.get("value", ""))["outcome"] for p in kept) == [
        "fault found", "fault found", "passed", "too few runs",
    ]  # fmt: skip


def test_each_gate_that_fails_has_a_page(session):
    """Not those that pass, nor those that a test expects to fail; the table names the file."""
    make(session, THREE)
    # a process: the library that draws would be loaded twice in this one
    result = session.runpytest_subprocess("--consistency-pages=look", "--consistency-report=gates.html")
    names = sorted(path.name for path in (session.path / "look").iterdir())
    assert names == ["test_it.py-test_bad-1.html", "test_it.py-test_few-1.html"]
    page = (session.path / "look" / names[0]).read_text()
    assert "the estimator is overconfident" in page
    result.stdout.fnmatch_lines([f"page of test_it.py::test_bad: *look?{names[0]}"])
    result.stdout.no_fnmatch_line("page of test_it.py::test_wanted*")
    assert f"page: {session.path / 'look' / names[0]}" in (session.path / "gates.html").read_text()


def test_no_gates_no_table(session):
    result = run(session, "def test_without():\n    pass", "--consistency-report=gates.json")
    result.assert_outcomes(passed=1)
    result.stdout.no_fnmatch_line("*consistency gates*")
    assert gates_of(session.path) == []


def test_what_is_not_finite_is_null(session):
    run(
        session,
        "def test_innovations():\n    assert_consistent(nis=nees(9), nis_dof=3, detect=9.0, optimal_gain=True)",
        "--consistency-report=gates.json",
    ).assert_outcomes(passed=1)
    (gate,) = gates_of(session.path)
    assert gate["inflation"] is None


def test_a_comparison_is_recorded(session):
    result = run(
        session,
        "def test_it(consistency_runs):\n"
        "    good = nees(consistency_runs)\n"
        "    assert_not_worse(nees_a=good, nees_b=good, dof=3)\n"
        "    assert_not_worse(nees_a=3.0 * good, nees_b=good, dof=3)\n",
        "--consistency-report=gates.json",
        "--consistency-false-alarm=1e-3",
    )
    result.assert_outcomes(failed=1)
    good, bad = gates_of(session.path)
    assert (good["gate"], good["status"], good["outcome"]) == ("assert_not_worse", "not worse", "passed")
    assert (bad["status"], bad["outcome"]) == ("worse", "fault found")


class Page(HTMLParser):
    """Tags of a page that is well formed, and what it loads from elsewhere."""

    def __init__(self):
        super().__init__()
        self.open: list[str] = []
        self.seen: list[str] = []
        self.loaded: list[str] = []

    def handle_starttag(self, tag, attributes):
        self.seen.append(tag)
        self.loaded += [
            value or "" for key, value in attributes if key in ("src", "href") and value not in ("data:,", "#content")
        ]
        if tag not in ("meta", "link"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_stands_alone(session):
    make(session, "def test_it():\n    gate(nees(200), name='<b>mine & yours')")
    session.runpytest("--consistency-report=gates.html").assert_outcomes(passed=1)
    text = (session.path / "gates.html").read_text(encoding="utf-8")
    page = Page()
    page.feed(text)
    assert page.open == []
    assert page.loaded == []
    assert page.seen.count("tr") == 2
    assert "&lt;b&gt;mine &amp; yours" in text
    assert "prefers-color-scheme: dark" in text
    assert "1 gate, 0 failed" in text


@pytest.mark.parametrize(
    "options, said",
    [
        (["--consistency-report=gates.txt"], "must end in .html or .json or .md or .xml"),
        (["--consistency-report=nowhere/gates.json"], "nowhere does not exist; make it first"),
        (["--consistency-report=folder.json"], "is a folder"),
        (["--consistency-report=folder.html"], "--consistency-pages *folder.html"),
        (["--consistency-pages=samples.py"], "--consistency-pages *samples.py: cannot be written"),
        (["--consistency-false-alarm=1.5"], "--consistency-false-alarm must lie between 0 and 1, got 1.5"),
        (["-o", "consistency_false_alarm=few"], "consistency_false_alarm must be a number, got 'few'"),
    ],
)
def test_unusable_options_stop_before_the_tests(session, options, said):
    make(session, "def test_it():\n    open('ran', 'w').close()")
    (session.path / "folder.json").mkdir()
    (session.path / "folder.html").mkdir()
    result = session.runpytest(*options)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines([f"ERROR: *{said}*"])
    assert not (session.path / "ran").exists()


def test_a_folder_without_leave_is_refused(tmp_path, monkeypatch):
    def refuse(**_):
        raise PermissionError(13, "Permission denied")

    assert path_fault(tmp_path / "gates.json") == ""
    monkeypatch.setattr("tempfile.TemporaryFile", refuse)
    assert "cannot be written (Permission denied); name another file" in path_fault(tmp_path / "gates.json")


# --- runs to simulate ----------------------------------------------------------------------------


def test_the_marker_plans_and_is_asked(session):
    run(
        session,
        "@pytest.mark.consistency(dof=3, detect=2.0, false_alarm=1e-4)\n"
        "class TestIt:\n"
        "    def test_class(self, consistency_runs):\n"
        f"        assert consistency_runs == {gate_runs(3, 2.0, 1e-4, 0.95)}\n"
        "        assert_consistent(nees=nees(consistency_runs))\n"
        "    @pytest.mark.consistency(detect=1.5, allow='conservative')\n"
        "    def test_nearest(self, consistency_runs):\n"
        f"        assert consistency_runs == {gate_runs(3, 1.5, 1e-4, 0.95, 'conservative')}\n"
        "        gate(nees(consistency_runs, 0.3))\n"
        "        with pytest.raises(InsufficientTrials):\n"
        "            gate(nees(9), detect=1.2)\n",
        "--consistency-report=gates.json",
    ).assert_outcomes(passed=2)
    assert [each["false_alarm"] for each in gates_of(session.path)] == [1e-4] * 3
    assert session.runpytest("--markers").ret == 0


def test_the_marker_that_plans_enough_runs_is_named(session):
    """Of a gate with an error of fewer dimensions than the fixture has planned for."""
    run(
        session,
        "def few(n, runs, **more):\n"
        "    nees = np.random.default_rng(1).chisquare(n, (runs // 8, 1))\n"
        "    with pytest.raises(InsufficientTrials) as info:\n"
        "        assert_consistent(nees=nees, dof=n, false_alarm=1e-12, **more)\n"
        "    return str(info.value)\n"
        "def test_one(consistency_runs):\n"
        f"    assert 'with @pytest.mark.consistency(dof=1) at this test it gives {gate_runs(1, 1.5, 1e-3, 0.95)} runs' "
        "in few(1, consistency_runs)\n"
        f"    assert 'consistency(dof=2) at this test it gives {gate_runs(2, 1.5, 1e-3, 0.95)} runs' "
        "in few(2, consistency_runs)\n"
        "    assert '@pytest.mark' not in few(3, consistency_runs)\n"
        "    assert '@pytest.mark' not in few(4, consistency_runs // 4)\n"
        "@pytest.mark.consistency(dof=1)\n"
        "def test_marked(consistency_runs):\n"
        "    assert '@pytest.mark' not in few(1, consistency_runs)\n"
        "@pytest.mark.consistency(detect=2.0)\n"
        "def test_detect(consistency_runs):\n"
        f"    assert 'it gives {gate_runs(1, 2.0, 1e-3, 0.95)} runs' in few(1, consistency_runs, detect=2.0)\n"
        "def test_unasked():\n"
        "    assert '@pytest.mark' not in few(1, 100)\n",
    ).assert_outcomes(passed=4)
    run(
        session,
        "def test_given(consistency_runs):\n"
        "    with pytest.raises(InsufficientTrials) as info:\n"
        "        assert_consistent(nees=np.ones((consistency_runs, 1)), dof=1, false_alarm=1e-12)\n"
        "    assert '@pytest.mark' not in str(info.value)\n",
        "--consistency-runs=5",
    ).assert_outcomes(passed=1)


def test_runs_from_the_command_line(session):
    run(
        session,
        "@pytest.mark.consistency(detect=2.0)\n"
        "def test_it(consistency_runs):\n"
        "    assert consistency_runs == 500\n"
        "    gate(nees(consistency_runs))",
        "--consistency-runs=500",
    ).assert_outcomes(passed=1)


def test_a_marker_with_other_arguments(session):
    result = run(session, "@pytest.mark.consistency(3, runs=7)\ndef test_it():\n    pass")
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(["marker consistency: takes dof, detect, * as keywords, got 3, runs"])


# --- the budget ----------------------------------------------------------------------------------


@given(st.floats(1e-9, 0.5), st.lists(st.integers(0, 60), min_size=1, max_size=12))
def test_the_budget_is_spent_and_not_more(budget, gates):
    """Whatever the numbers of gates of the tests: the rates at which they can fail add up to the budget."""
    spent = [in_place_rate(budget, len(gates), before) for count in gates for before in range(count)]
    if not spent:
        return
    rate = final_rate(budget, spent)
    assert sum(max(rate, early) for early in spent) == pytest.approx(budget, rel=1e-9)
    if len(spent) <= 2 * FIRST * len(gates):
        assert rate == budget / len(spent)
    assert rate >= 0.5 * budget / len(spent)


LATE = """
def test_near(consistency_runs):
    verdict = gate(nees_with(3e-4, consistency_runs), name="mine")
    assert verdict.consistent

def test_far(consistency_runs):
    gate(nees_with(6e-4, consistency_runs))

def test_good(consistency_runs):
    gate(nees(consistency_runs))

def test_own_rate(consistency_runs):
    gate(nees_with(6e-4, consistency_runs), false_alarm=1e-4)
"""


@pytest.mark.parametrize("workers", [[], ["-n", "2"]], ids=["one process", "xdist"])
def test_a_gate_can_fail_at_the_end(session, workers):
    """Three gates share 1e-3: p = 3e-4 is a fault, p = 6e-4 is none."""
    make(session, LATE)
    options = ["--consistency-false-alarm=1e-3", "--consistency-report=gates.json", "--junitxml=junit.xml"]
    result = session.runpytest(*workers, *options)
    result.assert_outcomes(passed=3, failed=1)
    assert result.ret == pytest.ExitCode.TESTS_FAILED
    result.stdout.fnmatch_lines(
        [
            "consistency: false-alarm budget 0.001 for the session",
            "assert_consistent: mine is overconfident*",
            "  - *",
            "Judged at the end of the session: its budget of 0.001 over 3 gates is 0.000333 for each.",
            "*= consistency gates =*",
        ]
    )
    result.stdout.fnmatch_lines(["FAILED test_it.py::test_near*"])
    result.stdout.fnmatch_lines(["4 gates, 1 failed; * at most 0.0011 (budget 0.001: 0.000333 for a gate)"])
    gates = {each["test"].split("::")[1]: each for each in gates_of(session.path)}
    assert {name: each["outcome"] for name, each in gates.items()} == {
        "test_near": "fault found", "test_far": "passed", "test_good": "passed", "test_own_rate": "passed",
    }  # fmt: skip
    assert (gates["test_near"]["status"], gates["test_far"]["status"]) == ("overconfident", "consistent")
    assert gates["test_near"]["test_outcome"] == "failed"
    assert gates["test_far"]["false_alarm"] == pytest.approx(1e-3 / 3)
    junit = ET.parse(session.path / "junit.xml").getroot()
    failed = [case.get("name") for case in junit.iter("testcase") if case.find("failure") is not None]
    assert failed == ["test_near"]


def test_the_budget_of_the_ini_file(session):
    make(session, LATE)
    session.makeini("[pytest]\nconsistency_false_alarm = 2.5e-3")
    session.runpytest().assert_outcomes(passed=2, failed=2)
    session.runpytest("--consistency-false-alarm=1e-3").assert_outcomes(passed=3, failed=1)


def test_what_is_certain_fails_in_place(session):
    result = run(
        session,
        "def test_it(consistency_runs):\n    gate(nees(consistency_runs, 3.0))\n    open('went on', 'w')",
        "--consistency-false-alarm=1e-3",
    )
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["E *ConsistencyError*"])
    assert not (session.path / "went on").exists()


def test_planned_runs_suffice_for_the_budget(session):
    """Twenty gates in one test are as many as the plan allows for."""
    run(
        session,
        "def test_it(consistency_runs):\n    for _ in range(20):\n        gate(nees(consistency_runs))",
        "--consistency-false-alarm=1e-3",
    ).assert_outcomes(passed=1)


def test_what_is_shown_passes_at_any_share_of_the_budget(session):
    """That a filter is right is shown at a rate that no budget divides: fewer runs than planned may do."""
    runs = gate_runs(3, 1.5, 1e-3, 0.95)
    run(
        session,
        f"@pytest.mark.parametrize('i', range(4))\ndef test_it(i):\n    gate(nees({runs} - 9 * i))",
        "--consistency-false-alarm=1e-3",
    ).assert_outcomes(passed=4)


def test_too_few_to_compare_can_show_at_the_end(session):
    """Enough for the whole budget, too few for a fifth of it."""
    result = run(
        session,
        "values = np.random.default_rng(0).chisquare(3, (2, 400, 1))\n"
        "@pytest.mark.parametrize('i', range(5))\n"
        "def test_it(i):\n"
        "    runs = 400 if i else FEW\n"
        "    assert_not_worse(nees_a=values[0, :runs], nees_b=values[1, :runs], dof=3, detect=2.0)\n"
        "FEW = next(n for n in range(8, 400) if "
        "compare(*(summary(v[:n], 3) for v in values), 1e-3).needed_runs(2.0, 0.95) <= n)\n",
        "--consistency-false-alarm=1e-3",
    )
    result.assert_outcomes(passed=4, failed=1)
    result.stdout.fnmatch_lines(["*is not found worse, but * runs are too few to pass: *"])


def test_too_few_to_decide_fail_in_place(session):
    """And asks for the number that will do."""
    result = run(session, "def test_it():\n    gate(nees(8))", "--consistency-false-alarm=1e-3")
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines([f"E *Simulate {gate_runs(3, 1.5, in_place_rate(1e-3, 1), 0.95)} runs*"])


def test_a_gate_that_a_test_expects_to_fail_stays_so(session):
    result = run(
        session,
        "def test_it(consistency_runs):\n"
        "    with pytest.raises(ConsistencyError):\n"
        "        gate(nees(consistency_runs, 3.0))\n"
        "@pytest.mark.xfail\n"
        "def test_known(consistency_runs):\n"
        "    gate(nees_with(1e-4, consistency_runs))\n",
        "--consistency-false-alarm=1e-3",
    )
    result.assert_outcomes(passed=1, xpassed=1)
    assert result.ret == 0


def test_many_gates_wait_for_the_end(session):
    """From the eleventh on nothing fails in place; 25 gates, so the first ten have had half the budget."""
    result = run(
        session,
        "def test_it():\n"
        "    for i in range(25):\n"
        "        gate(nees(300, 3.0 if i >= 20 else 1.0))\n"
        "    open('went on', 'w').close()",
        "--consistency-false-alarm=1e-3",
    )
    result.assert_outcomes(failed=1)
    assert (session.path / "went on").exists()
    result.stdout.fnmatch_lines(["25 gates, 5 failed; * at most 0.001 (budget 0.001: 3.33e-05 for a gate)"])


# --- neighbours ----------------------------------------------------------------------------------


def test_gates_work_without_the_plugin(session):
    make(session, "def test_good():\n    gate(nees(102))\n\ndef test_bad():\n    gate(nees(102, 2.0))")
    result = session.runpytest_subprocess("-p", "no:consistency")
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.no_fnmatch_line("*consistency gates*")


def test_gates_work_without_pytest(tmp_path):
    code = (
        "import sys\n"
        "sys.modules['pytest'] = None\n"
        "from consistency.testing import assert_consistent, ConsistencyError\n"
        "try:\n"
        "    assert_consistent(nees=[[90.0]] * 9, dof=3)\n"
        "except ConsistencyError as error:\n"
        "    print(error.verdict.status)\n"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert out.stdout == "overconfident\n"


def test_a_second_try_replaces_the_first(session):
    """As plugins do that run a failed test again: the gates of the last try count."""
    session.makeconftest(
        "from _pytest.runner import runtestprotocol\n"
        "def pytest_runtest_protocol(item, nextitem):\n"
        "    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)\n"
        "    runtestprotocol(item, nextitem=nextitem, log=False)\n"
        "    runtestprotocol(item, nextitem=nextitem)\n"
        "    return True\n"
    )
    result = run(
        session,
        "tries = []\ndef test_it():\n    tries.append(1)\n    gate(nees(102, 2.0 if len(tries) < 2 else 1.0))",
        "--consistency-report=gates.json",
    )
    result.assert_outcomes(passed=1)
    assert [each["outcome"] for each in gates_of(session.path)] == ["passed"]
