"""Ways into a table: dates, rows paired by a name, the state from its covariance; and arrays of other programs."""

import re
import sys

import numpy as np
import pytest
from command import consistency
from numpy.testing import assert_allclose
from recorded import notes_of

import consistency as cs
from consistency.referee.readers.formats.sheet import seconds_of_date
from consistency.referee.readers.formats.table_columns import stated_state

P = np.array([[0.04, 0.01], [0.01, 0.09]])


pytestmark = pytest.mark.usefixtures("inside")


def save(name, text):
    with open(name, "w") as file:
        file.write(text)
    return name


# --- dates -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text, seconds",
    [
        ("2024-05-01T12:00:00Z", 1714564800.0),
        ("2024-05-01 14:00:00.25+02:00", 1714564800.25),
        ("2024-05-01T06:30:00,5-0530", 1714564800.5),
        ("2024-05-01T12:00", 1714564800.0),
        ("1969-12-31 23:59:59 UTC", -1.0),
    ],
)
def test_seconds_of_a_date(text, seconds):
    assert seconds_of_date(text) == pytest.approx(seconds, abs=1e-6)


@pytest.mark.parametrize("text", ["2024-05-01", "12:00:00", "2024-13-01T12:00:00", "1.5", "2024-05-01T12:00:00X", None])
def test_what_is_not_a_date_with_a_time(text):
    assert np.isnan(seconds_of_date(text))


@pytest.mark.parametrize("name", ["t", "timestamp", "Time"])
def test_a_table_whose_times_are_dates(name):
    """Estimates in one zone and the truth in another, a quarter of a second apart in steps."""
    est = [f"{name},a,P_a_a"]
    true = [f"{name},a"]
    for k in range(6):
        at = f"{k // 4:02d}.{25 * (k % 4):02d}"
        est.append(f"2024-05-01T12:00:{at}Z,{k + 0.5},0.25")
        true.append(f"2024-05-01 14:00:{at}+02:00,{k}")
    record = cs.read(save("est.csv", "\n".join(est)), truth=save("truth.csv", "\n".join(true)), state=["a"])
    assert_allclose(record.errors.error[0, :, 0], -0.5)
    assert_allclose(np.diff(record.runs.t), 0.25, atol=1e-6)


def test_a_pose_in_space_and_a_frame_with_dates():
    pd = pytest.importorskip("pandas")
    own = ",".join(f"P_{a}_{b}" for a in "abc" for b in "abc" if a <= b).split(",")
    assert len(own) == 6
    rows = "time,x,y,z,qx,qy,qz,qw\n" + "".join(f"2024-05-01T12:00:0{k}Z,{k},0,0,0,0,0,1\n" for k in range(5))
    stated = ["time,x,y,z,qx,qy,qz,qw,sigma_x,sigma_y,sigma_z,sigma_roll,sigma_pitch,sigma_yaw"]
    stated += [f"2024-05-01T12:00:0{k}Z,{k + 0.1},0,0,0,0,0,1,1,1,1,1,1,1" for k in range(5)]
    record = cs.read(save("est.csv", "\n".join(stated)), truth=save("truth.csv", rows), time_offset=0.0)
    assert_allclose(record.errors.error[0, :, 0], -0.1)
    t = pd.date_range("2024-05-01", periods=4, freq="s", tz="UTC")
    frame = pd.DataFrame({"t": t, "a": [1.0, 2.0, 3.0, 4.0], "P_a_a": 1.0})
    record = cs.read(frame, truth=frame[["t", "a"]], state=["a"])
    assert_allclose(record.errors.error, 0.0)


def test_a_date_in_another_column_stays_refused():
    save("truth.csv", "t,a\n0,1\n")
    save("est.csv", "t,a,P_a_a\n0,2024-05-01T12:00:00Z,1\n")
    with pytest.raises(cs.InputError, match=r"est\.csv, line 2: column 'a': not a number"):
        cs.read("est.csv", truth="truth.csv", state=["a"])


