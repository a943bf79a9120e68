"""Files with names and axes of the user's own: each is read as a file with those of docs/files.md."""

import re
from pathlib import Path

import numpy as np
import pytest
from command import consistency
from numpy.testing import assert_allclose
from recorded import notes_of
from scipy.spatial.transform import Rotation

import consistency as cs
from consistency.referee.readers.formats.columns import renamed
from consistency.referee.readers.formats.file_kinds import head_of
from consistency.referee.readers.formats.sheet import sheet_of
from consistency.referee.readers.places import one_of_each_kind

pytestmark = pytest.mark.usefixtures("without_hints")
STEPS = 6
NED, FRD = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), np.diag([1.0, -1.0, -1.0])  # to ENU, to FLU
CONVENTIONS = ["so3", "so3-body", "left", "right"]
POSE = ["t", "x", "y", "z", "qx", "qy", "qz", "qw"]
MOVING = ["vx", "vy", "vz", "bgx", "bgy", "bgz", "bax", "bay", "baz"]


def table(path, names, *columns):
    rows = np.column_stack(columns)
    text = "\n".join(",".join(map(repr, map(float, row))) for row in rows)
    path.parent.mkdir(exist_ok=True)
    path.write_text(f"{','.join(names)}\n{text}\n")
    return path


def states(k):
    """Estimates and truth t, x, y, z, a quaternion and k numbers more, (STEPS, 8 + k), and covariances."""
    rng = np.random.default_rng()
    n = 6 + k
    root = rng.normal(size=(STEPS, n, n))
    t = np.arange(STEPS, dtype=float)[:, None]
    own = np.hstack([t, rng.normal(size=(STEPS, 3)), Rotation.random(STEPS).as_quat(), rng.normal(size=(STEPS, k))])
    true = own + 0.1 * rng.normal(size=own.shape) * (np.arange(8 + k) > 0)
    true[:, 4:8] = (Rotation.from_quat(own[:, 4:8]) * Rotation.from_rotvec(rng.normal(size=(STEPS, 3)))).as_quat()
    return own, true, root @ np.swapaxes(root, 1, 2) + np.eye(n)


def turned(state, world=NED, body=FRD):
    """A state of enu and flu in axes whose matrices are ``world`` and ``body``."""
    out = state.copy()
    out[:, 1:4] = state[:, 1:4] @ world
    R = Rotation.from_matrix(world.T) * Rotation.from_quat(state[:, 4:8]) * Rotation.from_matrix(body)
    out[:, 4:8] = R.as_quat()
    for first, axes in ((8, world), (11, body), (14, body)):
        if first < state.shape[1]:
            out[:, first : first + 3] = state[:, first : first + 3] @ axes
    return out


