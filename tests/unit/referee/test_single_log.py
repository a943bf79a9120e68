"""A single log: how its NEES decorrelates, the interval that comes of it, and what a verdict says would decide."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from recorded import read_recordings
from scipy import stats
from single_log import errors

from consistency.referee.diagnostics import Evidence, Settings, Verdict, judge
from consistency.referee.diagnostics.planning.single_log import correlation_time, within
from consistency.referee.types import Array
from consistency.referee.verdicts.sources import analyse

SETTINGS = Settings()
SURE = 1e-5


def log_of(rng: np.random.Generator, rho: float, steps: int, n: int = 3, ratio: float = 1.0) -> Verdict:
    e = np.sqrt(ratio) * errors(rng, rho, steps, n)[None]
    return judge(Evidence("log", e, np.broadcast_to(np.eye(n), (*e.shape, n))), Settings(SURE))


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9])
def test_correlation_time_of_an_autoregression(rho: float, rng: np.random.Generator) -> None:
    """Within 5 standard errors (Sokal 1997) of (1 + rho) / (1 - rho)."""
    steps, exact = 200_000, (1.0 + rho) / (1.0 - rho)
    found, lag = correlation_time(errors(rng, rho, steps, 1)[:, 0])
    assert abs(found / exact - 1.0) < 5.0 * np.sqrt(2.0 * (2.0 * lag + 1.0) / steps)
    assert lag >= 5.0 * found


def test_effective_dof_of_gaussian_errors(rng: np.random.Generator) -> None:
    """The NEES of AR(rho) decorrelates as rho^2: nu = n T / tau; ten percent are more than five standard errors."""
    steps, n, rho = 200_000, 2, 0.7
    found = within(np.square(errors(rng, rho, steps, n)).sum(axis=1), n, SETTINGS, 1.5)
    tau = (1.0 + rho**2) / (1.0 - rho**2)
    assert found.correlation == pytest.approx(tau, rel=0.1)
    assert found.effective_dof == pytest.approx(n * steps / tau, rel=0.1)
    low, high = (stats.chi2.ppf(q, found.effective_dof) / found.effective_dof for q in (0.025, 0.975))
    assert found.ratio.low == pytest.approx(found.ratio.value / high, rel=1e-2)
    assert found.ratio.high == pytest.approx(found.ratio.value / low, rel=1e-2)


@pytest.mark.parametrize("rho", [0.0, 0.95])
def test_intervals_hold_the_ratio(rho: float, rng: np.random.Generator) -> None:
    """95 % is stated: of 200 fewer than 168 would be less than one in a million at that rate."""
    ratio, logs = 1.7, 200
    held = 0
    for _ in range(logs):
        nees = ratio * np.square(errors(rng, rho, 1500, 3)).sum(axis=1)
        found = within(nees, 3, SETTINGS, 1.5)
        held += found is None or found.ratio.holds(ratio)
    assert stats.binom.cdf(167, logs, 0.95) < 1e-6
    assert held > 167


def test_too_short_or_too_slow_a_log_says_nothing(rng: np.random.Generator) -> None:
    assert within(np.square(errors(rng, 0.0, 19, 3)).sum(axis=1), 3, SETTINGS, 1.5) is None
    assert within(np.full(400, 3.0), 3, SETTINGS, 1.5) is None
    assert within(np.linspace(1.0, 5.0, 400), 3, SETTINGS, 1.5) is None
    verdict = log_of(rng, 0.0, 12)
    assert any("the log is too short to show how its errors decorrelate" in reason for reason in verdict.reasons)


def test_steps_without_a_nees_are_passed_over(rng: np.random.Generator) -> None:
    nees = np.square(errors(rng, 0.0, 500, 3)).sum(axis=1)
    gaps = np.full(1000, np.nan)
    gaps[::2] = nees
    assert within(gaps, 3, SETTINGS, 1.5) == within(nees, 3, SETTINGS, 1.5)


def test_a_single_log_says_its_ratio_and_what_would_decide(rng: np.random.Generator) -> None:
    verdict = log_of(rng, 0.9, 600)
    assert verdict.status == "undecided"
    found = verdict.scale.within if verdict.scale is not None else None
    assert found.steps is not None
    assert found.pieces is not None
    line = next(reason for reason in verdict.reasons if "decorrelate" in reason)
    assert f"the covariance ratio is {found.ratio.value:.2f} [{found.ratio.low:.2f}, {found.ratio.high:.2f}]" in line
    assert "reported and not judged" in line
    assert f"a log of {found.steps} steps, cut into {found.pieces} runs, would then probably decide" in line
    told = verdict.statistics["within"]
    assert told["ratio_interval"] == (found.ratio.low, found.ratio.high)
    assert (told["deciding_steps"], told["deciding_pieces"]) == (found.steps, found.pieces)
    assert "within the log" in str(verdict)


def test_a_long_log_is_to_be_cut(rng: np.random.Generator) -> None:
    """And cut as it says it decides: consistent, at rates of 1e-5."""
    verdict = log_of(rng, 0.5, 20_000)
    found = verdict.scale.within
    assert found.pieces is not None
    assert found.pieces == 50
    assert any("cut into 50 runs, this log would then probably decide" in reason for reason in verdict.reasons)
    cut = errors(rng, 0.5, 20_000, 3).reshape(50, 400, 3)
    assert judge(Evidence("cut", cut, np.broadcast_to(np.eye(3), (50, 400, 3, 3))), Settings(SURE)).consistent


def test_pieces_are_ten_correlation_times_long(rng: np.random.Generator) -> None:
    found = within(np.square(errors(rng, 0.9, 3000, 3)).sum(axis=1), 3, SETTINGS, 1.5)
    assert found.pieces >= 20
    assert max(found.steps, 3000) / found.pieces >= 10.0 * found.correlation


def test_several_runs_have_no_such_line(rng: np.random.Generator) -> None:
    e = errors(rng, 0.5, 400, 3).reshape(2, 200, 3)
    verdict = judge(Evidence("two", e, np.broadcast_to(np.eye(3), (2, 200, 3, 3))), Settings(SURE))
    assert verdict.scale.within is None
    assert not any("decorrelate" in reason for reason in verdict.reasons)


def poses(path: Path, e: Array) -> Path:
    step = np.arange(1, len(e) + 1)
    truth = pd.DataFrame({"step": step, "x": 0.1 * step, "y": 0.0, "heading": 0.0})
    truth.to_csv(path.with_name("truth.csv"), index=False)
    estimates = truth + pd.DataFrame({"step": 0.0, "x": e[:, 0], "y": e[:, 1], "heading": 0.01 * e[:, 2]})
    covariance = {"P_x_x": 1.0, "P_x_y": 0.0, "P_x_heading": 0.0, "P_y_y": 1.0, "P_y_heading": 0.0}
    covariance["P_heading_heading"] = 1e-4
    estimates.assign(**covariance).to_csv(path, index=False)
    return path


def test_relative_poses_are_named_where_they_would_help(tmp_path: Path, rng: np.random.Generator) -> None:
    file = poses(tmp_path / "one.csv", errors(rng, 0.8, 300, 3))
    recordings = read_recordings(file, tmp_path / "truth.csv")
    verdict = analyse(recordings, settings=Settings(SURE))["one"]
    assert "--relative 10s" in verdict.reasons[-1]
    vector = read_recordings(file, tmp_path / "truth.csv", state=["x", "y"])
    assert "--relative" not in str(analyse(vector, settings=Settings(SURE))["one"].reasons)
    gross = poses(tmp_path / "gross.csv", 100.0 * errors(rng, 0.0, 300, 3))
    found = analyse(read_recordings(gross, tmp_path / "truth.csv"))["gross"]
    assert found.status == "overconfident"
    assert "--relative" not in str(found.reasons)
    assert any("the covariance ratio is" in reason for reason in found.reasons)
    json.dumps(found.reasons)