# --- rows paired by a name ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["image", "file name", "sample_id"])
def test_rows_are_paired_by_a_name(name):
    est = save("est.csv", f"{name},a,b,P_a_a,P_a_b,P_b_b\nq.png,2.1,0,1,0,1\np.png,1.2,0,4,0,1\nr.png,3.3,0,1,0,1\n")
    truth = save("truth.csv", f"{name},a,b\np.png,1,0\nq.png,2,0\nr.png,3,0\ns.png,9,9\n")
    record = cs.read(est, truth=truth, state=["a", "b"])
    assert record.errors.error.shape == (3, 1, 2)
    assert_allclose(record.errors.error[:, 0, 0], [-0.1, -0.2, -0.3])
    assert_allclose(record.errors.nees[:, 0], [0.01, 0.01, 0.09])
    assert f"rows are paired by '{name}', and each is a run" in notes_of(record)


def test_names_without_a_truth_are_left_out_and_named():
    est = save("est.csv", "image,a,P_a_a\np.png,1.5,1\nx.png,2,1\nq.png,2.5,1\n")
    record = cs.read(est, truth=save("truth.csv", "image,a\nq.png,2\np.png,1\n"), state=["a"])
    assert_allclose(record.errors.error[:, 0, 0], [-0.5, -0.5])
    assert "1 have no truth and are left out (x.png)" in notes_of(record)
    with pytest.raises(cs.InputError, match=r"truth\.csv: no 'image' of est\.csv is in it, whose first is 'p\.png'"):
        cs.read(est, truth=save("truth.csv", "image,a\nu.png,2\n"), state=["a"])


def test_names_beside_the_truth_in_one_table_and_for_each_filter():
    rows = ["image,filter,a,true_a,P_a_a"]
    rows += [f"{image}.png,{kind},{1 + shift},1,1" for kind, shift in (("f", 0.5), ("g", 0.25)) for image in "pqr"]
    path = save("one.csv", "\n".join(rows))
    for kind, shift in (("f", 0.5), ("g", 0.25)):
        record = cs.read(path, state=["a"], filter=kind)
        assert_allclose(record.errors.error[:, 0, 0], [-shift] * 3)


@pytest.mark.parametrize(
    "est, truth",
    [
        ("image,a,P_a_a\np,1,1\np,2,1\n", "image,a\np,1\n"),  # twice
        ("image,a,P_a_a\np,1,1\nq,2,1\n", "picture,a\np,1\nq,2\n"),  # another name
        ("number,a,P_a_a\n1,1,1\n2,2,1\n", "number,a\n1,1\n2,2\n"),  # numbers may be steps of a log
    ],
)
def test_what_pairs_no_rows(est, truth):
    with pytest.raises(cs.InputError, match=r"est\.csv: column 'step' or 't' is missing"):
        cs.read(save("est.csv", est), truth=save("truth.csv", truth), state=["a"])


# --- the state from its covariance, and the truth's own covariance -------------------------------------


@pytest.mark.parametrize(
    "names, state",
    [
        ("step,px,vx,P_px_px,P_px_vx,P_vx_vx", ["px", "vx"]),
        ("t,north,east,down,P_north_north,P_east_east,P_down_down", ["north", "east", "down"]),
        ("step,soc,P_soc_soc", ["soc"]),
        ("step,a_est,b_est,P_a_a,P_a_b,P_b_b", ["a", "b"]),
        ("step,x,y,heading,P_x_x,P_y_y,P_heading_heading", []),  # a pose
        ("step,x,y,heading,vx,P_x_x,P_vx_vx", []),
        ("t,x,y,z,qx,qy,qz,qw,P_x_x,P_y_y,P_z_z", []),  # a quaternion
        ("step,a,P_a_a,P_b_b", []),  # b is no column
        ("step,a,b,P_a_a,P_b_b,P_a_c", []),
        ("step,a,b", []),
    ],
)
def test_the_state_that_a_covariance_names(names, state):
    assert stated_state(names.split(",")) == state


