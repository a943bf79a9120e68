"""Processes that a test began end with it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from command import BEGUN


@pytest.fixture(autouse=True)
def nothing_left_behind() -> Iterator[None]:
    yield
    while BEGUN:
        BEGUN.pop().end()
