"""A single log: how its NEES decorrelates, the interval of its ratio, and pieces of it that stand as runs."""

import json

import calibration_pieces
import calibration_windows
import numpy as np
import pandas as pd
import pytest
from draws import identities
from numpy.testing import assert_array_equal
from recorded import read_recordings
from scipy import signal, stats
from single_log import errors

import consistency as cs
from consistency.diagnostics import Settings, judge, make_record
from consistency.referee.diagnostics.planning import (
    APART,
    MOST,
    correlation_time,
    in_pieces,
    memory_of,
    within,
)
from consistency.referee.diagnostics.tails import early_ends
from consistency.referee.diagnostics.verdict_parts import BIAS
from consistency.referee.diagnostics.whiteness import (
    ALIKE,
    ENOUGH,
    FEWEST_PIECES,
    RATE,
    SIZES,
    independence,
)
from consistency.referee.geometry import SPATIAL
from consistency.referee.verdicts.judge_sources import judge_all

SETTINGS = Settings()
SURE = 1e-5


def log_of(rng, rho, steps, n=3, ratio=1.0):
    e = np.sqrt(ratio) * errors(rng, rho, steps, n)[None]
    return judge(of(e), Settings(SURE))


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9])
def test_correlation_time_of_an_autoregression(rho, rng):
    """Within 5 standard errors (Sokal 1997) of (1 + rho) / (1 - rho)."""
    steps, exact = 200_000, (1.0 + rho) / (1.0 - rho)
    found, lag = correlation_time(errors(rng, rho, steps, 1)[:, 0])
    assert abs(found / exact - 1.0) < 5.0 * np.sqrt(2.0 * (2.0 * lag + 1.0) / steps)
    assert lag >= 5.0 * found


def test_effective_dof_of_gaussian_errors(rng):
    """The NEES of AR(rho) decorrelates as rho^2: nu = n T / tau; ten percent are more than five standard errors."""
    steps, n, rho = 200_000, 2, 0.7
    found = within(np.square(errors(rng, rho, steps, n)).sum(axis=1), n, SETTINGS, 1.5)
    tau = (1.0 + rho**2) / (1.0 - rho**2)
    assert found.correlation == pytest.approx(tau, rel=0.1)
    assert found.effective_dof == pytest.approx(n * steps / tau, rel=0.1)
    low, high = (stats.chi2.ppf(q, found.effective_dof) / found.effective_dof for q in (0.025, 0.975))
    assert found.ratio.low == pytest.approx(found.ratio.value / high, rel=1e-2)
    assert found.ratio.high == pytest.approx(found.ratio.value / low, rel=1e-2)


def test_too_short_or_too_slow_a_log_says_nothing(rng):
    assert within(np.square(errors(rng, 0.0, 19, 3)).sum(axis=1), 3, SETTINGS, 1.5) is None
    assert within(np.full(400, 3.0), 3, SETTINGS, 1.5) is None
    assert within(np.linspace(1.0, 5.0, 400), 3, SETTINGS, 1.5) is None
    verdict = log_of(rng, 0.0, 12)
    assert any("the log is too short to show how its errors decorrelate" in reason for reason in verdict.reasons)


def test_steps_without_a_nees_are_passed_over(rng):
    nees = np.square(errors(rng, 0.0, 500, 3)).sum(axis=1)
    gaps = np.full(1000, np.nan)
    gaps[::2] = nees
    assert within(gaps, 3, SETTINGS, 1.5) == within(nees, 3, SETTINGS, 1.5)


def test_a_single_log_says_its_ratio_and_what_would_decide(rng):
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


def test_a_long_log_is_to_be_cut(rng):
    """And cut as it says it decides: consistent, at rates of 1e-5."""
    verdict = log_of(rng, 0.5, 20_000)
    found = verdict.scale.within
    assert found.pieces is not None
    assert found.pieces == 50
    assert any("cut into 50 runs, this log would then probably decide" in reason for reason in verdict.reasons)
    cut = errors(rng, 0.5, 20_000, 3).reshape(50, 400, 3)
    assert judge(of(cut), Settings(SURE)).consistent