def test_a_table_without_a_declared_state():
    save("est.csv", "step,px,vx,P_px_px,P_px_vx,P_vx_vx\n" + "".join(f"{k},{k}.1,0.2,.04,.01,.09\n" for k in (1, 2, 3)))
    save("truth.csv", "step,px,vx\n" + "".join(f"{k},{k},0\n" for k in (1, 2, 3)))
    record = cs.read("est.csv", truth="truth.csv")
    assert record.errors.axes == ("px", "vx")
    e = np.array([0.1, 0.2])
    assert_allclose(record.errors.nees, e @ np.linalg.inv(P) @ e)
    assert any("the state is px,vx" in note and "--state" in note for note in record.origin.notes)
    assert cs.read("est.csv", truth="truth.csv", state=["px"]).errors.axes == ("px",)


@pytest.mark.parametrize(
    "header, row, noted",
    [
        ("step,a,b,P_a_a,P_a_b,P_b_b", "{k},0,0,.01,0,.01", True),
        ("step,a,b,sigma_a,sigma_b", "{k},0,0,.1,.1", True),
        ("step,a,b,var_a,var_b", "{k},0,0,.1,.1", True),
        ("step,a,b,P_a_a,P_a_b,P_b_b", "{k},0,0,0,0,0", False),
        ("step,a,b", "{k},0,0", False),
    ],
)
def test_a_covariance_of_the_truth_that_is_not_used_is_named(header, row, noted):
    save("est.csv", "step,a,b,P_a_a,P_a_b,P_b_b\n" + "".join(f"{k},.1,.2,.04,.01,.09\n" for k in (1, 2, 3)))
    save("truth.csv", "\n".join([header, *(row.format(k=k) for k in (1, 2, 3))]))
    record = cs.read("est.csv", truth="truth.csv", state=["a", "b"])
    said = [note for note in record.origin.notes if "truth.csv: the truth states a covariance of its own" in note]
    assert bool(said) is noted
    assert all("--truth-covariance columns" in note for note in said)
    if noted and "P_a_b" in header:
        used = cs.read("est.csv", truth="truth.csv", state=["a", "b"], truth_covariance="columns")
        assert "counts as 0" not in notes_of(used)


# --- the truth in the folder of a run --------------------------------------------------------------------

PROGRAM = """
import sys
k = int(sys.argv[1]) % 7
open("estimates.csv", "w").write("{header}\\n" + "".join(f"{{i}},{{i + .1 * k}}{rest}\\n" for i in (1, 2, 3)))
open("truth.csv", "w").write("step,a\\n1,1\\n2,2\\n3,3\\n")
"""


@pytest.mark.parametrize(
    "header, rest, noted",
    [
        ("step,a,P_a_a", ",1", True),
        ("step,a_est,P_a_a", ",1", True),
        ("step,a,sigma_a", ",1", True),
        ("step,a,true_a,P_a_a", ",0,1", False),  # whose own truth is another
    ],
)
def test_the_truth_in_the_folder_of_a_run(header, rest, noted, capsys):
    save("program.py", PROGRAM.format(header=header, rest=rest))
    options = ("monte-carlo", "--runs", "3", "--jobs", "1", "--out", "out", "--state", "a")
    _, err = consistency(capsys, *options, "--", sys.executable, "{here}/program.py", "{seed}")
    taken = "truth.csv: taken as the truth of the run, as no column of estimates.csv is one; see --truth"
    assert (taken in err) is noted
    record = cs.read("out")
    assert record.errors.error.shape == (3, 3, 1)
    assert (np.abs(record.errors.error) < 0.7).all() is np.bool_(noted)


# --- arrays of other programs ----------------------------------------------------------------------------

E = np.random.default_rng(5).normal(size=(30, 20, 3))
C = np.broadcast_to(np.eye(3), (30, 20, 3, 3))


