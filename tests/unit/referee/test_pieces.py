"""One long log cut into pieces that stand as runs."""

from __future__ import annotations

from pathlib import Path

import calibration_pieces
import numpy as np
import pytest
from recorded import read_recordings
from scipy import signal

import consistency as cs
from consistency.referee.diagnostics import Evidence, judge
from consistency.referee.diagnostics.planning.single_log import APART, MOST
from consistency.referee.diagnostics.questions.independence import independence
from consistency.referee.diagnostics.records.log_pieces import LEAST, in_pieces, memory_of
from consistency.referee.diagnostics.verdict.answers import BIAS
from consistency.referee.geometry.conventions import SPATIAL
from consistency.referee.types import Array

N = 2


def log(rng: np.random.Generator, steps: int, rho: float = 0.0, constant: float = 0.0, ratio: float = 1.0) -> Evidence:
    """Errors AR(rho) beside an error that has a share ``constant`` of the variance and is the same in all steps."""
    w = rng.standard_normal((steps, N))
    w[1:] *= np.sqrt(1.0 - rho**2)
    e = np.sqrt(1.0 - constant) * signal.lfilter([1.0], [1.0, -rho], w, axis=0)
    e += np.sqrt(constant) * rng.standard_normal((1, N))
    P = np.broadcast_to(np.eye(N), (1, steps, N, N))
    return Evidence("log", np.sqrt(ratio) * e[None], P, axes=("x", "y"), t=np.arange(float(steps)))


def of(array: Array, name: str = "log") -> Evidence:
    return Evidence(name, array, np.broadcast_to(np.eye(array.shape[-1]), (*array.shape, array.shape[-1])))


def test_pieces_are_rows_of_the_log() -> None:
    one = log(np.random.default_rng(1), 1003)
    r = in_pieces(one, 25)
    assert (r.error.shape, r.unit, len(r.run_numbers)) == ((25, 40, N), "piece", 25)
    np.testing.assert_array_equal(r.error.reshape(-1, N), one.error[0, :1000])
    assert (r.times[3, 0], r.run_numbers[0]) == (120.0, 1)
    assert set(r.unavailable) == set(BIAS)
    assert not r.unshown
    v = judge(r)
    assert v.reasons[0].endswith("what is constant over the log is not judged, and every piece has it")
    assert "25 pieces" in v.reasons[0]


