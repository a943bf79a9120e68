"""A filter of a library that is not installed: known by name, refused with the remedy, and in nobody's way."""

from __future__ import annotations

import pytest

import consistency as cs
from consistency.bench import filters


@pytest.fixture
def lacking(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(filters, "EXTRAS", {"external.gtsam": ("no_such_package", "smoothing")})


@pytest.mark.usefixtures("lacking")
def test_without_its_library_a_filter_is_refused() -> None:
    remedy = "'gtsam-map-uvd' needs no_such_package: pip install "
    with pytest.raises(cs.InputError, match=remedy):
        cs.get_filter("gtsam-map-uvd")
    assert "gtsam-map-uvd" in filters.filter_names()
    assert set(filters.filter_names()) - set(filters.usable_names()) == {
        "gtsam-batch-uvd", "gtsam-lag-uvd", "gtsam-map-uvd",
    }  # fmt: skip


@pytest.mark.usefixtures("lacking")
def test_what_does_not_fit_a_sensor_is_said_without_it(xyz: cs.Scenario) -> None:
    with pytest.raises(cs.InputError, match="works on a sensor uvd, not 'xyz'; filters that fit: ekf-xyz") as refusal:
        cs.run_trials(xyz, ["ekf-uvd"], runs=1)
    assert "gtsam" not in str(refusal.value)
