"""Planning, early stopping, comparisons and baselines as a newcomer types them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from command import consistency

from consistency.scenario import data_folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``small.toml``, a short world in which stereo points make the EKF inconsistent, and ``out``, 12 runs in it."""
    at = tmp_path_factory.mktemp("referee")
    scenario = (data_folder("scenarios") / "herath2007-stereo.toml").read_text()
    (at / "small.toml").write_text(scenario.replace("steps = 500", "steps = 120"))
    filters = ("--filter", "ekf-xyz", "--filter", "ekf-uvd")
    consistency("run", "small.toml", *filters, "--runs", "12", "--out", "out", cwd=at)
    return at


def test_plan(tmp_path: Path) -> None:
    done = consistency(
        "plan", "--dof", "3", "--detect", "1.2", "--false-alarm", "0.05", "--power", "0.95", cwd=tmp_path
    )
    assert "301 runs" in done.stdout
    assert "260 runs would do for a single chi-square test" in done.stdout
    for ratio, one_step in (("1.2", 260), ("1.5", 53), ("2", 18)):
        done = consistency("plan", "--detect", ratio, "--json", cwd=tmp_path)
        assert json.loads(done.stdout)["one_step"] == one_step


@pytest.mark.parametrize(
    ("arguments", "said"),
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
        (("compare", "nowhere", "--fail-on", "sun"), "--fail-on must be 'worse'"),
    ],
)
def test_bad_input(arguments: tuple[str, ...], said: str, tmp_path: Path) -> None:
    done = consistency(*arguments, cwd=tmp_path, status=2)
    assert said in done.stderr
    assert len(done.stderr.strip().splitlines()) <= 2
    assert not list(tmp_path.iterdir())


def test_until_decided_stops_at_the_first_look_and_says_so(folder: Path) -> None:
    done = consistency("run", "small.toml", "--filter", "ekf-xyz", "--until-decided", "--out", "decided", cwd=folder)
    first = json.loads(consistency("plan", "--json", cwd=folder).stdout)["looks"][0]
    assert f"{first} runs: ekf-xyz overconfident" in done.stderr
    manifest = json.loads((folder / "decided/manifest.json").read_text())
    assert manifest["runs"] == first
    assert manifest["until_decided"]["detect"] == 1.5


def test_undecided_is_a_verdict(folder: Path) -> None:
    arguments = ("--until-decided", "--max-runs", "14", "--false-alarm", "1e-6", "--seed", "5")
    consistency("run", "linear-gaussian", "--filter", "kf", *arguments, "--out", "open", cwd=folder)
    done = consistency("analyse", "open", "--fail-on", "inconsistent", cwd=folder, status=1)
    assert "undecided: no fault found, but 14 runs do not show the covariance ratio " in done.stdout


def test_a_filter_against_another_and_against_its_baseline(folder: Path) -> None:
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
