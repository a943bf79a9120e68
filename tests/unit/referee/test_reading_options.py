"""Options of files: one record for readers, commands and Python."""

from __future__ import annotations

import inspect
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from command import consistency
from recorded import read_recordings

import consistency as cs
from consistency.referee.readers.options import MAX_DT, Reading, flag_of
from consistency.testing import assert_consistent


def test_python_has_every_option_of_files() -> None:
    names = list(inspect.signature(cs.read).parameters)
    assert names == ["estimates", *(each.name for each in fields(Reading)), "filter"]


def test_what_follows_from_options() -> None:
    assert (Reading().tolerance, Reading().shift) == (MAX_DT, 0.0)
    given = Reading(max_dt=0.5, time_offset=-2.0, motions=False)
    assert (given.tolerance, given.shift) == (0.5, -2.0)
    assert Reading(time_offset="estimate").shift == 0.0
    assert given.given() == ["max_dt", "time_offset", "motions"]
    assert given.given(["axes", "time_offset"]) == ["time_offset"]
    assert flag_of("max_dt") == "--max-dt"


@pytest.fixture
def tables(tmp_path: Path) -> tuple[Path, Path]:
    """Two components at 0.3 s and so on, and a truth that is t and -t at whole seconds."""
    t = np.arange(1.0, 9.0)
    est = "t,a,b,P_a_a,P_a_b,P_b_b\n" + "".join(f"{k + 0.3},{k + 0.4},{-k},1,0,1\n" for k in t)
    (tmp_path / "est.csv").write_text(est)
    (tmp_path / "truth.csv").write_text("t,a,b\n" + "".join(f"{k},{k},{-k}\n" for k in range(12)))
    return tmp_path / "est.csv", tmp_path / "truth.csv"


def test_readers_take_tolerance_and_offset(tables: tuple[Path, Path]) -> None:
    with pytest.raises(cs.InputError, match=r"within 0\.01 s \(--max-dt\)"):
        read_recordings(*tables, state=["a", "b"])
    (near,) = read_recordings(*tables, state=["a", "b"], max_dt=0.3)
    np.testing.assert_allclose(near.error[0], [[-0.1, -0.3]] * 8, atol=1e-12)
    (moved,) = read_recordings(*tables, state=["a", "b"], time_offset=-0.3)
    np.testing.assert_allclose(moved.error[0], [[-0.4, 0.0]] * 8, atol=1e-12)
    (whole,) = read_recordings(*tables, state=["a", "b"], time_offset=-1, max_dt=0.3)
    np.testing.assert_allclose(whole.error[0], [[-1.1, 0.7]] * 8, atol=1e-12)


def test_windows_are_moved_by_an_offset(tmp_path: Path) -> None:
    rows = "".join(f"{k + 0.5},1,0,0,1,0,0,1,0,1\n" for k in range(12))
    (tmp_path / "est.csv").write_text("t,x,y,heading,P_xx,P_xy,P_xh,P_yy,P_yh,P_hh\n" + rows)
    (tmp_path / "truth.csv").write_text("t,x,y,heading\n" + "".join(f"{k},{k},0,0\n" for k in range(12)))
    files = tmp_path / "est.csv", tmp_path / "truth.csv"
    with pytest.raises(cs.InputError, match=r"within 0\.01 s \(--max-dt\)"):
        read_recordings(*files, relative=2, motions=True)
    (record,) = read_recordings(*files, time_offset=-0.5, relative=2, motions=True)
    np.testing.assert_allclose(record.error, np.zeros((1, 5, 3)), atol=1e-12)


def test_motions_has_no_opposite(capsys: pytest.CaptureFixture[str]) -> None:
    shown, _ = consistency(capsys, "analyse", "--help")
    assert "--motions " in shown
    assert "--no-motions" not in shown


def test_names_on_the_command_line_may_have_spaces(
    tables: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    consistency(capsys, "analyse", tables[0], "--truth", tables[1], "--state", "a, b", "--time-offset", "-0.3")


def test_a_step_without_a_measurement_has_no_covariance_to_check(rng: np.random.Generator) -> None:
    v = rng.normal(size=(400, 10, 2))
    S = np.broadcast_to(np.eye(2), (400, 10, 2, 2)).copy()
    v[:, 3] = S[:, 3] = np.nan
    assert assert_consistent(innovations=v, innovation_covariances=S, optimal_gain=True).status == "consistent"
