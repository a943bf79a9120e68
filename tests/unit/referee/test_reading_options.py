"""Options of files: one record for readers, commands and Python; tables in memory are read as files of them are."""

import inspect
from dataclasses import fields

import numpy as np
import pandas as pd
import pytest
from command import consistency
from draws import identities
from numpy.testing import assert_allclose
from recorded import notes_of, read_recordings
from records import changed

import consistency as cs
from consistency.diagnostics import make_record
from consistency.referee import notebook
from consistency.referee.readers.options import MAX_DT, OPTIONS, Reading, flag_of, make_reading
from consistency.referee.readers.pipeline.read_files import own_names
from consistency.testing import assert_consistent


def test_python_has_every_option_of_files():
    names = list(inspect.signature(cs.read).parameters)
    assert names == ["estimates", *(each.name for each in OPTIONS), "filter"]


def test_each_option_of_python_reaches_the_readers_under_its_name(monkeypatch):
    given = {each.name: f"the {each.name}" for each in OPTIONS}
    seen = []
    monkeypatch.setattr(notebook, "read_recordings", lambda path, reading: [seen.append(reading)])
    with pytest.raises(AttributeError):  # of a record that is None
        cs.read("est.csv", **given)
    assert {name: str(value) for name, value in seen[0].as_options().items()} == given
    assert seen[0] == make_reading(**{name: seen[0].option(name) for name in given})


def test_each_option_is_a_field_of_one_value():
    """Every value of a reading has few fields, and no option stands in two of them."""
    values = [getattr(Reading(), part.name) for part in fields(Reading)]
    names = [each.name for value in values for each in fields(value)]
    assert len(set(names)) == len(names)
    assert set(names) == {each.name for each in OPTIONS} | {"unstated"}
    assert max(len(fields(value)) for value in (Reading(), *values)) <= 12
    for name in names:
        changed = make_reading(**{name: "given"})
        assert changed.given() == [name]
        assert changed.as_options() == {name: "given"}
        assert changed.option(name) == "given"
        others = [part for value, part in zip(values, fields(Reading), strict=True) if not hasattr(value, name)]
        assert all(getattr(changed, part.name) == getattr(Reading(), part.name) for part in others)
        assert changed.with_options(**{name: None}) == Reading()
    with pytest.raises(TypeError, match="thruth"):
        make_reading(thruth="truth.csv")


def test_what_follows_from_options():
    assert (Reading().matching.tolerance, Reading().matching.shift) == (MAX_DT, 0.0)
    given = make_reading(max_dt=0.5, time_offset=-2.0, motions=False)
    assert (given.matching.tolerance, given.matching.shift) == (0.5, -2.0)
    assert make_reading(time_offset="estimate").matching.shift == 0.0
    assert given.with_truth("a.csv").with_error("left").given() == [
        "truth", "error", "max_dt", "time_offset", "motions"
    ]  # fmt: skip
    assert (make_reading(by="q").groups.own_column, make_reading(by="q", by_file="f").groups.own_column) == ("q", None)
    assert given.given() == ["max_dt", "time_offset", "motions"]
    assert given.given(["axes", "time_offset"]) == ["time_offset"]
    assert flag_of("max_dt") == "--max-dt"


@pytest.fixture
def tables(tmp_path):
    """Two components at 0.3 s and so on, and a truth that is t and -t at whole seconds."""
    t = np.arange(1.0, 9.0)
    est = "t,a,b,P_a_a,P_a_b,P_b_b\n" + "".join(f"{k + 0.3},{k + 0.4},{-k},1,0,1\n" for k in t)
    (tmp_path / "est.csv").write_text(est)
    (tmp_path / "truth.csv").write_text("t,a,b\n" + "".join(f"{k},{k},{-k}\n" for k in range(12)))
    return tmp_path / "est.csv", tmp_path / "truth.csv"


def test_readers_take_tolerance_and_offset(tables):
    with pytest.raises(cs.InputError, match=r"within 0\.01 s \(--max-dt\)"):
        read_recordings(*tables, state=["a", "b"])
    (near,) = read_recordings(*tables, state=["a", "b"], max_dt=0.3)
    assert_allclose(near.errors.error[0], [[-0.1, -0.3]] * 8, atol=1e-12)
    (moved,) = read_recordings(*tables, state=["a", "b"], time_offset=-0.3)
    assert_allclose(moved.errors.error[0], [[-0.4, 0.0]] * 8, atol=1e-12)
    (whole,) = read_recordings(*tables, state=["a", "b"], time_offset=-1, max_dt=0.3)
    assert_allclose(whole.errors.error[0], [[-1.1, 0.7]] * 8, atol=1e-12)


