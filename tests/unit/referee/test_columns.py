"""What columns are found by their names: poses in space, states, covariances, times; tables of planar poses."""

import itertools
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose
from recorded import read_recordings

import consistency as cs
from consistency.referee.readers.formats.columns import (
    OWN,
    PLAIN,
    TRUE,
    Clock,
    alike,
    clock_of,
    covariance_columns,
    pose_columns,
    rates_in,
    run_column,
    state_columns,
    true_pose_columns,
)
from consistency.referee.readers.formats.restated import text_files
from consistency.referee.readers.formats.sheet import read_sheet
from consistency.referee.readers.formats.table_columns import with_clock
from consistency.referee.readers.options import Reading, make_reading

HERE = Path("a.csv")
POSE = ("x", "y", "heading")
SPACE = ["t", "x", "y", "z", "qx", "qy", "qz", "qw"]


def named(names, places):
    return [names[place] for place in places]


def entries(names, axes):
    found = covariance_columns(names, axes)
    return {pair: names[place] for pair, place in found.places.items()}, found.squared, found.renamed


# --- covariances of states ---------------------------------------------------------------------------


def test_names_of_the_documentation_come_first():
    own = {(0, 0): "P_a_a", (0, 1): "P_a_b", (1, 1): "P_b_b"}
    others = [f"P{i}{j}" for i, j in itertools.product("12", repeat=2)]
    assert entries([*others, *own.values(), "sigma_a", "sigma_b"], ["a", "b"]) == (own, True, False)
    assert entries(["sigma_a", "sigma_b", *others], ["a", "b"]) == (
        {(0, 0): "sigma_a", (1, 1): "sigma_b"},
        False,
        False,
    )
    short = {(0, 0): "P_xx", (0, 2): "P_xh", (2, 1): "P_hy", (1, 1): "P_yy", (2, 2): "P_hh"}
    assert entries(list(short.values()), POSE) == (short, True, False)


def test_the_spelling_with_most_columns_counts():
    numbered = [f"P{i}{j}" for i, j in itertools.product("12", repeat=2)]
    found, squared, renamed = entries(["cov_aa", "cov_ab", "cov_bb", *numbered], ["a", "b"])
    assert (found[1, 0], squared, renamed) == ("P21", True, True)
    found, *_ = entries(["var_a", "var_b", "cov_ab"], ["a", "b"])
    assert found == {(0, 0): "var_a", (1, 1): "var_b", (0, 1): "cov_ab"}
    assert entries(["a_sd", "b_sd", "P11"], ["a", "b"]) == ({(0, 0): "a_sd", (1, 1): "b_sd"}, False, False)
    assert entries(["A_sd", "B_sd"], ["a", "b"])[1:] == (False, True)
    assert entries(["P_a_b", "sigma_a", "sigma_b"], ["a", "b"])[:2] == (
        {(0, 1): "P_a_b"},
        True,
    )  # refused, not left out


@pytest.mark.parametrize(
    "names, n, alone",
    [
        (["P_a_a"], 1, False),
        (["sigma_a"], 1, True),
        (["P_a_a", "P_b_b"], 2, True),
        (["P_a_a", "P_b_b", "P_b_a"], 2, False),
        (["P_a_a", "P_b_b"], 3, False),
    ],
)
def test_variances_alone_are_judged_by_themselves(names, n, alone):
    assert covariance_columns(names, ["a", "b", "c"][:n]).without_cross_terms(n) == alone


def test_a_name_that_two_columns_have_is_none():
    once = {"x": 0}
    assert alike(once, ["x"], PLAIN) == (0,)
    assert alike(once, ["x", "y"], PLAIN) == ()
    names = ["var_a", "VAR a", "var_b"]
    assert covariance_columns(names, ["a", "b"]).places == {}


# --- states, speeds and times ------------------------------------------------------------------------


def test_components_by_own_and_other_names():
    names = ["t", "x_est", "py", "theta", "true_x", "x_gt", "gt_psi"]
    assert state_columns(names, POSE, OWN) == {"x": 1, "y": 2, "heading": 3}
    assert state_columns(names, POSE, PLAIN) == {"y": 2, "heading": 3}
    assert state_columns(names, POSE, TRUE) == {"x": 4, "heading": 6}
    assert state_columns(["b", "est_b", "B"], ["b"], OWN) == {"b": 0}


def test_a_speed_and_a_turn_rate():
    names = ["t", "twist.linear.x", "twist.angular.z"]
    assert rates_in(names) == (1, 2)
    assert rates_in(names[:2]) == ()
    assert rates_in(["a_v", "omega"]) == ()  # a longer name ends in two words


