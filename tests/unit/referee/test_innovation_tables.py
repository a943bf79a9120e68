"""NIS and innovations under other names, in the monitor and in a verdict."""

import io
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from command import consistency, refused
from numpy.testing import assert_allclose

import consistency as cs
from consistency.referee.readers.formats.innovation_files import read_nis
from consistency.referee.verdicts.monitor_sources import skip_first

OPTIMAL = ("--innovations", "optimal")
V = np.array([[0.3, -0.2], [0.1, 0.4], [-0.6, 0.0]])
S = np.array([[0.09, 0.02], [0.02, 0.16]])


pytestmark = pytest.mark.usefixtures("inside")


def write(name, header, *columns):
    np.savetxt(name, np.column_stack(columns), delimiter=",", header=header, comments="", fmt="%.12g")
    return name


@pytest.mark.parametrize("header", ["t,NIS,DOF", "t,Nis,nis_dof", "t,normalized_innovation_squared,innovation_dof"])
def test_the_nis_in_other_spellings(header):
    log = read_nis(Path(write("a.csv", header, [0.1, 0.2, 0.3], [1.0, 5.0, 2.0], [2, 2, 1])))
    assert_allclose(log.nis, [1.0, 5.0, 2.0])
    assert_allclose(log.dof, [2, 2, 1])
    assert_allclose(log.t, [0.1, 0.2, 0.3])


one = V[:, 0]
variance = np.full(3, 0.09)


@pytest.mark.parametrize(
    "header, columns, nis, dof",
    [
        ("t,innovation,innovation_variance", [one, variance], one**2 / 0.09, 1),
        ("t,innov,innov_std", [one, np.sqrt(variance)], one**2 / 0.09, 1),
        ("t,Innovation [m],S", [one, variance], one**2 / 0.09, 1),
        ("t,innovation,var_innovation", [one, variance], one**2 / 0.09, 1),
        (
            "t,innovation_x,innovation_y,innovation_x_var,innovation_y_var",
            [V, variance, np.full(3, 0.16)],
            (V**2 / [0.09, 0.16]).sum(axis=1),
            2,
        ),
        (
            "t,x_innovation,x_innovation_std,y_innovation,y_innovation_std",
            [V[:, 0], np.full(3, 0.3), V[:, 1], np.full(3, 0.4)],
            (V**2 / [0.09, 0.16]).sum(axis=1),
            2,
        ),
        (
            "t,innovation_0,innovation_1,S_0_0,S_0_1,S_1_0,S_1_1",
            [V, np.tile(S.ravel(), (3, 1))],
            np.einsum("ki,ij,kj->k", V, np.linalg.inv(S), V),
            2,
        ),
        (
            "t,innovation_a,innovation_b,S_a_a,S_a_b,S_b_b",
            [V, np.tile(S[np.triu_indices(2)], (3, 1))],
            np.einsum("ki,ij,kj->k", V, np.linalg.inv(S), V),
            2,
        ),
    ],
)
def test_the_nis_of_innovations(header, columns, nis, dof):
    log = read_nis(Path(write("a.csv", header, np.arange(3), *columns)))
    assert_allclose(log.nis, nis, rtol=1e-9)
    assert_allclose(log.dof, dof)
    assert any("the NIS is that of" in note for note in log.notes)


def test_components_without_a_measurement_do_not_count():
    rows = "0,0.3,,0.09,0.16", "1,0,0,0,0", "2,0.3,0.4,0.09,0.16"
    header = "t,innovation_x,innovation_y,innovation_x_var,innovation_y_var"
    Path("a.csv").write_text("\n".join((header, *rows)))
    log = read_nis(Path("a.csv"))
    assert_allclose(log.nis, [1.0, np.nan, 2.0])
    assert_allclose(log.dof, [1, 0, 2])


def test_other_columns_are_not_innovations():
    """The deviation of a state beside an innovation, a ratio and a norm are not the variance of it."""
    path = Path(write("a.csv", "t,x,s_x,innovation_x,innovation_x_test_ratio", np.ones((3, 5)).cumsum(axis=0)))
    with pytest.raises(cs.InputError, match=r"a\.csv: 'nis' is missing; .*innovation_variance.*--columns nis="):
        read_nis(path)


