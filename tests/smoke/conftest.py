"""Processes that a test began end with it; commands that are refused, in this process, which saves seconds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from own_process import BEGUN

from consistency.commands import main


@pytest.fixture(autouse=True)
def nothing_left_behind() -> Iterator[None]:
    yield
    while BEGUN:
        BEGUN.pop().end()


@pytest.fixture
def refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """``refused(folder, *words)``: what a command says that exits with 2, in two lines at most, and writes nothing."""

    def refused(folder: Path, *words: str) -> str:
        monkeypatch.chdir(folder)
        before = sorted(folder.rglob("*"))
        with pytest.raises(SystemExit) as end:
            main([*words])
        out, err = capsys.readouterr()
        assert (end.value.code, out) == (2, ""), err
        assert len(err.strip().splitlines()) <= 2
        assert sorted(folder.rglob("*")) == before
        return err

    return refused
