"""Planning, early stopping, comparisons and baselines as a newcomer types them."""

import json

import pytest
from own_process import consistency

from consistency.bench.scenario import data_folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """``small.toml``, a short world in which stereo points make the EKF inconsistent, and ``out``, 12 runs in it."""
    at = tmp_path_factory.mktemp("referee")
    scenario = (data_folder("scenarios") / "herath2007-stereo.toml").read_text()
    (at / "small.toml").write_text(scenario.replace("steps = 500", "steps = 120"))
    filters = ("--filter", "ekf-xyz", "--filter", "ekf-uvd")
    consistency("run", "small.toml", *filters, "--runs", "12", "--out", "out", cwd=at)
    return at


def test_plan(tmp_path):
    done = consistency(
        "plan", "--dof", "3", "--detect", "1.2", "--false-alarm", "0.05", "--power", "0.95", cwd=tmp_path
    )
    assert "301 runs" in done.stdout
    assert "260 runs would do for a single chi-square test" in done.stdout
    done = consistency("plan", "--detect", "2", "--json", cwd=tmp_path)
    assert json.loads(done.stdout)["one_step"] == 18


def test_plan_by_a_pilot(folder, tmp_path):
    """A run is worth at least what its pilot shows, and a plan never takes more runs than the worst case."""
    consistency("run", "linear-gaussian", "--filter", "kf", "--runs", "25", "--out", "pilot", cwd=tmp_path)
    pilot = json.loads(consistency("plan", "--like", "pilot", "--detect", "1.2", "--json", cwd=tmp_path).stdout)
    assert pilot["runs"] == 301
    assert 20 <= pilot["like"]["kf"]["runs"] <= 301
    assert pilot["like"]["kf"]["effective_dof"] >= 3.0
    done = consistency("plan", "linear-gaussian", "--filter", "kf", "--pilot-runs", "20", "--json", cwd=tmp_path)
    assert json.loads(done.stdout)["like"]["kf"]["pilot_runs"] == 20
    consistency("plan", "--like", str(folder / "out"), cwd=tmp_path, status=2)  # 12 runs are no pilot


def test_what_is_shown_depends_on_what_is_asked(folder):
    """12 runs do not show a ratio of 1.01; a confidence is 1 less a false-alarm rate."""
    verdicts = json.loads(
        consistency("analyse", "out", "--detect", "1.01", "--false-alarm", "1e-12", "--json", cwd=folder).stdout
    )
    for verdict in verdicts.values():
        assert verdict["statistics"]["equivalence"]["factor"] == 1.01
        assert verdict["status"] != "consistent"
    rates = (("--confidence", "0.9"), ("--false-alarm", "0.1"))
    printed = [json.loads(consistency("analyse", "out", *rate, "--json", cwd=folder).stdout) for rate in rates]
    accepted = [verdicts["ekf-uvd"]["statistics"]["acceptance"] for verdicts in printed]
    assert accepted[0] == pytest.approx(accepted[1])


@pytest.mark.parametrize(
    "arguments, said",
    [
        (("plan", "--detect", "1"), "--detect must be positive and not 1"),
        (("plan", "--power", "2"), "--power must lie between 0 and 1, got 2"),
        (("plan", "--dof", "0"), "--dof must be at least 1"),
        (("plan", "--allow", "all"), "--allow must be 'conservative'"),
        (("run", "linear-gaussian", "--filter", "kf", "--max-runs", "5", "--out", "o"), "--max-runs goes with"),
        (("run", "linear-gaussian", "--filter", "kf", "--until-decided", "--runs", "5", "--out", "o"), "--max-runs"),
        (
            ("run", "linear-gaussian", "--filter", "kf", "--until-decided", "--false-alarm", "3", "--out", "o"),
            "--false-alarm must lie between 0 and 1, got 3",
        ),
        (("compare", "nowhere"), "nowhere: cannot be read"),
        (("plan", "linear-gaussian"), "--filter: name the filter to plan for in linear-gaussian"),
        (("plan", "linear-gaussian", "--like", "out"), "either a SCENARIO for a pilot or --like RESULTS"),
        (("plan", "--filter", "kf"), "--filter goes with a SCENARIO or --like RESULTS"),
        (
            ("plan", "linear-gaussian", "--filter", "kf", "--dof", "2"),
            "--dof 2: results of the bench have 3",
        ),
        (("plan", "linear-gaussian", "--filter", "kf", "--pilot-runs", "5"), "a pilot needs at least 20 runs"),
        (("analyse", "out", "--detect", "1"), "--detect must be a positive ratio of true to stated covariance, not 1"),
        (("analyse", "out", "--tolerance", "-2"), "--tolerance must be a positive ratio"),
        (("analyse", "out", "--false-alarm", "0"), "--false-alarm must lie between 0 and 1, got 0.0"),
        (("analyse", "out", "--confidence", "0.9", "--false-alarm", "0.1"), "--confidence is 1 less --false-alarm"),
        (("analyse", "out", "--innovations", "white"), "--innovations must be 'optimal', got 'white'"),
        (("compare", "nowhere", "--fail-on", "sun"), "--fail-on must be 'worse'"),
    ],
)
def test_bad_input(refused, arguments, said, tmp_path):
    assert said in refused(tmp_path, *arguments)


def test_until_decided_stops_at_the_first_look_and_says_so(folder):
    done = consistency("run", "small.toml", "--filter", "ekf-xyz", "--until-decided", "--out", "decided", cwd=folder)
    first = json.loads(consistency("plan", "--json", cwd=folder).stdout)["looks"][0]
    assert f"{first} runs: ekf-xyz overconfident" in done.stderr
    manifest = json.loads((folder / "decided/manifest.json").read_text())
    assert manifest["runs"] == first
    assert manifest["until_decided"]["detect"] == 1.5


def test_undecided_is_a_verdict(folder):
    arguments = ("--until-decided", "--max-runs", "14", "--false-alarm", "1e-6", "--seed", "5")
    consistency("run", "linear-gaussian", "--filter", "kf", *arguments, "--out", "open", cwd=folder)
    done = consistency("analyse", "open", "--fail-on", "inconsistent", cwd=folder, status=1)
    assert "undecided: no fault found, but 14 runs do not show the covariance ratio " in done.stdout


def test_a_filter_against_another_and_against_its_baseline(folder):
    pair = ("--filter", "ekf-xyz", "--filter", "ekf-uvd")
    done = consistency("compare", "out", *pair, "--fail-on", "worse", cwd=folder, status=1)
    assert "ekf-xyz is less consistent than ekf-uvd" in done.stdout
    consistency("compare", "out", *reversed(pair[1::2]), cwd=folder, status=2)  # names without --filter
    consistency("baseline", "out", "--out", "base.json", cwd=folder)
    done = consistency("compare", "out", "base.json", "--fail-on", "worse", cwd=folder)
    assert "every run is the same in both" in done.stdout
    data = json.loads(consistency("compare", "out", "base.json", "--json", cwd=folder).stdout)
    assert [each["worse"] for each in data] == [False, False]
    assert (folder / "base.json").stat().st_size < 20_000
    consistency("baseline", "out", "--out", "base.json", cwd=folder, status=2)