def test_windows_are_moved_by_an_offset(tmp_path):
    rows = "".join(f"{k + 0.5},1,0,0,1,0,0,1,0,1\n" for k in range(12))
    (tmp_path / "est.csv").write_text("t,x,y,heading,P_xx,P_xy,P_xh,P_yy,P_yh,P_hh\n" + rows)
    (tmp_path / "truth.csv").write_text("t,x,y,heading\n" + "".join(f"{k},{k},0,0\n" for k in range(12)))
    files = tmp_path / "est.csv", tmp_path / "truth.csv"
    with pytest.raises(cs.InputError, match=r"within 0\.01 s \(--max-dt\)"):
        read_recordings(*files, relative=2, motions=True)
    (record,) = read_recordings(*files, time_offset=-0.5, relative=2, motions=True)
    assert_allclose(record.errors.error, np.zeros((1, 5, 3)), atol=1e-12)


def test_motions_has_no_opposite(capsys):
    shown, _ = consistency(capsys, "analyse", "--help-all")
    assert "--motions " in shown
    assert "--no-motions" not in shown


def test_names_on_the_command_line_may_have_spaces(tables, capsys):
    consistency(capsys, "analyse", tables[0], "--truth", tables[1], "--state", "a, b", "--time-offset", "-0.3")


def test_a_step_without_a_measurement_has_no_covariance_to_check(rng):
    v = rng.normal(size=(400, 10, 2))
    S = identities(v).copy()
    v[:, 3] = S[:, 3] = np.nan
    assert assert_consistent(innovations=v, innovation_covariances=S, optimal_gain=True).status == "consistent"


# --- tables in memory -----------------------------------------------------------------------------------------


STEPS = 8
OWN = ["run", "t", "a", "b", "P_a_a", "P_a_b", "P_b_b"]


def frames():
    rng = np.random.default_rng()
    run, t = np.repeat([0, 1], STEPS), np.tile(0.1 * np.arange(STEPS), 2)
    truth = pd.DataFrame({"run": run, "t": t, "a": rng.normal(size=2 * STEPS), "b": rng.normal(size=2 * STEPS)})
    values = np.column_stack([run, t, truth[["a", "b"]] + rng.normal(size=(2 * STEPS, 2))])
    P = np.tile([2.0, 0.5, 1.0], (2 * STEPS, 1))
    return pd.DataFrame(np.column_stack([values, P]), columns=OWN), truth


class Columns:
    """The least that a table has to be."""

    def __init__(self, frame):
        self.columns, self._frame = tuple(frame.columns), frame

    def __getitem__(self, name):
        return list(self._frame[name])


@pytest.mark.parametrize(
    "wrap", [lambda frame: frame, Columns, lambda frame: frame.sample(frac=1).sort_values(["run", "t"])]
)
def test_a_table_is_read_as_its_file(wrap, tmp_path):
    own, truth = frames()
    own.to_csv(tmp_path / "own.csv", index=False)
    truth.to_csv(tmp_path / "truth.csv", index=False)
    files = cs.read(tmp_path / "own.csv", truth=tmp_path / "truth.csv", state=["a", "b"])
    record = cs.read(wrap(own), truth=wrap(truth), state=["a", "b"])
    assert_allclose(record.errors.nees, files.errors.nees, rtol=1e-9)
    e = truth[["a", "b"]].to_numpy() - own[["a", "b"]].to_numpy()
    assert_allclose(
        record.errors.nees.ravel(), np.einsum("ni,ni->n", e, np.linalg.solve([[2.0, 0.5], [0.5, 1.0]], e.T).T)
    )
    mixed = cs.read(wrap(own), truth=tmp_path / "truth.csv", state=["a", "b"])
    assert_allclose(mixed.errors.nees, files.errors.nees, rtol=1e-9)
    assert record.name == "estimates"


def test_columns_are_called_as_their_user_does(tmp_path):
    """In the verdict; the record keeps the names by which blocks are known and files are compared."""
    own, truth = frames()
    own = own.rename(columns={"a": "pos_n", "b": "pos_e"})
    columns = {"a": "pos_n", "b": "pos_e"}
    verdict = cs.judge(cs.read(own, truth=truth, state=["a", "b"], columns=columns))
    assert verdict.statistics["axes"] == ("pos_n", "pos_e")
    assert {"pos_n", "pos_e"} <= set(verdict.axes.inflation)
    record = cs.read(own, truth=truth, state=["a", "b"], columns=columns)
    assert (record.errors.axes, record.errors.names) == (("a", "b"), ("pos_n", "pos_e"))


@pytest.mark.parametrize(
    "of_record, columns, align, names",
    [
        ({}, {"x": "pos_n", "v*": "vel_*"}, None, ("pos_n", "y", "vel_x")),
        ({}, {"P*": "C*", "t": "stamp"}, None, ("x", "y", "vx")),
        ({"convention": "left"}, {"x": "pos_n"}, None, ("x", "y", "vx")),
        ({"window": "10 s"}, {"x": "pos_n"}, None, ("x", "y", "vx")),
        ({}, {"x": "pos_n"}, "posyaw", ("x", "y", "vx")),
    ],
)
def test_components_have_names_of_columns_whose_error_is_theirs(of_record, columns, align, names):
    record = changed(make_record("f", axes=("x", "y", "vx"), convention="so3"), **of_record)
    own = own_names(record, make_reading(columns=columns, align=align))
    assert changed(record, own_names=own).errors.names == names


