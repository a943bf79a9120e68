"""The filters and the arithmetic that the monitor's rates are measured with."""

from __future__ import annotations

import calibration_monitor as calibration
import numpy as np
import pytest
from calibration_rows import Row
from scipy import stats

import consistency as cs


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


def test_rows_are_those_of_the_calibration_table(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibration, "STEPS", 60)
    monkeypatch.setattr(calibration, "PATIENCE", 200)
    monkeypatch.setattr(calibration, "QUICK_MISSIONS", {0.05: 20, 0.01: 40})
    monkeypatch.setattr(calibration, "WORLDS", {"position": calibration.Position})
    rows = [Row(**row) for row in calibration.rows(quick=True, seed=1)]
    alarms, found = [row for row in rows if row.ratio == 1.0], [row for row in rows if row.ratio != 1.0]
    assert [(row.world, row.question[-3:], row.stated, row.gates) for row in alarms] == [
        (world, tolerance, rate, gates)
        for world in ("position", "position, gate 0.99")
        for tolerance in ("e 1", "1.2")
        for rate, gates in ((0.05, 20), (0.01, 40))
    ]
    assert all(row.bound == "<=" and row.found <= row.gates for row in alarms)
    assert {(row.ratio, row.runs) for row in found} == {(r, n) for (r, _), n in calibration.FOUND_WITHIN.items()}
    assert all(row.bound == ">=" and 0 < row.found <= row.gates for row in found)
    assert {row.world for row in rows} | {row.question for row in rows} <= set(calibration.ABOUT)


def test_a_delay_counts_the_steps_of_the_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    """So gross a fault is found in its first step; at a rate of 50 % many missions have had an alarm before it."""
    monkeypatch.setattr(calibration, "LATE", 20)
    monkeypatch.setattr(calibration, "RATIOS", (1e6,))
    monkeypatch.setattr(calibration, "DELAY_RATE", 0.5)
    found = calibration.delays("position", None, 200, seed=int(np.random.SeedSequence().generate_state(1)[0]))
    assert set(found) == {(tolerance, 1e6, since) for tolerance in (1.0, 1.2) for since in (1, 21)}
    assert all((steps == 1).all() for steps in found.values())
    assert all(len(found[tolerance, 1e6, 1]) == 200 for tolerance in (1.0, 1.2))
    assert 100 <= len(found[1.0, 1e6, 21]) < 200