@pytest.mark.parametrize(
    "names, clock",
    [
        (["sec", "t", "nsec"], Clock((0, 2), 1)),
        (["a", "time [ms]"], Clock((1,), 1000)),
        (["t", "x.header.stamp"], Clock((1,), None)),
        (["", "x"], Clock((0,), None)),
        (["x"], None),
    ],
)
def test_the_time_of_a_file(names, clock):
    assert clock_of(names) == clock


def test_nanoseconds_are_read_to_the_last_digit(tmp_path):
    first = 1403715273262143016
    last = 1403715273262144446
    assert float(last) / 1e9 != last / 10**9
    (tmp_path / "a.csv").write_text(f"timestamp,a\n{first},1\n{last},2\n")
    whole = with_clock(read_sheet(tmp_path / "a.csv"))
    assert whole.data["t"].tolist() == [first / 10**9, last / 10**9]
    turned = with_clock(read_sheet(tmp_path / "a.csv").rows(np.array([1, 0])))
    assert_allclose(turned.data["t"], whole.data["t"][::-1], atol=1e-6)


# --- poses in space ----------------------------------------------------------------------------------


def test_a_pose_with_its_truth_beside_it():
    names = ["qw", "qx", "qy", "qz", *(f"pos_{a}" for a in "xyz"), "stamp", *(f"true_{name}" for name in SPACE[1:])]
    found = pose_columns(names, HERE)
    assert found is not None
    assert named(names, found.position + found.quaternion) == ["pos_x", "pos_y", "pos_z", "qx", "qy", "qz", "qw"]
    true = true_pose_columns(names, HERE)
    assert true is not None
    assert named(names, true.position + true.quaternion) == [f"true_{name}" for name in SPACE[1:]]
    assert true.clock == found.clock == Clock((7,), None)
    assert pose_columns(names[:7], HERE) is None


def test_a_covariance_in_space_by_its_words():
    words = ["x", "y", "z", "rx", "ry", "rz"]
    lower = [f"cov_{b}_{a}" for a, b in itertools.combinations_with_replacement(words, 2)]
    names = [*SPACE, *reversed(lower)]
    found = pose_columns(names, HERE)
    assert found is not None
    assert named(names, found.covariance) == lower
    without = pose_columns([name for name in names if name != "cov_rz_x"], HERE)
    assert without is not None
    assert without.covariance == ()


def test_the_largest_covariance_with_a_velocity():
    words = ["x", "y", "z", "roll", "pitch", "yaw", "vx", "vy", "vz"]
    both = [f"P_{a}_{b}" for a, b in itertools.product(words, repeat=2)]
    names = [*SPACE, *words[6:], *both]
    found = pose_columns(names, HERE)
    assert found is not None
    assert len(found.covariance) == 45
    assert named(names, found.rest) == ["vx", "vy", "vz"]
    some = pose_columns([name for name in names if "v" not in name or name == "yaw"], HERE)
    assert some is not None
    assert (len(some.covariance), some.rest) == (21, ())


def test_which_deviations_count():
    words = ["x", "y", "z", "roll", "pitch", "yaw"]
    variances = [f"var_{word}" for word in words]
    deviations = [f"sd_{word}" for word in words]
    numbers = [f"P{i}{j}" for i, j in itertools.product("123456", repeat=2)]
    for more, expected, squared in (
        (variances, variances, True),
        ([*variances, *deviations], deviations, False),
        ([*numbers, *deviations], deviations, False),
        ([*variances, *numbers], numbers, False),
    ):
        found = pose_columns([*SPACE, *more], HERE)
        assert found is not None
        assert (named([*SPACE, *more], found.covariance), found.squared) == (expected, squared)


def test_numbers_under_another_word_do_not_count_with_those_of_a_covariance():
    numbers = [f"cov_{i}_{j}" for i, j in itertools.product(range(6), repeat=2)]
    names = [*SPACE, *numbers, "P11", *(f"twist.covariance{i}" for i in range(36))]
    found = pose_columns(names, HERE)
    assert found is not None
    assert named(names, found.covariance) == numbers


# --- tables of planar poses --------------------------------------------------------------------------


def plane(heading, **more):
    rng = np.random.default_rng()
    rows = 6
    table = pd.DataFrame({"t": np.arange(rows) / 4.0, "x": rng.normal(size=rows), "y": rng.normal(size=rows)})
    table[heading] = rng.normal(size=rows)
    for name in ("P_xx", "P_yy", "P_hh"):
        table[name] = 1.0 + rng.random(rows)
    return table.assign(P_xy=0.1, P_xh=0.0, P_yh=0.2, **more)


