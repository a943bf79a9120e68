"""The filters and the arithmetic that the monitor's rates are measured with."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import consistency as cs

sys.path.insert(0, str(Path(__file__).parents[2] / "experiments"))
import calibration_monitor as calibration


@pytest.mark.parametrize("gate", [None, 0.99, 0.95])
@pytest.mark.parametrize("name", list(calibration.WORLDS))
def test_monitors_at_once_are_the_monitor(name: str, gate: float | None) -> None:
    """Step by step, with a fault, so that there are rejections and alarms."""
    world = calibration.WORLDS[name](np.random.default_rng(), 4)
    at_once = [calibration.Monitors(4, world.dof, tolerance, gate) for tolerance in (1.0, 1.2)]
    one_by_one = [[cs.Monitor(0.05, tolerance, gate) for _ in range(4)] for tolerance in (1.0, 1.2)]
    for step in range(150):
        nis = (1.0 if step < 100 else 2.5) * world.nis()
        for many, singles in zip(at_once, one_by_one, strict=True):
            evidence = many.update(nis)
            for single, value in zip(singles, nis, strict=True):
                single.update(value, world.dof)
            np.testing.assert_allclose(evidence, [single.evidence for single in singles], rtol=1e-9)
        world.move(nis <= at_once[0].limit)
    if gate is not None:
        assert sum(single.rejections for single in one_by_one[0])


@pytest.mark.parametrize("name", list(calibration.WORLDS))
def test_innovations_of_the_filters_are_white_with_the_stated_covariance(name: str) -> None:
    """Without a gate: the total NIS and the product of neighbouring innovations, two-sided at 1e-6 together."""
    world = calibration.WORLDS[name](np.random.default_rng(), 4000)
    total, product, before = 0.0, [], None
    for _ in range(20):
        nis = world.nis()
        total += nis.sum()
        whitened = np.atleast_2d(world.innovation) / np.sqrt(world.P[: world.dof] + 1.0)
        if before is not None:
            product.append((whitened * before).ravel())
        before = whitened
        world.move(np.ones(4000, bool))
    low, high = stats.chi2.ppf([2.5e-7, 1 - 2.5e-7], 20 * 4000 * world.dof)
    assert low < total < high
    products = np.concatenate(product)
    assert abs(products.mean()) < stats.norm.isf(1.25e-7) * products.std() / np.sqrt(len(products))


@pytest.mark.parametrize("name", list(calibration.WORLDS))
def test_a_filter_that_misses_a_measurement_knows_it(name: str) -> None:
    """After five rejections that have nothing to do with the values the NIS still has its degrees of freedom (1e-6)."""
    world = calibration.WORLDS[name](np.random.default_rng(), 20_000)
    before = world.P.copy()
    for _ in range(5):
        world.nis()
        world.move(np.zeros(20_000, bool))
    assert (world.P[0] > before[0]).all()
    low, high = stats.chi2.ppf([5e-7, 1 - 5e-7], 20_000 * world.dof)
    assert low < world.nis().sum() < high


def test_rows_have_what_the_table_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibration, "STEPS", 60)
    monkeypatch.setattr(calibration, "LATE", 30)
    monkeypatch.setattr(calibration, "PATIENCE", 400)
    monkeypatch.setattr(calibration, "WORLDS", {"position": calibration.Position})
    rows = calibration.measure({0.05: 30, 0.01: 60}, faults=30)
    right, faults = [row for row in rows if row["ratio"] == 1.0], [row for row in rows if row["ratio"] != 1.0]
    assert [(row["tolerance"], row["gate"], row["false_alarm"], row["missions"]) for row in right] == [
        (tolerance, gate, rate, missions)
        for gate in (None, 0.99)
        for tolerance in (1.0, 1.2)
        for rate, missions in ((0.05, 30), (0.01, 60))
    ]
    assert all(0 <= row["found"] <= row["missions"] for row in right)
    assert {(row["ratio"], row["since"]) for row in faults} == {(r, s) for r in (1.5, 2.0, 0.5) for s in (1, 31)}
    assert all(1 <= row["median_delay"] <= row["p95_delay"] for row in faults)
    slow, fast = (next(row for row in faults if row["ratio"] == ratio) for ratio in (1.5, 2.0))
    assert fast["median_delay"] < slow["median_delay"]
