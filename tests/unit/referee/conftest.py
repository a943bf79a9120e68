"""What many tests of the referee begin with."""

import pytest


@pytest.fixture
def inside(tmp_path, monkeypatch):
    """The folder of the test, in which it runs."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def without_hints():
    """No look for mix-ups, which takes most of the time where files are read whose errors do not fit."""
    from consistency.referee.readers.mix_ups import hints

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hints, "hints", lambda *_: [])
        yield
