"""Processes that a test began end with it; commands that are refused, in this process, which saves seconds."""

import pytest
from own_process import BEGUN

from consistency.commands import main


@pytest.fixture(autouse=True)
def nothing_left_behind():
    yield
    while BEGUN:
        BEGUN.pop().end()


@pytest.fixture
def refused(monkeypatch, capsys):
    """``refused(folder, *words)``: what a command says that exits with 2, in two lines at most, and writes nothing."""

    def refused(folder, *words):
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