def carried(P, convention, world=NED, body=FRD):
    """Covariances of the same errors in these axes."""
    position, rotation = {"left": (body, body), "so3-body": (world, body)}.get(convention, (world, world))
    velocity = body if convention == "left" else world
    n = P.shape[-1]
    T = np.zeros((15, 15))
    for i, axes in enumerate((position, rotation, velocity, body, body)):
        T[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = axes.T
    return np.asarray(T[:n, :n] @ P @ T[:n, :n].T)


def with_covariance(path, own, P):
    n = P.shape[-1]
    names = [*POSE, *MOVING[: own.shape[1] - 8], *(f"P_{i}_{j}" for i in range(n) for j in range(n))]
    return table(path, names, own, P.reshape(len(P), -1))


@pytest.mark.parametrize("k", [0, 9])
@pytest.mark.parametrize("convention", CONVENTIONS)
def test_the_nees_is_that_in_other_axes(convention, k, tmp_path):
    own, true, P = states(k)
    names = [*POSE, *MOVING[:k]]
    enu, ned = table(tmp_path / "enu.csv", names, true), table(tmp_path / "ned.csv", names, turned(true))
    plain = with_covariance(tmp_path / "own.csv", own, P)
    down = with_covariance(tmp_path / "down.csv", turned(own), carried(P, convention))
    expected = cs.read(plain, enu, error=convention).errors.nees
    assert np.isfinite(expected).all()
    axes = {"world": "ned", "body_axes": "frd"}
    of_truth = {f"truth_{name}": value for name, value in axes.items()}
    found = [
        cs.read(down, enu, error=convention, **axes),
        cs.read(plain, ned, error=convention, **of_truth),
        cs.read(down, ned, error=convention, **axes, **of_truth),
        cs.read(down, ned, error=convention),
    ]
    for record in found:
        assert_allclose(record.errors.nees, expected, rtol=1e-6)
    assert np.abs(cs.read(down, enu, error=convention).errors.nees / expected - 1.0).max() > 0.01
    assert "the truth, in enu and flu, is read in the axes of the estimates, ned and frd" in notes_of(found[0])


def test_the_additive_error_is_taken_in_the_axes_of_the_estimates(tmp_path):
    own, true, P = states(3)
    names = [*POSE, *MOVING[:3]]
    down = with_covariance(tmp_path / "down.csv", turned(own), P)
    enu, ned = table(tmp_path / "enu.csv", names, true), table(tmp_path / "ned.csv", names, turned(true))
    record = cs.read(down, enu, error="additive", world="ned", body_axes="frd")
    assert_allclose(record.errors.nees, cs.read(down, ned, error="additive").errors.nees, rtol=1e-6)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_the_covariance_of_the_truth_is_turned_with_it(convention, tmp_path):
    own, true, P = states(0)
    rng = np.random.default_rng()
    root = rng.normal(size=(STEPS, 6, 6))
    of_truth = root @ np.swapaxes(root, 1, 2)
    plain = with_covariance(tmp_path / "own.csv", own, P)
    enu = with_covariance(tmp_path / "enu.csv", true, of_truth)
    ned = with_covariance(tmp_path / "ned.csv", turned(true), carried(of_truth, convention))
    given = {"error": convention, "truth_covariance": "columns", "truth_errors": "independent"}
    expected = cs.read(plain, enu, **given)
    record = cs.read(plain, ned, **given, truth_world="ned", truth_body_axes="frd")
    assert_allclose(record.truth.covariance, expected.truth.covariance, rtol=1e-6, atol=1e-9)


PLANE = ["t", "x", "y", "heading", "P_xx", "P_xy", "P_xh", "P_yy", "P_yh", "P_hh"]


@pytest.mark.parametrize("convention", ["so2", "left", "right"])
def test_poses_in_the_plane(convention, tmp_path):
    rng = np.random.default_rng()
    t, own = np.arange(STEPS, dtype=float), rng.normal(size=(STEPS, 3))
    true = own + 0.3 * rng.normal(size=(STEPS, 3))
    root = rng.normal(size=(STEPS, 3, 3))
    P = root @ np.swapaxes(root, 1, 2)
    T = np.diag([1.0, -1.0, -1.0]) if convention == "left" else np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    i, j = np.triu_indices(3)

    def down(pose):
        return np.column_stack([pose[:, 1], pose[:, 0], 0.5 * np.pi - pose[:, 2]])

    plain = table(tmp_path / "own.csv", PLANE, t, own, P[:, i, j])
    ned = table(tmp_path / "down.csv", PLANE, t, down(own), (T @ P @ T)[:, i, j])
    truth, truth_down = (table(tmp_path / f"{k}.csv", PLANE[:4], t, v) for k, v in (("t", true), ("td", down(true))))
    expected = cs.read(plain, truth, error=convention).errors.nees
    assert_allclose(cs.read(ned, truth, error=convention, world="ned").errors.nees, expected, rtol=1e-6)
    assert_allclose(cs.read(plain, truth_down, error=convention, truth_world="ned").errors.nees, expected, rtol=1e-6)


def test_a_truth_of_positions(tmp_path):
    own, true, P = states(0)
    plain = with_covariance(tmp_path / "own.csv", own, P)
    down = with_covariance(tmp_path / "down.csv", turned(own), carried(P, "left"))
    points = table(tmp_path / "points.csv", POSE[:4], true[:, :4])
    expected = cs.read(plain, points, error="left", lever_arm=[0.5, 0.2, -0.1])
    record = cs.read(down, points, error="left", lever_arm=[0.5, -0.2, 0.1], world="ned", body_axes="frd")
    assert_allclose(record.errors.nees, expected.errors.nees, rtol=1e-6)


@pytest.mark.parametrize(
    "options, why",
    [
        ({"world": "neu"}, r"world=neu: is not right-handed"),
        ({"truth_world": "ne"}, r"truth_world=ne: must be three letters of e, w, n, s, u, d"),
        ({"body_axes": "ned"}, r"body_axes=ned: must be three letters of f, b, l, r, u, d"),
        ({"truth_body_axes": "flf"}, r"truth_body_axes=flf: is not right-handed"),
    ],
)
def test_axes_that_are_none_are_refused(options, why, tmp_path):
    own, true, P = states(0)
    plain, truth = with_covariance(tmp_path / "own.csv", own, P), table(tmp_path / "truth.csv", POSE, true)
    with pytest.raises(cs.InputError, match=why):
        cs.read(plain, truth, **options)  # type: ignore[arg-type]


def test_axes_need_poses(tmp_path):
    t = np.arange(STEPS, dtype=float)
    own = table(tmp_path / "own.csv", ["t", "a", "P_a_a"], t, t, t + 1.0)
    truth = table(tmp_path / "truth.csv", ["t", "a"], t, t + 0.5)
    with pytest.raises(cs.InputError, match=r"world: needs poses or positions with a truth; .*own\.csv has none"):
        cs.read(own, truth, state=["a"], world="ned")
    np.savez(tmp_path / "a.npz", errors=np.ones((2, 3, 1)), covariances=np.ones((2, 3, 1, 1)))
    with pytest.raises(cs.InputError, match=r"world: does not go with .*a\.npz"):
        cs.read(tmp_path / "a.npz", world="ned")
    rows = table(tmp_path / "plane.csv", PLANE, t, np.ones((STEPS, 3)), np.ones((STEPS, 1)) * [1, 0, 0, 1, 0, 1])
    with pytest.raises(cs.InputError, match=r"both up or both down; the estimates are in ned and flu, the"):
        cs.read(rows, rows, world="ned", body_axes="flu")


# --- names -------------------------------------------------------------------------------------------


OWN_POSE = ["time_us", "pos_n", "pos_e", "pos_d", "att_1", "att_2", "att_3", "att_0", "vel_n", "vel_e", "vel_d"]
NAMES = "x=pos_n,y=pos_e,z=pos_d,qx=att_1,qy=att_2,qz=att_3,qw=att_0,vx=vel_n,vy=vel_e,vz=vel_d,P*=C*"
TRUE_NAMES = NAMES.rpartition(",")[0]


def test_columns_by_names_of_the_users_own(tmp_path, capsys):
    own, true, P = states(3)
    plain, truth = with_covariance(tmp_path / "own.csv", own, P), table(tmp_path / "t.csv", [*POSE, *MOVING[:3]], true)
    entries = [f"C{i}_{j}" for i in range(9) for j in range(9)]
    for pose in (own, true):
        pose[:, 0] *= 1e6
    mine = table(tmp_path / "mine.csv", [*OWN_POSE, "mode", *entries], own, own[:, 0], P.reshape(STEPS, -1))
    other = table(tmp_path / "other.csv", OWN_POSE, true)
    expected = cs.read(plain, truth, error="so3")
    columns = dict(pair.split("=") for pair in f"t=time_us,{NAMES}".split(","))
    of_truth = dict(pair.split("=") for pair in f"t=time_us,{TRUE_NAMES}".split(","))
    record = cs.read(mine, other, error="so3", columns=columns, truth_columns=of_truth)
    assert_allclose(record.errors.nees, expected.errors.nees, rtol=1e-9)
    assert_allclose(record.runs.t, expected.runs.t)
    shown, _ = consistency(
        capsys, "analyse", mine, "--truth", other, "--error", "so3", "--columns", f"t=time_us,{NAMES}",
        "--truth-columns", f"t=time_us,{TRUE_NAMES}", "--json",
    )  # fmt: skip
    assert '"convention": "so3"' in shown


def test_a_folder_of_tables_is_read_as_runs(tmp_path):
    rng = np.random.default_rng()
    t = np.arange(STEPS, dtype=float)
    names = ["when", "east", "north", "psi", *PLANE[4:]]
    stated = np.ones((STEPS, 1)) * [1.0, 0.0, 0.0, 1.0, 0.0, 1.0]
    columns = {"t": "when", "x": "east", "y": "north"}
    for run in range(3):
        table(tmp_path / "est" / f"{run}.csv", names, t, rng.normal(size=(STEPS, 3)), stated)
        table(tmp_path / "truth" / f"{run}.csv", PLANE[:4], t, rng.normal(size=(STEPS, 3)))
    record = cs.read(tmp_path / "est", tmp_path / "truth", columns=columns)
    assert (record.name, record.runs.numbers.tolist()) == ("est", [0, 1, 2])
    for run in range(3):
        one = cs.read(tmp_path / "est" / f"{run}.csv", tmp_path / "truth" / f"{run}.csv", columns=columns)
        assert_allclose(record.errors.nees[run], one.errors.nees[0], rtol=1e-12)  # type: ignore[index]
    (tmp_path / "truth" / "2.csv").unlink()
    with pytest.raises(cs.InputError, match=r"truth=.*truth: holds no table '2' for .*2\.csv"):
        cs.read(tmp_path / "est", tmp_path / "truth", columns=columns)


def test_a_folder_of_poses_with_own_names(tmp_path):
    names = {"x": "pn", "y": "pe", "z": "pd"}
    for run in range(2):
        own, true, P = states(0)
        entries = [f"P_{i}_{j}" for i in range(6) for j in range(6)]
        mine = ["t", "pn", "pe", "pd", *POSE[4:], *entries]
        table(tmp_path / "est" / f"{run}.csv", mine, own, P.reshape(STEPS, -1))
        table(tmp_path / "truth" / f"{run}.csv", POSE, true)
    record = cs.read(tmp_path / "est", tmp_path / "truth", columns=names)
    assert record.errors.nees is not None
    assert record.errors.nees.shape == (2, STEPS)
    for missing, word in (("x", "pn"), ("t", "clock")):  # of the truth: a file with names is not read as one without
        own = table(
            tmp_path / f"{word}.csv", [word if name == missing else name for name in [*POSE, "vn"]], true, P[:, 0, 0]
        )
        with pytest.raises(
            cs.InputError, match=rf"{word}\.csv: column '{missing}' is missing; there are: .*, vn; columns="
        ):
            cs.read(tmp_path / "est" / "0.csv", own, columns=names)


@pytest.mark.parametrize("suffix", ["csv", "txt"])
def test_one_column_states_two_deviations(tmp_path, suffix):
    """As the accuracy eph of vehicle_local_position, which is of x and of y."""
    rng = np.random.default_rng()
    t, sigma = 1e6 + 20_000.0 * np.arange(50), rng.uniform(0.1, 0.3, 50)
    true = rng.normal(size=(50, 2))
    own = true - sigma[:, None] * rng.normal(size=(50, 2))
    mark = "," if suffix == "csv" else " "
    for name, place in (("est", own), ("true", true)):
        rows = np.column_stack([t, place, sigma])
        names = mark.join(("timestamp_us", "x", "y", "eph"))
        np.savetxt(tmp_path / f"{name}.{suffix}", rows, delimiter=mark, header=names, comments="# " * (suffix == "txt"))
    given = {"sigma_x": "eph", "sigma_y": "eph"}
    files = tmp_path / f"est.{suffix}", tmp_path / f"true.{suffix}"
    if suffix == "txt":
        sheet = sheet_of(head_of(files[0], given))
        assert_allclose(sheet.data["sigma_x"], sigma)
        assert_allclose(sheet.data["sigma_y"], sigma)
        assert set(sheet.data) == {"timestamp_us", "x", "y", "sigma_x", "sigma_y"}
        return
    record = cs.read(*files, state=["x", "y"], columns=given)
    assert_allclose(record.errors.covariance[0], sigma[:, None, None] ** 2 * np.eye(2), rtol=1e-6)
    assert_allclose(record.errors.error[0], true - own, atol=1e-9)


@pytest.mark.parametrize(
    "names, columns, expected",
    [
        (["a", "b"], {"x": "a"}, ["x", "b"]),
        (["a", "x"], {"x": "a"}, ["x", "x not used"]),
        (["pn", "p_x", "pose.position.x"], {"x": "pn"}, ["x", "p_x not used", "pose.position.x not used"]),
        (["boot_us", "timestamp"], {"t": "boot_us"}, ["t_us", "timestamp not used"]),
        (["boot [ms]", "b"], {"t": "boot"}, ["t_ms", "b"]),
        (["boot_us"], {"t_ms": "boot_us"}, ["t_ms"]),
        (["c_0", "c_1", "c"], {"cov_*": "c_*"}, ["cov_0", "cov_1", "c"]),
        (["Pos N"], {"x": "pos_n"}, ["x"]),
        (["eph", "x"], {"sigma_x": "eph", "sigma_y": "eph"}, ["sigma_x", "x", "sigma_y"]),
        (["c_x", "b"], {"P_*": "c_*", "x": "b", "s_*": "c_*"}, ["P_x", "x", "s_x"]),
        (["e"], {"a": "e", "b": "e", "c": "e"}, ["a", "b", "c"]),
    ],
)
def test_names_in_place_of_others(names, columns, expected):
    assert [each.name for each in renamed(names, columns, Path("a.csv"))] == expected


@pytest.mark.parametrize(
    "columns, why",
    [
        ("x", r"'x': columns are named as x=pos_n"),
        ("x=a,x=b", r"column 'x' is named twice"),
        ("x=north", r"own\.csv: has no column 'north', which is to be read as 'x'; there are: t, x, y, z"),
        ("x*=P_0_0", r"'x\*=P_0_0': a \* stands in both names or in none"),
        ("x_0=t,x_*=P_0_*", r"own\.csv: two columns are named 'x_0'"),
    ],
)
def test_names_that_cannot_be_used_are_refused(columns, why, tmp_path, capsys):
    own, true, P = states(0)
    plain, truth = with_covariance(tmp_path / "own.csv", own, P), table(tmp_path / "t.csv", POSE, true)
    _, said = consistency(capsys, "analyse", plain, "--truth", truth, "--columns", columns, status=2)
    assert re.search(why, said)


def test_refusals_name_the_option(tmp_path):
    t = np.arange(STEPS, dtype=float)
    own = table(tmp_path / "own.csv", ["clock", "pos_n", "pos_e"], t, t, t)
    with pytest.raises(cs.InputError, match=r"columns=t=NAME says what it is called, in a truth truth_columns="):
        cs.read(own, own)
    with pytest.raises(cs.InputError, match=r"column 'x' is missing; .*; columns=x=NAME says what it is called"):
        cs.read(own, own, columns={"t": "clock"}, truth_columns={"t": "clock"})


def test_notes_of_like_files_are_one():
    notes = ["a/0.csv: read so", "b/0.csv: read otherwise", "a/1.csv: read so", "a/2.csv: read so", "", "whole"]
    assert one_of_each_kind(notes) == ("a/0.csv and 2 others: read so", "b/0.csv: read otherwise", "whole")
    assert one_of_each_kind(["a: so", "b: so", "c"]) == ("a: so", "b: so", "c")
