"""Gates in tests of an estimator, with the plugin of pytest and without it."""

import json
import sys

import inputs
import numpy as np
import pytest

import consistency as cs
from consistency.testing import ConsistencyError, InsufficientTrials, assert_consistent, assert_not_worse

TESTS = """
import numpy as np
import pytest
from scipy import stats
from consistency.testing import ConsistencyError, assert_consistent


def nees(runs, factor=1.0):
    return factor * stats.chi2.ppf((np.arange(runs) + 0.5) / runs, 3)[:, None]


def test_good(consistency_runs):
    assert_consistent(nees=nees(consistency_runs), dof=3)


def test_bad(consistency_runs):
    assert_consistent(nees=nees(consistency_runs, 2.0), dof=3)


def test_few():
    assert_consistent(nees=nees(8), dof=3)


@pytest.mark.consistency(dof=3, detect=2.0)
def test_wanted(consistency_runs):
    with pytest.raises(ConsistencyError):
        assert_consistent(nees=nees(consistency_runs, 0.5), dof=3)
"""


def errors(scale=1.0, runs=200):
    return np.asarray(scale * inputs.normal(3 * runs, 2).reshape(runs, 3, 2))


def test_a_gate_passes_and_fails():
    P = np.broadcast_to(np.eye(2), (200, 3, 2, 2))
    assert assert_consistent(errors(), P).status == "consistent"
    with pytest.raises(ConsistencyError, match="the estimator is overconfident"):
        assert_consistent(errors(1.5), P)
    with pytest.raises(ConsistencyError, match="the estimator is conservative"):
        assert_consistent(errors(0.6), P)
    assert_consistent(errors(0.6), P, allow="conservative")
    with pytest.raises(InsufficientTrials, match="consistency plan --dof 2"):
        assert_consistent(errors(runs=10), P[:10])


def test_estimates_are_compared():
    P = np.broadcast_to(np.eye(2), (200, 3, 2, 2))
    assert_not_worse(errors(), P, errors(), P)
    with pytest.raises(ConsistencyError, match="the candidate is worse"):
        assert_not_worse(errors(1.6), P, errors(), P)


def test_a_monitor_sounds_once_the_innovations_are_too_large():
    monitor = cs.Monitor()
    nis = np.square(inputs.normal(300, 2)).sum(axis=1)
    assert all(monitor.update(value, 2) is None for value in nis)
    assert any(monitor.update(4.0 * value, 2) is not None for value in nis)


@pytest.fixture
def session(pytester):
    pytester.makepyfile(test_it=TESTS)
    pytester.makeini("[pytest]\naddopts = --strict-markers -p no:cacheprovider\nfilterwarnings = error")
    return pytester


def test_a_session_with_gates(session):
    """In a process of its own, where the plugin is found as users find it."""
    result = session.run(sys.executable, "-m", "pytest", "--consistency-report=gates.json", "--junitxml=junit.xml")
    result.assert_outcomes(passed=2, failed=2)
    result.stdout.fnmatch_lines_random(
        ["*test_good *passed *102 *102 *", "*test_bad *fault found *", "*test_few *too few runs *8 *102 *"]
    )
    gates = json.loads((session.path / "gates.json").read_text())["gates"]
    assert [gate["status"] for gate in gates] == ["consistent", "overconfident", "undecided", "conservative"]
    assert (session.path / "junit.xml").read_text().count('name="consistency"') == 4


def test_a_session_with_one_false_alarm_rate(session):
    words = ("--consistency-false-alarm=0.01", "--consistency-report=gates.html")
    result = session.run(sys.executable, "-m", "pytest", *words)
    result.assert_outcomes(passed=2, failed=2)
    result.stdout.fnmatch_lines(["consistency: false-alarm budget 0.01 for the session"])
    page = (session.path / "gates.html").read_text()
    assert "test_bad" in page
    assert "://" not in page.replace("http://www.w3.org", "")


def test_a_bad_option_ends_the_session(session):
    result = session.run(sys.executable, "-m", "pytest", "--consistency-runs=0")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["*--consistency-runs must be at least 1, got 0*"])