def poses(path, e):
    step = np.arange(1, len(e) + 1)
    truth = pd.DataFrame({"step": step, "x": 0.1 * step, "y": 0.0, "heading": 0.0})
    truth.to_csv(path.with_name("truth.csv"), index=False)
    estimates = truth + pd.DataFrame({"step": 0.0, "x": e[:, 0], "y": e[:, 1], "heading": 0.01 * e[:, 2]})
    covariance = {"P_x_x": 1.0, "P_x_y": 0.0, "P_x_heading": 0.0, "P_y_y": 1.0, "P_y_heading": 0.0}
    covariance["P_heading_heading"] = 1e-4
    estimates.assign(**covariance).to_csv(path, index=False)
    return path


def test_relative_poses_are_named_where_they_would_help(tmp_path, rng):
    file = poses(tmp_path / "one.csv", errors(rng, 0.8, 300, 3))
    recordings = read_recordings(file, tmp_path / "truth.csv")
    verdict = judge_all(recordings, settings=Settings(SURE))["one"]
    assert "--relative 10s" in verdict.reasons[-1]
    vector = read_recordings(file, tmp_path / "truth.csv", state=["x", "y"])
    assert "--relative" not in str(judge_all(vector, settings=Settings(SURE))["one"].reasons)
    gross = poses(tmp_path / "gross.csv", 100.0 * errors(rng, 0.0, 300, 3))
    found = judge_all(read_recordings(gross, tmp_path / "truth.csv"))["gross"]
    assert found.status == "overconfident"
    assert "--relative" not in str(found.reasons)
    assert any("the covariance ratio is" in reason for reason in found.reasons)
    json.dumps(found.reasons)


# --- a log cut into pieces ------------------------------------------------------------------------------------


N = 2


def log(rng, steps, rho=0.0, constant=0.0, ratio=1.0):
    """Errors AR(rho) beside an error that has a share ``constant`` of the variance and is the same in all steps."""
    w = rng.standard_normal((steps, N))
    w[1:] *= np.sqrt(1.0 - rho**2)
    e = np.sqrt(1.0 - constant) * signal.lfilter([1.0], [1.0, -rho], w, axis=0)
    e += np.sqrt(constant) * rng.standard_normal((1, N))
    return make_record("log", np.sqrt(ratio) * e[None], identities(e[None]), axes=("x", "y"), t=np.arange(float(steps)))


def of(array, name="log"):
    return make_record(name, array, identities(array))


def test_pieces_are_rows_of_the_log():
    one = log(np.random.default_rng(1), 1003)
    r = in_pieces(one, 25)
    assert (r.errors.error.shape, r.runs.unit, len(r.run_numbers)) == ((25, 40, N), "piece", 25)
    assert_array_equal(r.errors.error.reshape(-1, N), one.errors.error[0, :1000])
    assert (r.runs.times[3, 0], r.run_numbers[0]) == (120.0, 1)
    assert set(r.fit.unavailable) == set(BIAS)
    assert not r.origin.unshown
    v = judge(r)
    assert v.reasons[0].endswith("what is constant over the log is not judged, and every piece has it")
    assert "25 pieces" in v.reasons[0]


