"""Commands run in the process of the tests."""

import pytest

from consistency.commands import main


def consistency(capsys, *words, status=0):
    """Standard output and error of a command that has to end with ``status``."""
    with pytest.raises(SystemExit) as end:
        main([*map(str, words)])
    out, err = capsys.readouterr()
    assert (end.value.code or 0) == status, err
    return out, err


def refused(capsys, *words):
    """The one line that a command ends with whose input cannot be used."""
    out, err = consistency(capsys, *words, status=2)
    assert (out, err.count("\n")) == ("", 1), err
    return err
