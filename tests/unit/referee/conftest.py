"""What many tests of the referee begin with."""

import pytest


@pytest.fixture
def inside(tmp_path, monkeypatch):
    """The folder of the test, in which it runs."""
    monkeypatch.chdir(tmp_path)
    return tmp_path