def test_the_advised_number_does_not_depend_on_the_size_of_the_errors():
    one = log(np.random.default_rng(1), 4000, 0.5)
    a, b = (in_pieces(of(scale * np.asarray(one.errors.error))) for scale in (1.0, 7.0))
    assert a.errors.error.shape == b.errors.error.shape
    m = memory_of(np.asarray(one.errors.error)[0])
    assert m.pieces == min(4000 // m.piece, MOST)
    assert m.piece == int(np.ceil(APART * m.upper))
    assert m.time == pytest.approx(3.0, rel=0.35)  # of AR(.5), 1 + 2 (.5 + .25 + ...)
    assert m.upper > 1.1 * m.time


def test_the_correlation_is_about_zero_and_of_sizes_too():
    rng = np.random.default_rng(2)
    white = rng.standard_normal((3000, N))
    assert memory_of(white).time < 1.5
    assert memory_of(white + 1.0).time > 300.0
    slow = np.repeat(np.exp(rng.standard_normal(30)), 100)[:, None]
    assert memory_of(white * slow).time > 20.0
    assert memory_of(white[:1]).pieces == 0
    one_axis = white.copy()
    one_axis[:, 1] += 2.0
    assert memory_of(one_axis).time > 300.0


def test_a_right_log_is_no_fault_and_a_wrong_one_is():
    """At most 4 faults in 20 right logs: more in 3 of 1,000 at a rate of 5 %; it was 1 of 60 for AR(.95)."""
    rng = np.random.default_rng(3)
    found = [judge(in_pieces(log(rng, 3000, 0.5))) for _ in range(20)]
    assert sum(bool(v.faults) for v in found) <= 4
    assert sum(v.status == "consistent" for v in found) >= 15
    wrong = [judge(in_pieces(log(rng, 3000, 0.5, ratio=2.0))) for _ in range(5)]
    assert [v.status for v in wrong] == ["overconfident"] * 5


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_a_constant_part_is_undecided(share):
    rng = np.random.default_rng(4)
    found = [judge(in_pieces(log(rng, 3000, 0.5, share, ratio=3.0))) for _ in range(5)]
    assert sum(v.status == "undecided" for v in found) >= 4
    some = next(v for v in found if v.status == "undecided")
    assert "if they are, reported and not judged" in some.reasons[0]
    assert not some.answers


def test_too_short_pieces_are_undecided():
    one = log(np.random.default_rng(5), 400, 0.9)
    v = judge(in_pieces(one))
    assert (v.status, v.runs) == ("undecided", FEWEST_PIECES)
    assert "20 pieces of 20 steps are not shown to be independent: errors last over" in v.reasons[0]
    few = judge(in_pieces(log(np.random.default_rng(5), 4000), 10))
    assert "10 pieces of one log are too few, at least 20 are needed" in few.reasons[0]


def test_neighbours_are_tested_by_the_code_of_windows():
    """Pieces whose sizes change slowly: each is white by itself, and all of the first half are small."""
    rng = np.random.default_rng(6)
    e = rng.standard_normal((1, 8000, N))
    e[0, :4000] *= 0.93
    r = in_pieces(of(e), 40)
    assert "do not seem to be independent" in r.origin.unshown
    assert judge(r).status == "undecided"
    w = rng.standard_normal((60, N))
    assert independence(w, np.square(w).sum(axis=1)) == independence(w)
    assert independence(w, np.arange(1.0, 61.0)).doubtful


def test_growing_errors_are_refused():
    one = log(np.random.default_rng(7), 2000)
    growing = np.linspace(0.1, 3.0, 2000)[None, :, None, None] * np.eye(N)
    with pytest.raises(cs.InputError, match=r"the stated variance of x grows by x.* over the log.* --relative 10s"):
        in_pieces(make_record("log", one.errors.error, growing, axes=("x", "y")))
    outage = np.where(np.arange(2000) >= 1890, 9.0, 1.0)[None, :, None, None] * np.eye(N)
    assert in_pieces(make_record("log", one.errors.error, outage, axes=("x", "y"))).runs.unit == "piece"
    shrinking = growing[:, ::-1]
    assert in_pieces(make_record("log", one.errors.error, shrinking, axes=("x", "y"))).runs.unit == "piece"


def test_what_is_refused():
    rng = np.random.default_rng(8)
    with pytest.raises(cs.InputError, match="needs the errors of one log; log has 2 runs"):
        in_pieces(of(rng.standard_normal((2, 100, N))))
    with pytest.raises(cs.InputError, match="log has only 30 steps"):
        in_pieces(of(rng.standard_normal((1, 30, N))), 40)
    with pytest.raises(cs.InputError, match="has no step that can be judged"):
        in_pieces(of(np.full((1, 30, N), np.nan)))


def test_steps_before_the_first_covariance_are_in_no_piece():
    one = of(np.random.default_rng(9).standard_normal((1, 1010, N)))
    P = np.asarray(one.errors.covariance).copy()
    P[0, :10] = np.nan
    r = in_pieces(make_record("log", one.errors.error, P), 25)
    assert_array_equal(r.errors.error.reshape(-1, N), one.errors.error[0, 10:])


def test_the_rows_of_the_calibration(monkeypatch):
    """Shorter logs and studies: a right one is at fault in 2 of 2 once in 400."""
    monkeypatch.setattr(calibration_pieces, "QUICK_GATES", 2)
    rows = calibration_pieces.rows(True, 7)
    assert {row["question"] for row in rows} | {row["world"] for row in rows} < set(calibration_pieces.ABOUT)
    assert len(rows) == 3 + len(SPATIAL)
    assert all(row["found"] < 2 for row in rows if row["bound"] == "<=")


REFUSED = [
    ({"split": "x"}, "--split x: must be a number of pieces, or 'auto'"),
    ({"split": "0"}, "--split 0: must be a number of pieces, or 'auto'"),
    ({"split": "auto", "relative": "2"}, "--split: does not go with --relative"),
    ({"split": "auto", "align": "posyaw"}, "--split: does not go with --align posyaw"),
    ({"split": "auto", "truth_covariance": "columns"}, "--truth-covariance: does not go with --split"),
]


def test_files_are_split_by_an_option(tmp_path):
    rng = np.random.default_rng(10)
    head = "t,x,y,heading,P_xx,P_xy,P_xh,P_yy,P_yh,P_hh\n"
    rows = [",".join(map(str, [k, *(0.1 * rng.standard_normal(3)), 0.01, 0, 0, 0.01, 0, 0.01])) for k in range(600)]
    (tmp_path / "est.csv").write_text(head + "\n".join(rows) + "\n")
    (tmp_path / "truth.csv").write_text("t,x,y,heading\n" + "".join(f"{k},0,0,0\n" for k in range(600)))
    files = tmp_path / "est.csv", tmp_path / "truth.csv"
    (r,) = read_recordings(*files, split="25")
    assert r.errors.error.shape == (25, 24, 3)
    assert any("the log is cut into 25 pieces of 24 steps, treated as runs" in note for note in r.origin.notes)
    auto = cs.judge(cs.read(*files, split="auto"))
    assert auto.status in ("consistent", "undecided")
    for options, message in REFUSED:
        with pytest.raises(cs.InputError, match=message):
            read_recordings(*files, **options)


# --- whether pieces are independent ---------------------------------------------------------------------------


def test_the_first_band_by_hand():
    """Band 1 of 20 values: frequencies 0 and 1 against the others, an F ratio of sums of squares of projections."""
    w = np.linspace(-1.0, 1.5, 20)[:, None] + 0.3 * np.cos(np.arange(20))[:, None]
    k = np.arange(20)
    waves = [np.ones(20), np.cos(2 * np.pi * k / 20), np.sin(2 * np.pi * k / 20)]
    parts = np.array([(wave @ w[:, 0]) ** 2 / (wave @ wave) for wave in waves])
    ratio = (parts.sum() / 3) / ((np.square(w).sum() - parts.sum()) / 17)
    bands = 3  # 1, 2 and 4 of at most 5
    expected = stats.f.sf(ratio, 3, 17) * bands / ((1 - SIZES) * ALIKE)
    found = independence(w)
    assert found.signs <= expected * (1 + 1e-9)  # another band may be clearer
    sizes = np.cbrt(np.square(w[:, 0]))
    sizes -= sizes.mean()
    p = []
    for b in (1, 2, 4):
        low = sum((np.cos(2 * np.pi * j * k / 20) @ sizes) ** 2 + (np.sin(2 * np.pi * j * k / 20) @ sizes) ** 2
                  for j in range(1, b + 1)) / 10  # fmt: skip
        ratio = (low / (2 * b)) / ((np.square(sizes).sum() - low) / (19 - 2 * b))
        p += [stats.f.sf(ratio, 2 * b, 19 - 2 * b) / ALIKE, stats.f.cdf(ratio, 2 * b, 19 - 2 * b) / (1 - ALIKE)]
    assert found.sizes == pytest.approx(min(1.0, min(p) * bands / SIZES))


@pytest.mark.parametrize("memory, count", [(0.5, 400), (0.8, 150), (0.95, 150)])
def test_sizes_that_go_on_are_doubted(memory, count, rng):
    """Missed in fewer than 1e-5: signs are independent, sizes AR."""
    found = independence(calibration_windows.windows_of(rng, count, memory))
    assert found.doubtful
    assert found.of_sizes
    assert found.alike


def test_signs_and_what_takes_turns(rng):
    noise = rng.normal(size=(301, 2))
    back = independence(noise[1:] - noise[:-1])
    assert back.doubtful
    assert not back.alike
    assert not back.of_sizes
    slow = independence(signal.lfilter([1.0], [1.0, -0.9], noise, axis=0))
    assert slow.doubtful
    assert slow.alike
    bias = independence(noise + 1.0)
    assert bias.doubtful
    assert bias.alike
    assert not bias.of_sizes
    turns = independence(noise * np.where(np.arange(301) % 2, 5.0, 1.0)[:, None])
    assert turns.doubtful
    assert turns.of_sizes
    assert not turns.alike


def test_scale_and_gaps_are_no_matter_and_few_are_not_asked(rng):
    w = rng.normal(size=(FEWEST_PIECES + 1, 3))
    gap = np.insert(w, 5, np.nan, axis=0)
    a, b = independence(w), independence(7.0 * gap)
    assert (a.pieces, b.pieces) == (FEWEST_PIECES + 1, FEWEST_PIECES + 1)
    assert b.p_value == pytest.approx(a.p_value)
    assert np.isfinite(independence(w[:FEWEST_PIECES]).p_value)
    few = independence(w[: FEWEST_PIECES - 1])
    assert np.isnan(few.p_value)
    assert not few.doubtful
    assert not independence(np.zeros((50, 2))).doubtful
    assert ENOUGH > FEWEST_PIECES
    assert RATE < 0.005


def test_rows_of_the_calibration(monkeypatch):
    monkeypatch.setattr(calibration_windows, "QUICK_GATES", 3)
    monkeypatch.setattr(calibration_windows, "QUICK_RIGHT", 3)
    rows = calibration_windows.rows(True, 5)
    assert {row["question"] for row in rows} | {row["world"] for row in rows} == set(calibration_windows.ABOUT)
    assert all(row["gates"] == 3 for row in rows)


# --- runs that end early ---------------------------------------------------------------------------------------


def test_early_ends_by_hand():
    """Two of five runs end in step 1 with ranks 5 and 3, one of three in step 2 with rank 2."""
    nan = np.nan
    nees = np.array([[5.0, nan, nan], [3.0, nan, nan], [1.0, 2.0, nan], [2.0, 1.0, 4.0], [4.0, 3.0, 4.0]])
    found = early_ends(nees)
    assert found.runs == 3
    assert found.above == pytest.approx((3 / 3 + 2 / 3 + 1 / 2) / 3)
    gap, variance = 8 - 6 + 2 - 2, 2 * 3 * 6 / 12 + 1 * 2 * 4 / 12
    assert found.p_value == pytest.approx(stats.norm.sf(gap / np.sqrt(variance)))
    assert not found.lost
    assert early_ends(nees[3:]).runs == 0
    assert early_ends(np.full((3, 4), nan)).runs == 0
    assert np.isnan(early_ends(np.ones((4, 2))).p_value)


def runs(rng, number, steps):
    """NEES (number, steps) of errors AR(.9), n = 3."""
    noise = rng.normal(size=(number, steps, 3))
    noise[:, 1:] *= np.sqrt(1.0 - 0.9**2)
    return np.square(signal.lfilter([1.0], [1.0, -0.9], noise, axis=1)).sum(axis=-1)


def test_runs_that_end_lost_are_named_and_others_are_not(rng):
    """100 runs that end where the NEES is beyond its 5 % point, certain but for 1e-5; 60 gates of any lengths."""
    nees = runs(rng, 100, 60)
    ended = np.cumsum(nees > stats.chi2.isf(0.05, 3), axis=1) - (nees > stats.chi2.isf(0.05, 3)) > 0
    verdict = judge(make_record("f", nees=np.where(ended, np.nan, nees), dof=3))
    assert verdict.ends.lost
    assert "that end early have a larger NEES in their last step than" in verdict.reasons[1]
    assert verdict.statistics["early_ends"]["lost"]
    whole = judge(make_record("f", nees=nees, dof=3))
    assert whole.ends is None
    assert "early_ends" not in whole.statistics
    lost = 0
    for _ in range(60):
        nees, length = runs(rng, 25, 20), rng.integers(1, 21, 25)
        found = early_ends(np.where(np.arange(20) < length[:, None], nees, np.nan))
        lost += found.lost
    assert lost <= stats.binom.isf(SURE, 60, 2e-3)
