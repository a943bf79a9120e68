"""A record: runs selected, changed and made into runs of a step, with every array that it has."""

from dataclasses import fields, replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import consistency as cs
from consistency.diagnostics import Bound, BoundErrors, Errors, InnovationRecord, Origin, Record, Runs, Truth
from consistency.referee.diagnostics.groups import Groups
from consistency.referee.diagnostics.record import arrays_of
from consistency.referee.types import Failure

SHAPE = (5, 4)


def numbered(*tail):
    """An array (runs, steps, ...) whose values say the run."""
    rows = np.arange(5.0).reshape(5, *[1] * (1 + len(tail)))
    return np.broadcast_to(rows, (*SHAPE, *tail)).copy()


def all_errors():
    bounded = BoundErrors((Bound("bound_x", ("x",), 0.95), Bound("bound_y", ("y",), 0.95)), numbered(2), numbered(2))
    return Errors(numbered(2), numbered(2, 2), numbered(), 2, ("x", "y"), bounded=bounded)


def full(name="f"):
    """A record with each array that it can have."""
    return Record(
        name,
        all_errors(),
        InnovationRecord(numbered(), numbered(), numbered(3), numbered(3, 3)),
        Runs(np.arange(10, 15), times=numbered(), by=numbered()),
        (Failure(name, 11, 2, "broke"), Failure(name, 14, 3, "hung")),
        Truth(numbered(2, 2)),
        groups=Groups("speed", ("low",), numbered().astype(int), None),
        origin=Origin(path=numbered(2, 2)),
        world=all_errors(),
    )


def test_the_record_has_each_array_that_it_can_have():
    record = full()
    parts = ("innovations", "runs", "truth", "origin")
    for value in (record.errors, record.errors.bounded, record.world, *(getattr(record, part) for part in parts)):
        of_runs = (np.ndarray, BoundErrors)
        arrays = {field.name for field in fields(value) if isinstance(getattr(value, field.name), of_runs)} - {"t"}
        assert arrays == set(value.OF_RUNS)
        assert {field.name for field in fields(value) if "Array" in str(field.type)} - {"t"} <= arrays | {"numbers"}


def test_some_runs_have_the_rows_of_every_array():
    record = replace(full(), guesses={"left": full()})
    rows = np.array([1, 3])
    for some in (record.of_runs(rows), record.of_runs(rows).guesses["left"]):
        assert some.run_numbers.tolist() == [11, 13]
        assert [failure.run for failure in some.failures] == [11]
        assert_array_equal(some.groups.index[:, 0], [1, 3])
        arrays = arrays_of(some) | {f"world {name}": of for name, of in arrays_of(some.in_world).items()}
        assert len(arrays) == 2 * len(arrays_of(some)) == 28
        for name, array in arrays.items():
            if "numbers" not in name:
                assert_array_equal(array.reshape(2, -1)[:, 0], [1, 3], name)
    assert record.first_runs(12).run_numbers.tolist() == [10, 11]


def test_independent_windows_become_runs_of_a_step():
    record = full()
    for values in (record.errors.nees, record.errors.bounded.ratios, record.innovations.nis):
        values[2] = np.nan
    record = replace(record, runs=replace(record.runs, independent=True))
    runs = record.as_runs
    assert runs.runs.unit == "row"
    assert runs.errors.error.shape == (16, 1, 2)  # of 20 steps 4 have no NEES
    assert runs.groups.index.shape == (16, 1)
    assert [failure.step for failure in runs.failures] == [1, 1]
    assert runs.innovations.values.shape == (16, 1, 3)


def test_masked_arrays_are_refused():
    with pytest.raises(cs.InputError, match=r"errors\.nees is a masked array.*filled"):
        cs.make_record("f", nees=np.ma.array(np.ones(SHAPE), mask=True), dof=2)


def test_flat_names_make_the_values():
    record = cs.make_record(
        "f", numbered(2), numbered(2, 2), numbered(), 2, axes=("x", "y"), nis=numbered(), nis_dof=numbered(),
        optimal_gain=True, runs=np.arange(5), unit="row", t=np.arange(4.0), files={0: "a.csv"},
        truth_covariance=numbered(2, 2), truth_errors="common", truth_shared=True,
    )  # fmt: skip
    assert record.errors.names == ("x", "y")
    assert record.innovations.optimal_gain
    assert (record.runs.unit, record.origin.files, record.truth.errors, record.truth.shared) == (
        "row", {0: "a.csv"}, "common", True
    )  # fmt: skip
    assert_array_equal(record.truth.covariance, numbered(2, 2))
    noted = record.with_notes("a").with_notes("b")
    assert noted.origin.notes == ("a", "b")
    assert noted.with_nees(2 * numbered()).errors.nees[1, 0] == 2.0
