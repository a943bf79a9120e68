"""Estimates beside their truth: the one form in which poses are judged."""

from dataclasses import fields, replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from consistency.referee.errors import InputError
from consistency.referee.readers.mix_ups.reading_fit import is_plausible
from consistency.referee.readers.options import Reading, make_reading
from consistency.referee.readers.pipeline.by_column import _columns_of
from consistency.referee.readers.pipeline.records import records_of
from consistency.referee.readers.places import Places
from consistency.referee.readers.truth_matching import (
    NAMES_OF_TRUTH,
    PLACES,
    Estimates,
    Estimator,
    Interpolation,
    Poses,
    RunSource,
    StatedError,
    TrueStates,
    make_poses,
    submatrices,
)

SIGMA = np.array([0.1, 0.1, 0.02])


def run_of(rng, rows=40, run=0, error=SIGMA):
    """Poses every 0.1 s beside a truth of 20 Hz, whose covariance tells its sample; the last three have none.

    The second moments of the errors over all rows are exactly those of ``error``, so that nothing is left to chance.
    """
    z = rng.normal(size=(rows, 3))
    z = z @ np.linalg.inv(np.linalg.cholesky(z.T @ z / rows)).T
    true_t = np.arange(2 * (rows - 3)) * 0.05
    t = np.arange(rows) * 0.1
    truth = np.column_stack([np.sin(true_t), true_t, 0.2 * true_t])
    path = np.column_stack([np.sin(t), t, 0.2 * t])
    return make_poses(
        Places(lambda row: f"line {row}", np.arange(rows)), t, path - error * z,
        np.tile(np.diag(SIGMA**2), (rows, 1, 1)), np.ones(rows, bool), true_t, truth, "planar", "so2", 0.01,
        true_covariance=np.arange(len(true_t))[:, None, None] * np.eye(3), run=run,
    )  # fmt: skip


def estimator_of(*runs):
    return Estimator("est", "est.csv", runs, StatedError(("x", "y", "heading"), "so2", "in words"))


def test_matched_estimates_stand_beside_their_truth(rng):
    p = run_of(rng)
    found = p.matched()
    assert_array_equal(found.own.t, p.own.t[:37])
    assert found.true.t is found.own.t
    assert_allclose(found.true.values, p.true.values[::2][:37], atol=1e-12)
    assert_array_equal(found.true.covariance[:, 0, 0], np.arange(0, 74, 2))
    assert_allclose(found.errors(), p.errors()[:37], rtol=0, atol=1e-15)
    clocks = p.with_values(true_clock=5.0 + p.true.t).matched().true.clock
    assert_allclose(clocks, 5.0 + found.own.t, atol=1e-12)  # that of the sample beside each estimate
    assert found.own.place[5] == "line 5"
    later = p.matched(0.05)
    assert_allclose(later.true.values, p.true.values[1::2], atol=1e-12)
    assert_array_equal(later.true.covariance[:, 0, 0], np.arange(1, 74, 2))
    assert_allclose(later.errors(), p.errors(0.05)[:37], rtol=0, atol=1e-15)
    between = p.with_values(max_dt=0.03).matched(0.02)
    assert_allclose(between.interpolation.apart[:-1], 0.02, atol=1e-12)
    assert (between.interpolation.bend[1:-1] > 0).any()


def test_pairs_keep_each_truth_with_its_estimate(rng):
    found = run_of(rng).with_values(by=np.arange(40.0), true_clock=np.arange(74.0)).matched(0.02)
    for kept in (np.array([3, 4, 9]), np.isin(np.arange(37), (3, 4, 9))):
        some = found.pairs(kept)
        assert_array_equal(some.own.by, [3, 4, 9])
        assert_array_equal(some.true.values, found.true.values[[3, 4, 9]])
        assert_array_equal(some.true.covariance, found.true.covariance[[3, 4, 9]])
        assert_array_equal(some.true.clock, found.true.clock[[3, 4, 9]])
        for name in ("apart", "bend"):
            assert_array_equal(getattr(some.interpolation, name), getattr(found.interpolation, name)[[3, 4, 9]])
        assert_array_equal(some.errors(), found.errors()[[3, 4, 9]])
    assert found.pairs(found.own.stated) is found


def full():
    """Poses with each array that they can have: N = 6 estimates, M = 8 samples, whose values say the row."""
    own = {each.name: np.arange(6.0) for each in fields(Estimates) if each.name != "place"}
    true = {name: np.arange(8.0) for name in NAMES_OF_TRUTH}
    place = Places(lambda row: f"line {row}", np.arange(6))
    poses = make_poses(place, **own | true, manifold="vector", convention="vector", max_dt=0.0)
    return replace(poses, interpolation=Interpolation(np.arange(6.0), np.arange(6.0)))


def arrays_of(value):
    """All arrays of a value by name."""
    return {each.name: getattr(value, each.name) for each in fields(value) if each.name != "place"}