def test_blocks_are_known_whatever_their_axes_are_called(rng):
    record = make_record("f", rng.standard_normal((30, 5, 4)), np.eye(4), axes=("x", "y", "heading", "vx"))
    record = changed(record, covariance=np.broadcast_to(np.eye(4), (30, 5, 4, 4)), own_names={"x": "n", "y": "e"})
    verdict = cs.judge(record)
    assert verdict.statistics["groups"]["position"] == [0, 1]
    assert verdict.accuracy.rmse_position == pytest.approx(np.hypot(*verdict.accuracy.rmse[:2]))
    parts = cs.judge(changed(record, parts=((0, 1), (2,), (3,))))
    assert list(parts.parts) == ["n, e", "heading", "vx"]


def test_a_truth_that_is_named_in_part_is_said_not_to_be_used(tmp_path):
    own, truth = frames()
    own["true_a"], own["nis"], own["nis_dof"] = truth["a"], 1.0, 2
    record = cs.read(own, state=["a", "b"])
    assert record.errors.error is None
    assert any("only the NIS is read" in note and "column 'true_b' is missing" in note for note in record.origin.notes)
    own["true_b"] = truth["b"]
    assert "only the NIS" not in notes_of(cs.read(own, state=["a", "b"]))


def test_missing_values_and_filters(tmp_path):
    own, truth = frames()
    own.loc[5, "a"] = np.nan
    assert [(f.run, f.step) for f in cs.read(own, truth=truth, state=["a", "b"]).failures] == [(0, 6)]
    nullable = own.astype({"a": "Float64"})
    assert [(f.run, f.step) for f in cs.read(nullable, truth=truth, state=["a", "b"]).failures] == [(0, 6)]
    mixed = own.astype({"a": object})
    mixed.loc[5, "a"] = pd.NA
    assert [(f.run, f.step) for f in cs.read(mixed, truth=truth, state=["a", "b"]).failures] == [(0, 6)]
    both = pd.concat([own.assign(filter="ekf"), own.assign(filter="ukf")])
    assert cs.read(both, truth=truth, state=["a", "b"], filter="ukf").name == "ukf"
    with pytest.raises(cs.InputError, match=r"^estimates: holds several estimators \(ekf, ukf\)"):
        cs.read(both, truth=truth, state=["a", "b"])
    with pytest.raises(cs.InputError, match=r"^filter 'pf' is not in estimates"):
        cs.read(both, truth=truth, state=["a", "b"], filter="pf")


def test_what_is_wrong_is_named_by_table_and_row(tmp_path):
    own, truth = frames()
    with pytest.raises(cs.InputError, match=r"^truth: column 'b' is missing"):
        cs.read(own, truth=truth.drop(columns="b"), state=["a", "b"])
    with pytest.raises(cs.InputError, match=r"^estimates, row 3: column 'a': not a number \(east\)"):
        cs.read(own.astype({"a": object}).replace({"a": {own["a"][2]: "east"}}), truth=truth, state=["a", "b"])
    with pytest.raises(cs.InputError, match=r"^estimates: holds no row"):
        cs.read(own[:0], truth=truth, state=["a", "b"])
    with pytest.raises(cs.InputError, match=r"^estimates: column 'a' is duplicated"):
        cs.read(own.rename(columns={"b": "a"}), truth=truth, state=["a", "b"])
    with pytest.raises(cs.InputError, match=r"^estimates: needs truth=FILE"):
        cs.read(own, state=["a", "b"])
    with pytest.raises(cs.InputError, match=r"^covariance: does not go with tables in memory"):
        cs.read(own, truth=truth, covariance="P.txt", state=["a", "b"])


def test_runs_and_steps_the_wrong_way_round_are_named():
    errors, P = np.random.default_rng().normal(size=(4, 9, 2)), np.broadcast_to(np.eye(2), (9, 4, 2, 2))
    with pytest.raises(cs.InputError, match=r"\(9, 4, 2, 2\), needs \(4, 9, 2, 2\); runs and steps are swapped in one"):
        cs.judge(errors, P)
    with pytest.raises(cs.InputError, match=r"\(3, 9, 2, 2\), needs \(4, 9, 2, 2\)$"):
        cs.judge(errors, np.broadcast_to(np.eye(2), (3, 9, 2, 2)))


def test_a_truth_the_wrong_way_round_is_named(tmp_path):
    own = np.random.default_rng().normal(size=(4, 9, 2))
    np.savez(
        tmp_path / "a.npz",
        estimates=own,
        truth=np.swapaxes(own, 0, 1),
        covariances=identities(own),
    )
    with pytest.raises(cs.InputError, match=r"'estimates' \(4, 9, 2\); runs and steps are swapped in one"):
        cs.read(tmp_path / "a.npz")
