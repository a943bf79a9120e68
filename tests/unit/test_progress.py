"""What is said of long work where standard error is no terminal."""

from __future__ import annotations

import pytest

from consistency.terminal.progress import KERNELS, progress


def test_compiling_is_announced_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    with progress("compiling ekf-uvd (once on this machine)", 1, KERNELS) as advance:
        assert capsys.readouterr().err == "compiling ekf-uvd (once on this machine) ...\n"
        advance(1)
        assert "1 of 1 kernels" in capsys.readouterr().err


def test_runs_are_said_when_some_are_done(capsys: pytest.CaptureFixture[str]) -> None:
    with progress("runs", 2) as advance:
        assert capsys.readouterr().err == ""
        advance(2)
        assert capsys.readouterr().err.startswith("runs: 2 of 2 runs")
