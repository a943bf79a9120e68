"""The stored draws of docs/case-studies are what its script makes with the gtsam that is installed."""

from __future__ import annotations

import runpy
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

import consistency as cs

FOLDER = Path(__file__).parents[2] / "docs/case-studies"

pytest.importorskip("gtsam", reason="gtsam (the extra smoothing) is not installed")


def test_the_script_makes_the_stored_draws() -> None:
    """Rounding of the archives is that of float32; other processors differ in last digits."""
    stored = FOLDER / f"gtsam-{version('gtsam')}.npz"
    if not stored.exists():
        pytest.skip("draws of another version are stored")
    made = runpy.run_path(str(FOLDER / "gtsam_imu.py"))["study"](1.0, np.random.default_rng(20070))
    with np.load(stored) as archive:
        np.testing.assert_allclose(made["residual"], archive["errors"], rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(made["stated"], archive["covariances"], rtol=1e-4, atol=1e-9)
    for name, P in (("vector", "raw"), ("residual", "raw")):
        kind = "vector" if name == "vector" else "raw"
        with np.load(stored.with_name(f"{stored.stem}-{kind}.npz")) as archive:
            np.testing.assert_allclose(cs.nees(made[name], made[P]), archive["nees"], rtol=1e-6)
