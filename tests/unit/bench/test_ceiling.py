"""The experiment on the distance to the batch solution."""

from pathlib import Path

import numpy as np
import pytest

import consistency
import consistency as cs
from consistency.bench import filters
from consistency.bench.runs.reproduce_findings import sibling

ceiling = sibling(str(Path(consistency.__file__).parents[1] / "experiments" / "e16.py"), "e17_ceiling")


def test_the_ratio_and_its_interval(rng):
    best = rng.chisquare(2, 200)
    rmse, ratio, low, high = ceiling.compared(1.21 * best, best)
    assert rmse == pytest.approx(1.1 * np.sqrt(best.mean()))
    assert (ratio, low, high) == pytest.approx((1.1, 1.1, 1.1))
    _, ratio, low, high = ceiling.compared(rng.chisquare(2, 200), best)
    assert low < ratio < high
    assert 0.1 < high - low < 0.4  # about 4 standard deviations of 1 / sqrt(200)


def test_without_gtsam_it_says_so(monkeypatch):
    monkeypatch.setattr(filters, "EXTRAS", {"external.gtsam": ("no_such_package", "smoothing")})
    [finding] = ceiling.main(cs.Study(runs=1, jobs=1))
    assert finding.verdict == "not reproduced"
    assert finding.measured.startswith("not measured: filter 'gtsam-map-uvd' needs no_such_package")


def test_it_compares_the_last_poses(monkeypatch):
    pytest.importorskip("gtsam", reason="gtsam is not installed: pip install -e '.[smoothing]'")
    world = cs.load_scenario("herath2007-stereo").variant("short", truth__steps=20, truth__landmarks__count=40)

    class Cell:
        def __init__(self, *_): ...

        def scenario(self):
            return world

    monkeypatch.setattr(ceiling, "Cell", Cell)
    study = cs.Study(runs=2, seed=3, jobs=1)
    rows = {row[3]: row for row in ceiling.judged(study, "circle", 4.0, 1.0)}
    results = cs.run_trials(world, ["ekf-uvd"], runs=2, seed=3, jobs=1)
    last = results.estimates[results.estimates["step"] == 20]
    truth = results.truth[results.truth["step"] == 20]
    squared = (last["x"].to_numpy() - truth["x"].to_numpy()) ** 2 + (last["y"].to_numpy() - truth["y"].to_numpy()) ** 2
    assert rows["ekf-uvd"][4:8] == pytest.approx((2, 0, last["nees"].mean(), np.sqrt(squared.mean())))
    assert rows["gtsam-map-uvd"][8:] == (1.0, 1.0, 1.0)