def test_rows_are_taken_of_every_array():
    poses = full()
    rows = np.array([1, 4])
    some = poses.of_rows(rows)
    assert len(arrays_of(some.own)) == 11
    for value in (some.own, some.interpolation):
        for name, array in arrays_of(value).items():
            assert_array_equal(array, rows, name)
    assert some.own.place[1] == "line 4"
    assert some.true is poses.true
    beside = poses.beside(rows)
    assert len(arrays_of(beside.true)) == 4
    for name, array in arrays_of(beside.true).items():
        assert_array_equal(array, rows, name)
    assert beside.own is poses.own
    both = poses.pairs(rows)
    assert both.true.t is both.own.t
    assert_array_equal(both.true.values, rows)
    assert poses.of_rows(np.arange(6)) is poses  # nothing is copied
    assert poses.own.of_rows(np.arange(6)) is poses.own


def test_each_value_of_poses_has_a_name_and_few_have_many():
    poses = full()
    parts = {"own": Estimates, "true": TrueStates, "source": RunSource}
    assert {place for place in PLACES.values() if place[0]} == {
        (part, each.name) for part, kind in parts.items() for each in fields(kind)
    }
    assert max(len(fields(kind)) for kind in (Poses, Estimator, StatedError, *parts.values())) <= 12
    for name, (part, field) in PLACES.items():
        changed = poses.with_values(**{name: "other"})
        assert changed.value(name) == "other"
        assert getattr(getattr(changed, part) if part else changed, field) == "other"
        assert sum(changed.value(each) is not poses.value(each) for each in PLACES) == 1
    with pytest.raises(KeyError, match="thruth"):
        poses.with_values(thruth=1.0)


def test_only_what_is_matched_and_stated_is_judged(rng):
    p = run_of(rng)
    stated = np.arange(40) != 7
    p = p.with_values(stated=stated, covariance=np.where(stated[:, None, None], p.own.covariance, 1e9))
    (record,) = records_of(estimator_of(p), Reading())
    assert record.errors.error.shape == (1, 36, 3)
    assert np.nanmax(record.errors.covariance) < 1.0
    assert (
        "est: 4 of 40 estimates have no truth or no covariance within 0.01 s (--max-dt) and are left out"
        in record.origin.notes
    )
    with pytest.raises(InputError, match="no estimate has both a truth and a covariance"):
        records_of(estimator_of(p.with_values(stated=np.zeros(40, bool))), Reading())


def test_errors_that_fit_are_plausible_and_others_are_not(rng):
    right = [run_of(rng, 200, run) for run in range(10)]
    assert is_plausible(right, range(3))
    assert not is_plausible([run_of(rng, 200, error=4.0 * SIGMA)], range(3))
    assert not is_plausible([p.with_values(covariance=np.sqrt(p.own.covariance)) for p in right], range(3))
    assert not is_plausible([run_of(rng, error=0.0 * SIGMA)], range(3))
    half = [p.with_values(estimate=p.own.estimate * [1.0, 1.0, 57.3]) for p in right]
    assert is_plausible(half, [0, 1])
    assert not is_plausible(half, range(3))


def test_mix_ups_are_looked_for_at_the_times_that_an_offset_gives(rng):
    """In 0.3 s the path moves by 3 sigma, which hide what is wrong."""
    runs = []
    for run in range(10):
        p = run_of(rng, 200, run)
        runs.append(p.with_values(t=p.own.t - 0.3, covariance=np.sqrt(p.own.covariance)))
    (record,) = records_of(estimator_of(*runs), make_reading(time_offset=0.3))
    (cause,) = record.origin.causes
    assert "its diagonal holds standard deviations" in cause


def test_a_start_that_is_known_exactly_is_no_estimate(rng):
    p = run_of(rng, 4)
    t = np.array([0.0])
    start = p.of_rows(np.array([0])).with_values(t=t, true_t=t, numbered=True, covariance=np.zeros((1, 3, 3)))
    with pytest.raises(InputError, match=r"est.csv: holds the start alone, step 0, .* add steps from 1 on"):
        records_of(estimator_of(start.with_values(truth=p.true.values[:1], true_covariance=None)), Reading())


def test_some_components_of_matrices(rng):
    P = rng.normal(size=(4, 3, 3))
    assert_array_equal(submatrices(P, [0, 2]), P[np.ix_(range(4), [0, 2], [0, 2])])
    assert_array_equal(submatrices(P, range(1, 3)), P[:, 1:, 1:])


def test_columns_of_a_state_pass_over_the_four_numbers_of_a_rotation(rng):
    """Components 3 to 5 are the rotation, whose columns 3 to 6 are a quaternion."""
    planar = estimator_of(run_of(rng))
    assert_array_equal(_columns_of(planar, [0, 2]), [0, 2])
    assert_array_equal(_columns_of(planar.with_error(in_space=True), [0, 2, 3, 5, 6, 8]), [0, 2, 7, 9])
    assert len(_columns_of(planar.with_error(convention=""), [0, 2])) == 0