def test_the_advised_number_does_not_depend_on_the_size_of_the_errors() -> None:
    one = log(np.random.default_rng(1), 4000, 0.5)
    a, b = (in_pieces(of(scale * np.asarray(one.error))) for scale in (1.0, 7.0))
    assert a.error.shape == b.error.shape
    m = memory_of(np.asarray(one.error)[0])
    assert m.pieces == min(4000 // m.piece, MOST)
    assert m.piece == int(np.ceil(APART * m.upper))
    assert m.time == pytest.approx(3.0, rel=0.35)  # of AR(.5), 1 + 2 (.5 + .25 + ...)
    assert m.upper > 1.1 * m.time


def test_the_correlation_is_about_zero_and_of_sizes_too() -> None:
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


def test_a_right_log_is_no_fault_and_a_wrong_one_is() -> None:
    """At most 4 faults in 20 right logs: more in 3 of 1,000 at a rate of 5 %; it was 1 of 60 for AR(.95)."""
    rng = np.random.default_rng(3)
    found = [judge(in_pieces(log(rng, 3000, 0.5))) for _ in range(20)]
    assert sum(bool(v.faults) for v in found) <= 4
    assert sum(v.status == "consistent" for v in found) >= 15
    wrong = [judge(in_pieces(log(rng, 3000, 0.5, ratio=2.0))) for _ in range(5)]
    assert [v.status for v in wrong] == ["overconfident"] * 5


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_a_constant_part_is_undecided(share: float) -> None:
    rng = np.random.default_rng(4)
    found = [judge(in_pieces(log(rng, 3000, 0.5, share, ratio=3.0))) for _ in range(5)]
    assert sum(v.status == "undecided" for v in found) >= 4
    some = next(v for v in found if v.status == "undecided")
    assert "if they are, reported and not judged" in some.reasons[0]
    assert not some.answers


def test_too_short_pieces_are_undecided() -> None:
    one = log(np.random.default_rng(5), 400, 0.9)
    v = judge(in_pieces(one))
    assert (v.status, v.runs) == ("undecided", LEAST)
    assert "20 pieces of 20 steps are not shown to be independent: errors go on over" in v.reasons[0]
    few = judge(in_pieces(log(np.random.default_rng(5), 4000), 10))
    assert "10 pieces of one log are too few, at least 20 are needed" in few.reasons[0]


def test_neighbours_are_tested_by_the_code_of_windows() -> None:
    """Pieces whose sizes change slowly: each is white by itself, and all of the first half are small."""
    rng = np.random.default_rng(6)
    e = rng.standard_normal((1, 8000, N))
    e[0, :4000] *= 0.93
    r = in_pieces(of(e), 40)
    assert "do not seem to be independent" in r.unshown
    assert judge(r).status == "undecided"
    w = rng.standard_normal((60, N))
    assert independence(w, np.square(w).sum(axis=1)) == independence(w)
    assert independence(w, np.arange(1.0, 61.0)).doubtful


def test_growing_errors_are_refused() -> None:
    one = log(np.random.default_rng(7), 2000)
    growing = np.linspace(0.1, 3.0, 2000)[None, :, None, None] * np.eye(N)
    with pytest.raises(cs.InputError, match=r"the stated variance of x grows by x.* over the log.* --relative 10s"):
        in_pieces(Evidence("log", one.error, growing, axes=("x", "y")))
    outage = np.where(np.arange(2000) >= 1890, 9.0, 1.0)[None, :, None, None] * np.eye(N)
    assert in_pieces(Evidence("log", one.error, outage, axes=("x", "y"))).unit == "piece"
    shrinking = growing[:, ::-1]
    assert in_pieces(Evidence("log", one.error, shrinking, axes=("x", "y"))).unit == "piece"


def test_what_is_refused() -> None:
    rng = np.random.default_rng(8)
    with pytest.raises(cs.InputError, match="needs the errors of one log; log has 2 runs"):
        in_pieces(of(rng.standard_normal((2, 100, N))))
    with pytest.raises(cs.InputError, match="log has only 30 steps"):
        in_pieces(of(rng.standard_normal((1, 30, N))), 40)
    with pytest.raises(cs.InputError, match="has no step that can be judged"):
        in_pieces(of(np.full((1, 30, N), np.nan)))


def test_steps_before_the_first_covariance_are_in_no_piece() -> None:
    one = of(np.random.default_rng(9).standard_normal((1, 1010, N)))
    P = np.asarray(one.covariance).copy()
    P[0, :10] = np.nan
    r = in_pieces(Evidence("log", one.error, P), 25)
    np.testing.assert_array_equal(r.error.reshape(-1, N), one.error[0, 10:])


def test_the_rows_of_the_calibration(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorter logs and studies: a right one is at fault in 2 of 2 once in 400."""
    monkeypatch.setattr(calibration_pieces, "QUICK_GATES", 2)
    rows = calibration_pieces.rows(True, 7)
    assert {row["question"] for row in rows} | {row["world"] for row in rows} < set(calibration_pieces.ABOUT)
    assert len(rows) == 3 + len(SPATIAL)
    assert all(row["found"] < 2 for row in rows if row["bound"] == "<=")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"split": "x"}, "--split x: must be a number of pieces, or 'auto'"),
        ({"split": "0"}, "--split 0: must be a number of pieces, or 'auto'"),
        ({"split": "auto", "relative": "2"}, "--split: does not go with --relative"),
        ({"split": "auto", "align": "posyaw"}, "--split: does not go with --align posyaw"),
        ({"split": "auto", "truth_covariance": "columns"}, "--truth-covariance: does not go with --split"),
    ],
)
def test_options(tmp_path: Path, options: dict[str, str], message: str) -> None:
    rng = np.random.default_rng(10)
    head = "t,x,y,heading,P_xx,P_xy,P_xh,P_yy,P_yh,P_hh\n"
    rows = [",".join(map(str, [k, *(0.1 * rng.standard_normal(3)), 0.01, 0, 0, 0.01, 0, 0.01])) for k in range(600)]
    (tmp_path / "est.csv").write_text(head + "\n".join(rows) + "\n")
    (tmp_path / "truth.csv").write_text("t,x,y,heading\n" + "".join(f"{k},0,0,0\n" for k in range(600)))
    files = tmp_path / "est.csv", tmp_path / "truth.csv"
    with pytest.raises(cs.InputError, match=message):
        read_recordings(*files, **options)
    (r,) = read_recordings(*files, split="25")
    assert r.error.shape == (25, 24, 3)
    assert any("the log is cut into 25 pieces of 24 steps, which stand as runs" in note for note in r.notes)
    auto = cs.judge(cs.read(*files, split="auto"))
    assert auto.status in ("consistent", "undecided")