def test_the_command_line(capsys):
    """False-alarm rate 1e-5 of each of three verdicts."""
    y = 0.3 * np.random.default_rng().normal(size=300)
    t = 0.1 * np.arange(300)
    write("innovations.csv", "t,innovation,innovation_variance", t, y, np.full(300, 0.09))
    write("NIS.csv", "t,NIS", t, y**2 / 0.09)
    write("own.csv", "t,chi,m", t, y**2 / 0.09, np.ones(300))
    rows = []
    for name, words, options in (
        ("innovations.csv", (), {}),
        ("NIS.csv", ("--dof", "1"), {"dof": 1}),
        ("own.csv", ("--columns", "nis=chi,nis_dof=m"), {"columns": {"nis": "chi", "nis_dof": "m"}}),
    ):
        rows.append(consistency(capsys, "monitor", name, *OPTIMAL, *words)[0].split("\n")[1].split()[1:])
        record = cs.read(name, **options)  # type: ignore[arg-type]
        assert_allclose(record.innovations.nis[0], y**2 / 0.09, rtol=1e-9)
        assert cs.judge(record, optimal_gain=True, false_alarm=1e-5).status in ("consistent", "undecided")
    assert rows[0] == rows[1] == rows[2]
    assert rows[0][:3] == ["300", "300", f"{np.mean(y**2 / 0.09):.3f}"]


@pytest.mark.parametrize(
    "words, said",
    [
        (("NIS.csv",), "NIS.csv: column 'nis_dof' is missing beside 'NIS'; .*--dof N"),
        (("NIS.csv", "--dof", "0"), "--dof 0: must be a whole number from 1"),
        (("both.csv", "--dof", "1"), "--dof 1: both.csv has a column 'nis_dof'"),
        (("v.csv", "--dof", "1"), "--dof 1: v.csv has innovations"),
        (("zero.csv",), "zero.csv, line 2: the variance of an innovation is not positive"),
        (("S.csv",), "S.csv, line 2: the innovation covariance is not positive definite"),
        (("a.npz", "--dof", "1"), "--dof: goes with tables, not with a.npz"),
        (("both.csv", "--skip", "3"), "--skip 3: nothing of both is left, which has 3 steps"),
        (("both.csv", "--skip", "x"), "--skip x: must be"),
        (("both.csv", "--skip", "2s"), "--skip 2s: there are no times"),
    ],
)
def test_what_is_refused(words, said, capsys):
    ones = np.ones(3)
    write("NIS.csv", "NIS", ones)
    write("both.csv", "nis,nis_dof", ones, ones)
    write("v.csv", "innovation,innovation_variance", ones, ones)
    write("zero.csv", "innovation,innovation_variance", ones, 0 * ones)
    write("S.csv", "innovation_0,innovation_1,S_0_0,S_0_1,S_1_1", ones, ones, ones, 2 * ones, ones)
    np.savez("a.npz", nis=ones, nis_dof=ones)
    assert re.search(said, refused(capsys, "monitor", *words, *OPTIMAL))


def test_the_first_steps_are_left_out_and_the_others_keep_their_numbers(capsys):
    nis = np.r_[np.full(20, 50.0), np.ones(100), np.full(80, 9.0)]
    write("a.csv", "step,t,nis,nis_dof", np.arange(11, 211), 0.5 * np.arange(200), nis, np.ones(200))
    for skip in ("20", "10s"):
        data = json.loads(consistency(capsys, "monitor", "a.csv", *OPTIMAL, "--skip", skip, "--json")[0])
        assert (data["alarm"]["since"], data["alarm"]["since_t"]) == (131, 60.0)
    whole = json.loads(consistency(capsys, "monitor", "a.csv", *OPTIMAL, "--json")[0])
    assert whole["alarm"]["since"] == 11
    log = read_nis(Path("a.csv"))
    assert skip_first(log, None) is log


@pytest.mark.parametrize(
    "header, row, words",
    [
        ("t,innovation,innovation_variance", "{t},{v},0.09", ()),
        ("t,NIS", "{t},{nis}", ("--dof", "1")),
        ("t,y,S", "{t},{v},0.09", ("--columns", "innovation=y,innovation_variance=S")),
    ],
)
def test_lines_as_they_come(header, row, words, monkeypatch, capsys):
    v = np.r_[np.full(50, 0.3), np.full(50, 3.0)]
    lines = [row.format(t=k, v=x, nis=x**2 / 0.09) for k, x in enumerate(v)]
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n".join([header, *lines]) + "\n"))
    data = json.loads(consistency(capsys, "monitor", "-", *OPTIMAL, "--json", *words)[0])
    assert data["alarm"]["since"] == 51


def test_innovations_beside_a_state_are_reported_with_it():
    """A NIS without degrees of freedom under another name is not looked at where there is a truth."""
    ones = np.ones(4)
    steps = np.arange(1, 5)
    write("truth.csv", "step,a", steps, steps)
    write("est.csv", "step,a,P_a_a,innovation,innovation_variance", steps, steps + 0.1, ones, 2.0 * ones, ones)
    record = cs.read("est.csv", truth="truth.csv", state=["a"])
    assert_allclose(record.innovations.nis, 4.0)
    write("est.csv", "step,a,P_a_a,NIS,nees,dof", steps, steps + 0.1, ones, ones, ones, 3 * ones)
    assert cs.read("est.csv", truth="truth.csv", state=["a"]).innovations.nis is None
