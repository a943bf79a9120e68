"""Small worlds that many tests share, and settings of the property tests."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import settings

import consistency as cs

pytest_plugins = ["pytester"]  # runs of pytest inside tests, for the plugin

settings.register_profile("bench", deadline=None, max_examples=60, derandomize=True, database=None)
settings.load_profile("bench")

TILTED = {"position": [0.12, -0.05, 0.3], "rotation": [0.08, -0.15, 0.4]}  # m; roll, pitch, heading in rad


@pytest.fixture(scope="session")
def small() -> Callable[..., cs.Scenario]:
    """``small("herath2007-xyz", key=value)``: a built-in world cut to 60 steps, with changes."""

    def make(name: str, **changes: Any) -> cs.Scenario:
        return cs.load_scenario(name).variant(f"small-{name}", **{"truth__steps": 60, **changes})

    return make


@pytest.fixture(scope="session")
def xyz(small: Callable[..., cs.Scenario]) -> cs.Scenario:
    return small("herath2007-xyz")


@pytest.fixture(scope="session")
def uvd(small: Callable[..., cs.Scenario]) -> cs.Scenario:
    return small("herath2007-stereo")


@pytest.fixture(scope="session")
def linear(small: Callable[..., cs.Scenario]) -> cs.Scenario:
    return small("linear-gaussian")


@pytest.fixture(scope="session")
def tilted() -> dict[str, list[float]]:
    """A mount with every number different from zero."""
    return TILTED


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20070)