def test_other_names_of_a_heading_change_nothing_else(inside):
    """Runs, estimators, NIS and the column of --by are there, whatever the heading is called."""
    both = []
    for name in ("heading", "theta"):
        parts = []
        for run, own in itertools.product(range(2), ("one", "two")):
            table = plane(name, nis=1.0, nis_dof=2, run=run, filter=own, light=np.repeat(["day", "dusk"], 3))
            parts.append(table)
        both.append(pd.concat(parts))
    both[1].loc[:, both[1].columns != "theta"] = both[0].loc[:, both[0].columns != "heading"].to_numpy()
    both[1]["theta"] = both[0]["heading"].to_numpy()
    truth = plane("heading")[["t", "x", "y", "heading"]]
    truth.to_csv("truth.csv", index=False)
    found = []
    for name, table in zip(("heading.csv", "theta.csv"), both, strict=True):
        table.to_csv(name, index=False)
        found.append(read_recordings(Path(name), Path("truth.csv"), by="light"))
    for own, other in zip(*found, strict=True):
        assert (own.name, own.run_numbers.tolist()) == (other.name, [0, 1])
        assert_allclose(other.errors.nees, own.errors.nees, rtol=1e-12)
        assert_allclose(other.innovations.nis, own.innovations.nis)
        assert other.groups.names == own.groups.names
    assert any("theta.csv: read as planar poses" in note for note in found[1][0].origin.notes)


def test_speeds_of_several_runs_are_refused(inside):
    pd.DataFrame({"run": 0, "t": [0.0, 1.0], "v": 1.0, "omega": 0.0}).to_csv("odo.csv", index=False)
    plane("heading").to_csv("truth.csv", index=False)
    with pytest.raises(cs.InputError, match=r"odo\.csv: column 'run' or 'filter': write such poses to a file for each"):
        cs.read("odo.csv", truth="truth.csv", motions=True, relative=1)


def test_a_nis_that_cannot_be_is_refused_with_its_place(inside):
    nis = np.ones((2, 4))
    nis[1, 2] = -2.0
    errors = np.random.default_rng().normal(size=(2, 4, 1))
    rows = {"errors": errors, "covariances": np.ones((2, 4, 1, 1))}
    np.savez("a.npz", nis=nis, nis_dof=2, **rows)
    with pytest.raises(cs.InputError, match=r"a\.npz, run 1, step 3: nis -2 with nis_dof 2; nis must be 0 or more"):
        cs.read("a.npz")
    nis[1, 2] = np.nan
    np.savez("a.npz", nis=nis, nis_dof=np.where(np.isnan(nis), -1, 2), **rows)
    assert cs.read("a.npz").innovations.nis_dof[1].tolist() == [2, 2, 0, 2]
    plane("heading", nis=np.arange(6.0) - 1.0, nis_dof=2).to_csv("est.csv", index=False)
    plane("heading").to_csv("truth.csv", index=False)
    with pytest.raises(cs.InputError, match=r"est\.csv, line 2: nis -1 with nis_dof 2"):
        cs.read("est.csv", truth="truth.csv")


# --- files written again -----------------------------------------------------------------------------


def restated(names, r):
    Path("a.csv").write_text(f"{','.join(names)}\n{','.join(['1.0'] * len(names))}\n")
    found = text_files(Path("a.csv"), r)
    if not found:
        return None
    return {names[place]: pair for place, pair in found[0].entries.items()}, found[0].squared


def test_where_the_covariances_of_a_file_stand(inside):
    state = make_reading(state=("a", "b"))
    both = ["t", "a", "b", "P11", "P12", "P21", "P22"]
    assert restated(both, state) == (
        {"P11": ("a", "a"), "P12": ("a", "b"), "P21": ("b", "a"), "P22": ("b", "b")}, True
    )  # fmt: skip
    assert restated(["t", "a", "b", "a_sd", "b_sd"], state) == ({"a_sd": ("a", "a"), "b_sd": ("b", "b")}, False)
    assert restated(["t", "a", "b"], state) is None
    words = ["x", "y", "z", "roll", "pitch", "yaw"]
    variances = [*SPACE, *(f"var_{word}" for word in words)]
    assert restated(variances, Reading()) == ({f"var_{word}": (word, word) for word in words}, True)
    deviations = [*SPACE, *(f"sd_{word}" for word in words)]
    turned = make_reading(covariance_order="rotation-translation")
    assert restated(deviations, turned) == (
        {f"sd_{word}": (axis, axis) for word, axis in zip(words, [*words[3:], *words[:3]], strict=True)}, False
    )  # fmt: skip


@pytest.mark.parametrize(
    "names, run",
    [(["t", "Drive"], "Drive"), (["trial", "run_id"], "run_id"), (["run", "drive"], None), (["t", "driven"], None)],
)
def test_the_column_that_numbers_runs(names, run):
    assert run_column(names) == run