@pytest.mark.parametrize(
    "errors, covariances, said",
    [
        (E[..., None], C, r"take errors\[\.\.\., 0\]"),
        (E[0][..., None], C[0], r"take errors\[\.\.\., 0\]"),
        (np.moveaxis(E, -1, 0), np.moveaxis(C, (-2, -1), (0, 1)), r"np\.moveaxis\(errors, 0, -1\)"),
        (E.T, C.T, r"np\.moveaxis\(covariances, \(0, 1\), \(-2, -1\)\)"),
        (E[0].T, np.moveaxis(C[0], 0, -1), r"np\.moveaxis\(errors, 0, -1\)"),
        (E, C.reshape(30, 20, 9), r"covariances\.reshape\(\(30, 20, 3, 3\)\)"),
        (E, np.ones((30, 20, 3)), r"covariances\[\.\.\., None\] \* np\.eye\(3\), .*deviations="),
        (E, np.eye(3), r"np\.broadcast_to\(covariances, \(30, 20, 3, 3\)\)"),
        (E, C[0], r"np\.broadcast_to\(covariances, \(30, 20, 3, 3\)\)"),
    ],
)
def test_the_layout_of_another_program_is_named(errors, covariances, said, tmp_path):
    with pytest.raises(cs.InputError, match=said) as refusal:
        cs.judge(errors, covariances)
    assert "key '" not in str(refusal.value)
    np.savez("a.npz", errors=errors, covariances=covariances)
    with pytest.raises(cs.InputError, match=said.partition(", .*")[0]) as refusal:
        cs.read("a.npz")
    assert "deviations=" not in str(refusal.value)


def test_a_remedy_is_right():
    """What is said to do makes the arrays what they were."""
    e, P = np.moveaxis(E, -1, 0), np.moveaxis(C * np.arange(1.0, 4.0), (-2, -1), (0, 1))
    assert_allclose(np.moveaxis(e, 0, -1), E)
    assert_allclose(np.moveaxis(P, (0, 1), (-2, -1)), C * np.arange(1.0, 4.0))


@pytest.mark.parametrize(
    "call, said",
    [
        (lambda: cs.judge(E, deviations=np.where(np.arange(20)[:, None] == 3, np.nan, np.ones_like(E))),
         "^deviations, step 4: not finite"),
        (lambda: cs.judge(E, C, axes=["a"]), "^axes names 1 components"),
        (lambda: cs.judge(E, C, truth_covariances=C[0]), r"^truth_covariances has shape \(1, 20, 3, 3\)"),
    ],
)  # fmt: skip
def test_errors_of_python_name_its_arguments(call, said):
    with pytest.raises(cs.InputError, match=said):
        call()


def correlated(runs, steps, seed, rho=0.95):
    """Errors (runs, steps, 2) of independent runs, of unit variance, which correlate over steps."""
    rng = np.random.default_rng(seed)
    e = np.empty((runs, steps, 2))
    e[:, 0] = rng.normal(size=(runs, 2))
    for k in range(1, steps):
        e[:, k] = rho * e[:, k - 1] + np.sqrt(1.0 - rho**2) * rng.normal(size=(runs, 2))
    return e


@pytest.mark.parametrize("shape", [(60, 120), (40, 30), (20, 200)])
def test_swapped_runs_and_steps_are_named(shape):
    """Independent errors of neighbours correlate by 0.5 with a chance below 1e-6, and right arrays do not look so."""
    e = correlated(*shape, seed=shape[0])
    P = np.broadcast_to(np.eye(2), (*shape, 2, 2))
    hint = re.compile(r"one run to the next .* \(steps, runs, n\).*np\.swapaxes")
    v = cs.judge(np.swapaxes(e, 0, 1), np.swapaxes(P, 0, 1))
    assert any(hint.search(line) for line in v.reasons)
    np.savez("swapped.npz", errors=np.swapaxes(e, 0, 1), covariances=np.swapaxes(P, 0, 1))
    assert any(hint.search(note) for note in cs.read("swapped.npz").origin.causes)
    for right in (e, correlated(*shape, seed=1, rho=0.0), correlated(*shape, seed=2) + 3.0):
        assert not any(hint.search(line) for line in cs.judge(right, P).reasons)
    grown = e * np.sqrt(np.arange(1, shape[1] + 1))[:, None]  # a walk beside a common path
    assert not any(hint.search(line) for line in cs.judge(grown, P).reasons)
