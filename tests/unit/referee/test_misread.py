"""Inputs that are easily read as something else: judged as what is known, refused, or read with a note that says so."""

import re

import numpy as np
import pytest
from command import refused
from numpy.testing import assert_allclose, assert_array_equal
from recorded import notes_of
from scipy import stats
from scipy.spatial.transform import Rotation

import consistency as cs
from consistency.diagnostics import Settings, judge, make_record
from consistency.referee.diagnostics.whiteness import outliers_of
from consistency.referee.gating.checked_input import record_of_checked
from consistency.referee.readers.axes_and_units import require_radians
from consistency.referee.readers.formats.positions import placeholder
from consistency.referee.readers.places import Places
from consistency.referee.readers.runs_to_record import not_estimated
from consistency.referee.readers.truth_matching import AXES, REST, make_poses
from consistency.testing import assert_consistent

pytestmark = pytest.mark.usefixtures("without_hints")
SURE = 1e-6  # false-alarm rate of a verdict


# --- masks -----------------------------------------------------------------------------------------


def identities(n, *shape):
    return np.broadcast_to(np.eye(n), (*shape, n, n))


def partly(shape, run, step, *rest):
    mask = np.zeros(shape, bool)
    mask[(run, step, *rest)] = True
    return mask


@pytest.mark.parametrize("key", ["errors", "covariances"])
def test_a_step_that_is_masked_in_part_is_refused(key, rng):
    given = {"errors": rng.normal(size=(5, 8, 3)), "covariances": identities(3, 5, 8)}
    given[key] = np.ma.array(given[key], mask=partly(given[key].shape, 2, 6, 1))
    numbers = "1 of 3" if key == "errors" else "3 of 9"
    for call in (cs.judge, assert_consistent):
        with pytest.raises(ValueError, match=f"{key}, run 2, step 7: {numbers} numbers are masked; mask all"):
            call(given["errors"], given["covariances"])
    with pytest.raises(cs.InputError, match="errors, row 3: 1 of 3 numbers"):
        cs.judge(np.ma.array(np.ones((5, 3)), mask=partly((5, 3), 2, 1)), identities(3, 5), independent=True)


def test_a_masked_covariance_masks_its_step(rng):
    P = identities(2, 30, 4).copy()
    P[3, 1] = -1.0
    mask = np.zeros(P.shape, bool)
    mask[3, 1] = True
    error = np.ma.array(rng.normal(size=(30, 4, 2)), mask=partly((30, 4, 2), 5, 2))
    verdict = cs.judge(error, np.ma.array(P, mask=mask), false_alarm=SURE)
    assert verdict.status == "consistent"
    assert verdict.scale.alive.tolist() == [30, 29, 29, 30]


def test_masks_of_innovations(rng):
    v, S = rng.normal(size=(4, 9, 2)), identities(2, 4, 9)
    given = {"optimal_gain": True, "innovation_covariances": S}
    with pytest.raises(cs.InputError, match=r"innovations, run 1, step 6: 1 of 2 numbers are masked"):
        record_of_checked("f", innovations=np.ma.array(v, mask=partly(v.shape, 1, 5, 0)), **given)
    given["innovation_covariances"] = np.ma.array(S, mask=partly(S.shape, 1, 5))
    assert np.argwhere(record_of_checked("f", innovations=v, **given).innovations.nis_dof == 0).tolist() == [[1, 5]]
    given["innovation_covariances"] = np.ma.array(S, mask=partly(S.shape, 1, 5, 0))
    with pytest.raises(cs.InputError, match=r"innovation_covariances, run 1, step 6: 2 of 4"):
        record_of_checked("f", innovations=v, **given)


@pytest.mark.parametrize("key", ["nis", "nis_dof"])
def test_a_masked_nis_is_no_innovation(key, rng):
    given = {"nis": rng.chisquare(2, (3, 9)), "nis_dof": np.full((3, 9), 2)}
    given["nis"][1, 4] = 1e9
    given[key] = np.ma.array(given[key], mask=partly((3, 9), 1, 4))
    verdict = judge(record_of_checked("f", optimal_gain=True, **given))
    assert verdict.innovations.dof == 2 * 26
    assert verdict.innovations.ratio < 10.0


def test_a_masked_nis_is_nothing_to_the_monitor():
    monitor = cs.Monitor(gate=0.99)
    for nis in np.ma.array([1.0, 2.0, 3.0], mask=[False, True, False]):
        monitor.update(nis, 2)
    assert (monitor.steps, monitor.measurements, monitor.rejections) == (3, 2, 0)


def test_a_record_keeps_no_mask():
    with pytest.raises(cs.InputError, match=r"nees is a masked array.*nees.filled"):
        make_record("f", nees=np.ma.array(np.ones((3, 4)), mask=partly((3, 4), 1, 1)), dof=2)


# --- planar robots in 6 x 6 form ---------------------------------------------------------------------


def planar(at, dummies, suffix="txt"):
    """Honest robots in the plane of z = 1.5: 9 runs of 10 steps in space, with a covariance of 6 x 6."""
    rng = np.random.default_rng()
    L = np.array([[0.1, 0.0, 0.0], [0.03, 0.08, 0.0], [0.01, -0.02, 0.04]])
    P = np.diag([1.0, 1.0, *dummies, 1.0])
    P[np.ix_([0, 1, 5], [0, 1, 5])] = L @ L.T
    pose = ["t", "x", "y", "z", "qx", "qy", "qz", "qw"]
    for run in range(9):
        own, true = [], []
        for k in range(10):
            p = np.array([0.2 * k, np.sin(0.2 * k), 0.1 * k + run])
            e = L @ rng.normal(size=3)
            for rows, (x, y, h), rest in ((own, p - e, P.ravel()), (true, p, np.empty(0))):
                rows.append([k, x, y, 1.5, 0.0, 0.0, np.sin(h / 2), np.cos(h / 2), *rest])
        for name, rows in (("est", own), ("truth", true)):
            (at / name).mkdir(exist_ok=True)
            names = ",".join([*pose, *(f"cov_{i}" for i in range(len(rows[0]) - 8))])
            form = {"delimiter": ",", "header": names, "comments": ""} if suffix == "csv" else {}
            np.savetxt(at / name / f"{run:02d}.{suffix}", rows, **form)
    return at / "est", at / "truth"


@pytest.mark.parametrize("dummies, suffix", [
    ((1e6, 1e6, 1e6), "txt"), ((0.25, 1e-9, 99999.0), "csv"), ((1.7976931348623157e308,) * 3, "txt"),
])  # fmt: skip
def test_what_a_planar_robot_does_not_estimate_is_left_out(dummies, suffix, tmp_path):
    est, truth = planar(tmp_path, dummies, suffix)
    record = cs.read(est, truth=truth)
    verdict = cs.judge(record, false_alarm=SURE)
    assert (verdict.faults, verdict.failures, verdict.axes.names) == ((), (), ("x", "y", "yaw"))
    same = cs.read(est, truth=truth, axes=["x", "y", "yaw"])
    assert_array_equal(record.errors.covariance, same.errors.covariance)
    assert "z, roll, pitch are not estimated and left out" in notes_of(record)
    assert "left out" not in notes_of(same)
    asked = cs.read(est, truth=truth, axes=["x", "y", "z", "roll", "pitch", "yaw"])
    assert asked.errors.covariance.shape[-1] == 6


def moved(est, truth, change):
    """Planar files whose poses ``change`` moves: t, estimates (N, 7) and truth (N, 7) to both."""
    for path in est.iterdir():
        rows, true = np.loadtxt(path), np.loadtxt(truth / path.name)
        rows[:, 1:8], true[:, 1:8] = change(rows[:, 0], rows[:, 1:8], true[:, 1:8])
        np.savetxt(path, rows)
        np.savetxt(truth / path.name, true)


def tilted(poses, roll, pitch):
    turn = Rotation.from_quat(poses[:, 3:]) * Rotation.from_euler("xyz", np.column_stack([roll, pitch, 0.0 * roll]))
    return np.column_stack([poses[:, :3], turn.as_quat()])


UP = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
WAVE = 0.01 * np.sin(np.arange(10.0))
ONE = np.ones(10)
CONSTANT = {
    "height": lambda t, own, true: (own + 0.05 * UP, true),
    "tilt": lambda t, own, true: (own, tilted(true, 0.02 * ONE, -0.03 * ONE)),
    "both": lambda t, own, true: (tilted(own - 9.0 * UP, 3.0 * ONE, 0.0 * ONE), true),
    "rounded": lambda t, own, true: ((own + 0.05 * UP).astype(np.float32), true),
}


@pytest.mark.parametrize(
    "case, dummy", [("height", 1e-6), ("height", 0.0), ("tilt", 1e6), ("both", 1.0), ("rounded", 0.1)]
)
def test_what_never_changes_is_left_out_though_it_is_off(case, dummy, tmp_path):
    est, truth = planar(tmp_path, (dummy,) * 3)
    moved(est, truth, CONSTANT[case])
    record = cs.read(est, truth=truth)
    assert record.errors.axes == ("x", "y", "yaw")
    [note] = [note for note in record.origin.notes if "not estimated" in note]
    assert "z, roll, pitch are not estimated and left out, as by --axes x,y,yaw" in note
    assert_array_equal(record.errors.nees, cs.read(est, truth=truth, axes=["x", "y", "yaw"]).errors.nees)
    if dummy:
        assert cs.read(est, truth=truth, axes=["x", "z", "yaw"]).errors.axes == ("x", "z", "yaw")


@pytest.mark.parametrize(
    "convention, roll, axes", [("so3", 0.2, 3), ("right", 0.2, 4), ("left", 0.2, 4), ("left", 0.0, 3)]
)
def test_a_height_in_tilted_axes_is_not_left_out(convention, roll, axes, tmp_path):
    """Of two tilts that differ, errors of a group mix the axes."""
    est, truth = planar(tmp_path, (1e-6,) * 3)
    moved(est, truth, lambda t, own, true: (tilted(own, roll * ONE, 0.0 * ONE), true))
    record = cs.read(est, truth=truth, error=convention)
    assert len(record.errors.axes) == axes
    assert "not estimated and left out, as by" in notes_of(record)


MOVES = {  # and which components are still left out
    "a bias of a height that moves": (
        lambda t, own, true: (own + np.outer(WAVE + 0.05, UP), true + np.outer(WAVE, UP)),
        2,
    ),
    "a height of the truth alone": (lambda t, own, true: (own, true + np.outer(WAVE, UP)), 2),
    "a height of the estimates alone": (lambda t, own, true: (own + np.outer(WAVE, UP), true), 2),
    "a roll of the truth": (lambda t, own, true: (own, tilted(true, WAVE, 0.0 * ONE)), 1),
    "a pitch of the estimates": (lambda t, own, true: (tilted(own, 0.0 * ONE, WAVE), true), 1),
}


@pytest.mark.parametrize("case", MOVES)
def test_what_moves_in_one_of_both_is_judged(case, tmp_path):
    est, truth = planar(tmp_path, (1.0, 1.0, 1.0))
    change, left = MOVES[case]
    moved(est, truth, change)
    record = cs.read(est, truth=truth)
    assert len(record.errors.axes) == 6 - left
    named = [note for note in record.origin.notes if "never change in the estimates" in note]
    assert bool(named) == ("of the truth" in case)
    assert all("--axes x,y" in note for note in named)


def test_a_variance_that_changes_is_of_an_estimate(tmp_path):
    est, truth = planar(tmp_path, (1.0, 1.0, 1.0))
    for path in est.iterdir():
        rows = np.loadtxt(path)
        rows[:, 8 + 14] = np.linspace(1.0, 1.1, len(rows))
        rows[:, 3] += 0.5
        np.savetxt(path, rows)
    record = cs.read(est, truth=truth)
    assert record.errors.axes == ("x", "y", "z", "yaw")
    assert any(
        "z never change in the estimates" in note and "add --axes x,y,yaw" in note for note in record.origin.notes
    )


def test_a_robot_that_stands_still_shows_nothing(tmp_path):
    """Every component of repeated fixes of one place never changes, and each has an error."""
    est, truth = planar(tmp_path, (1.0, 1.0, 1.0))
    moved(est, truth, lambda t, own, true: (own[:1] + 0.1 * UP, true[:1]))
    assert len(cs.read(est, truth=truth).errors.axes) > 3


def test_only_a_constant_that_is_never_wrong_is_left_out(rng):
    error, variance = rng.normal(size=(2, 6, 4)), np.ones((2, 6, 4))
    error[:, :, 1:3] = 0.0
    assert not_estimated([*error], [*variance]).tolist() == [False, True, True, False]
    variance[1, 3, 1], error[0, 0, 2] = 1.1, 1e-6
    assert not not_estimated([*error], [*variance]).any()
    assert not not_estimated([*(0.0 * error)], [*np.ones((2, 6, 4))]).any()  # a file beside itself


@pytest.mark.parametrize("variances", [(0, 0, 0, 0.0025), (1e6, 0, 0, 0.0025)])
def test_a_variance_of_0_of_what_never_changes_is_a_dummy(variances, tmp_path):
    est, truth = planar(tmp_path, (1, 1, 1))
    for path in est.iterdir():
        rows = np.loadtxt(path)
        rows[:, 8:] = np.diag([0.01, 0.01, *variances]).ravel()
        np.savetxt(path, rows)
    assert cs.read(est, truth=truth).errors.axes == ("x", "y", "yaw")


# --- headings in degrees -----------------------------------------------------------------------------

K, RUN = np.meshgrid(np.arange(30.0), np.arange(8.0))
SLALOM = 0.7 * np.sin(0.4 * K + RUN)


def headed(heading, course=None, sigma=0.03, other=None):
    """Planar runs with headings (runs, steps) along a course, rad; ``other`` are headings of the estimates."""
    rng = np.random.default_rng()
    course = 0.0 * heading if course is None else course
    way = np.cumsum(np.stack([np.cos(course), np.sin(course)], axis=-1), axis=1)
    place = np.concatenate([np.zeros((len(way), 1, 2)), way[:, :-1]], axis=1)
    own = heading + sigma * rng.normal(size=heading.shape) if other is None else other
    t, P = np.arange(float(heading.shape[1])), np.diag([1.0, 1.0, sigma**2])
    return [
        make_poses(
            Places(str, np.arange(len(t))), t, np.column_stack([p, g]), np.broadcast_to(P, (len(t), 3, 3)),
            np.ones(len(t), bool), t, np.column_stack([p, h]), "planar", "so2", 0.0,
        )
        for p, h, g in zip(place, heading, own, strict=True)
    ]  # fmt: skip


DEGREES = {
    "0 to 360": (lambda: headed((40 * RUN + 13 * K) % 360, sigma=2.0), "truth jump by a whole turn"),
    "-180 to 180": (lambda: headed((7 * K + 99 * RUN + 180) % 360 - 180, sigma=2.0), "truth jump by a whole turn"),
    "sparse": (lambda: headed(np.random.default_rng().uniform(0, 360, K.shape), sigma=2.0), "truth jump"),
    "a slalom": (lambda: headed(np.rad2deg(SLALOM), SLALOM, 2.0), "truth change by 57 times"),
    "backwards": (lambda: headed(np.rad2deg(SLALOM + np.pi), SLALOM, 2.0), "truth change by 57 times"),
    "unwrapped": (lambda: headed(5 * K + RUN, sigma=5.0), "truth lie beyond 2 pi"),
    "a turn apart": (lambda: headed(5 * K + RUN, sigma=5.0, other=5 * K + RUN + 363), "truth lie beyond 2 pi"),
    "estimates": (
        lambda: headed(SLALOM + RUN, None, 2.0, np.rad2deg(SLALOM + RUN + 3 * K) % 360), "estimates jump",
    ),
}  # fmt: skip
RADIANS = {
    "along the path": lambda: headed(SLALOM, SLALOM),
    "unwrapped": lambda: headed(0.3 * K + RUN, 0.3 * K + RUN),
    "unwrapped, spinning": lambda: headed(40 * K),
    "unwrapped, unknown": lambda: headed(0.3 * K + RUN, sigma=4.0, other=0.3 * K + RUN + 0.05),
    "standing": lambda: [p.some(1) for p in headed(SLALOM)],
    "random": lambda: headed(np.random.default_rng().uniform(-np.pi, np.pi, K.shape)),
}


@pytest.mark.parametrize("case", DEGREES)
def test_headings_in_degrees_are_refused(case):
    runs, said = DEGREES[case][0](), DEGREES[case][1]
    with pytest.raises(cs.InputError, match=f"^est.csv: the headings of the {said}.*multiply by pi / 180"):
        require_radians("est.csv", runs)


@pytest.mark.parametrize("case", RADIANS)
def test_headings_in_radians_are_not(case):
    require_radians("est.csv", RADIANS[case]())


def test_tables_and_archives_in_degrees(tmp_path, capsys):
    rows = (f"{k},{k},0,{40 * k % 360}" for k in range(30))
    (tmp_path / "truth.csv").write_text("\n".join(["step,x,y,heading", *rows]))
    row = "{},{},0,{},1,0,0,1,0,4".format
    names = "step,x,y,heading,P_xx,P_xy,P_xh,P_yy,P_yh,P_hh\n"
    (tmp_path / "est.csv").write_text(names + "\n".join(row(k, k, (40 * k + 1) % 360) for k in range(30)))
    said = refused(capsys, "analyse", tmp_path / "est.csv", "--truth", tmp_path / "truth.csv")
    assert "est.csv: the headings of the truth jump by a whole turn of 360" in said
    true = np.stack([K, 0 * K, (40 * K + RUN) % 360], axis=-1)
    np.savez(tmp_path / "a.npz", estimates=true, truth=true, covariances=identities(3, *K.shape))
    with pytest.raises(cs.InputError, match="headings of the truth jump"):
        cs.read(tmp_path / "a.npz", error="so2")


def test_errors_that_jump_by_360(rng):
    error = 2.0 * rng.normal(size=(20, 10, 2))
    error[:4, 3, 1] += 360.0
    record = cs.judge(error, 4.0 * identities(2, 20, 10), axes=["x", "heading"]).record
    assert [note for note in record.origin.notes if "360" in note] == [
        "arrays: the error of heading is off by 360 in 4 of 200 steps, as that of an angle; wrap it to [-180, 180]"
    ]
    error[:4, 3, 1] -= 180.0
    assert not cs.judge(error, 4.0 * identities(2, 20, 10), axes=["x", "heading"]).record.origin.notes


# --- orientations that are none ----------------------------------------------------------------------


def turning(heading, course, true=None, sigma=0.01):
    """Runs in space with headings (runs, steps) along a course; the true orientation is ``true`` or a constant."""
    rng = np.random.default_rng()
    way = np.cumsum(np.stack([np.cos(course), np.sin(course), 0.1 + 0 * course], axis=-1), axis=1)
    place = np.concatenate([np.zeros((len(way), 1, 3)), way[:, :-1]], axis=1)
    t, manifold, runs = np.arange(float(heading.shape[1])), "spatial", []
    for p, h, q in zip(place, heading, np.zeros(heading.shape) if true is None else true, strict=True):
        turn = Rotation.from_rotvec(sigma * rng.normal(size=(len(t), 3))) * Rotation.from_euler("z", h[:, None])
        world = Rotation.from_euler("z", q[:, None]).as_quat() * rng.choice([-1, 1], (len(t), 1))
        runs.append(make_poses(
            Places(str, np.arange(len(t))), t, np.column_stack([p, turn.as_quat()]),
            np.broadcast_to(sigma**2 * np.eye(6), (len(t), 6, 6)), np.ones(len(t), bool), t,
            np.column_stack([p, world]), manifold, "so3", 0.0,
        ))  # fmt: skip
    return runs


CIRCLE = 0.3 * K + RUN


@pytest.mark.parametrize("runs, expected", [
    (lambda: turning(CIRCLE, CIRCLE), (True, "turn by 17. degrees with the path: it is read as positions alone")),
    (lambda: turning(CIRCLE + RUN, CIRCLE), (True, "positions alone")),  # a body turned in its mount, by run
    (lambda: turning(CIRCLE, 0 * K), (False, "degrees; if it is a placeholder, give a truth of t x y z")),
    (lambda: turning(CIRCLE, CIRCLE + 1.7 * K), (False, "if it is a placeholder")),
    (lambda: turning(CIRCLE, CIRCLE, CIRCLE), (False, "^$")),
    (lambda: turning(0 * K, CIRCLE), (False, "^$")),  # a drone that looks north on a circle
    (lambda: turning(CIRCLE, CIRCLE, sigma=0.5), (False, "^$")),  # an orientation that is hardly known
    (lambda: [p.some(2) for p in turning(CIRCLE, CIRCLE)], (False, "^$")),
])  # fmt: skip
def test_a_truth_of_one_orientation(runs, expected):
    empty, said = placeholder(runs())
    assert empty == expected[0]
    assert re.search(expected[1], said)


def test_positions_with_a_placeholder_are_positions(tmp_path):
    est, truth = planar(tmp_path, (0.01, 0.01, 0.01))
    bare = tmp_path / "positions"
    bare.mkdir()
    for path in truth.iterdir():
        rows = np.loadtxt(path)
        angle = np.arctan2(rows[:, 6], rows[:, 7])  # half of the heading: a path along it
        rows[:, 1], rows[:, 2] = 50 * np.sin(2 * angle), -50 * np.cos(2 * angle)
        own = np.loadtxt(est / path.name)
        own[:, 1:4] = rows[:, 1:4] + 0.1 * np.random.default_rng().normal(size=(len(rows), 3))
        own[:, 8:] = np.diag([0.01, 0.01, 0.01, 1e-4, 1e-4, 1e-4]).ravel()
        np.savetxt(est / path.name, own)
        rows[:, 4:] = [0.5, 0.5, 0.5, 0.5]
        np.savetxt(path, rows)
        np.savetxt(bare / path.name, rows[:, :4])
    record, same = (cs.read(est, truth=each, lever_arm=[0.1, 0, 0]) for each in (truth, bare))
    assert_allclose(record.errors.error, same.errors.error)
    assert record.errors.axes == ("x", "y", "z")
    assert "the truth has the same orientation in every row" in notes_of(record)
    assert cs.read(est, truth=truth, axes=["x", "yaw"]).errors.axes == ("x", "yaw")


# --- the order of blocks -----------------------------------------------------------------------------


def blocks(at, order):
    """A run with the covariance diag(1, 2, ..., n) of p, R, v, bg, ba, written in an order."""
    names = order.split(",")
    n = 3 * len(names)
    place = [3 * ("p", "R", "v", "bg", "ba").index(name) + i for name in names for i in range(3)]
    P = np.diag(1.0 + np.arange(n))[np.ix_(place, place)]
    head = "t x y z qx qy qz qw vx vy vz bgx bgy bgz bax bay baz".split()[: 2 + n]  # noqa: SIM905
    rows = np.column_stack([np.arange(3), np.zeros((3, 6)), np.ones(3), np.zeros((3, n - 6))])
    own = np.column_stack([rows, np.broadcast_to(P.ravel(), (3, n * n))])
    for name, values in (("est", own), ("truth", rows)):
        values = values.copy()
        values[:, 1:4] += 0.1 * (name == "est")
        values[:, 8 : 2 + n] += 0.1 * (name == "est")
        header = ",".join([*head, *(f"cov_{i}" for i in range(values.shape[1] - len(head)))])
        np.savetxt(at / f"{name}.csv", values, delimiter=",", header=header, comments="")
    return at / "est.csv", at / "truth.csv"


@pytest.mark.parametrize("order", ["p,R,v", "p,v,R", "v,R,p", "R,v,p", "R,v,p,ba,bg", "bg,p,ba,R,v"])
def test_blocks_in_any_order(order, tmp_path):
    est, truth = blocks(tmp_path, order)
    read = {"truth": truth, "error": "so3", "axes": [*AXES, *REST][: 3 * len(order.split(","))]}
    record = cs.read(est, covariance_order=order, **read)
    n = 3 * len(order.split(","))
    assert_array_equal(np.diagonal(record.errors.covariance[0, 0]), 1.0 + np.arange(n))
    assert f"{est}: the covariance is read in the order {order.replace(',', ', ')}; --covariance-order" in " ".join(
        record.origin.notes
    )
    for columns in (None, {"P*": "cov*"}):
        taken = " ".join(cs.read(est, columns=columns, **read).origin.notes)
        assert f"is read in the order {', '.join(['p', 'R', 'v', 'bg', 'ba'][: n // 3])};" in taken


def test_named_entries_have_no_order(tmp_path):
    est, truth = blocks(tmp_path, "p,R,v")
    rows = est.read_text().splitlines()
    labels = [*AXES, *REST][:9]
    names = ",".join([*rows[0].split(",")[:11], *(f"P_{a}_{b}" for a in labels for b in labels)])
    est.write_text("\n".join([names, *rows[1:]]))
    record = cs.read(est, truth=truth, error="so3", axes=labels)
    assert record.errors.covariance.shape[-1] == 9
    assert "in the order" not in notes_of(record)


@pytest.mark.parametrize("order, said", [
    ("p,p,R", "or the blocks p,R,v of"), ("p,q,R", "must be translation-rotation or rotation-translation, or"),
    ("p,R,v,bg,ba", r"or the blocks p,R,v of .* in their order, such as v,R,p \(p position"),
])  # fmt: skip
def test_orders_that_do_not_fit(order, said, tmp_path):
    est, truth = blocks(tmp_path, "p,R,v")
    with pytest.raises(cs.InputError, match=said):
        cs.read(est, truth=truth, error="so3", covariance_order=order)


# --- outliers among innovations ------------------------------------------------------------------------


def of_nis(nis, **settings):
    return judge(record_of_checked("f", nis=nis, nis_dof=2, optimal_gain=True), Settings(false_alarm=SURE, **settings))


def quantiles(shape, scale=1.0):
    """NIS of a right filter without chance: quantiles of chi-square(2), mixed."""
    share = (np.arange(np.prod(shape)) + 0.5) / np.prod(shape)
    return scale * np.random.default_rng().permutation(stats.chi2.ppf(share, 2)).reshape(shape)


@pytest.mark.parametrize("scale, status", [(1.0, "heavy-tailed"), (0.5, "inconsistent"), (2.0, "overconfident")])
def test_an_innovation_that_is_off_by_a_turn(scale, status):
    nis = quantiles((4, 150), scale)
    nis[2, 100] = 3948.0
    for settings in ({}, {"tolerance": 10.0}, {"allow": "conservative"}):
        expected = "heavy-tailed" if (scale, *settings) == (0.5, "allow") else status
        verdict = of_nis(nis, **settings)
        assert verdict.status == expected
        assert "in run 2, step 101 (NIS 3948, 2 expected)" in verdict.reasons[0]
        assert verdict.innovations.outliers.rest.ratio == pytest.approx(scale, rel=0.02)
        assert f"freedom of the rest {verdict.innovations.outliers.rest.ratio:.3f}" in verdict.reasons[0]
    assert verdict.statistics["nis_outliers"]["count"] == verdict.innovations.outliers.count


def test_one_percent_of_outliers_and_the_scale_of_the_rest():
    nis = quantiles((1, 1000))
    some = np.random.default_rng().choice(1000, 10, replace=False)
    nis[0, some] = 40.0 * stats.chi2.ppf(np.linspace(0.5, 0.95, 10), 2)
    verdict = of_nis(nis)
    assert verdict.status == "heavy-tailed"
    assert (verdict.innovations.outliers.count, verdict.innovations.outliers.of) == (10, 1000)
    assert verdict.innovations.outliers.step == some[-1] + 1
    assert abs(verdict.innovations.outliers.rest.ratio - 1.0) < 0.1  # the ten replaced are 1 % of all


def test_few_outliers_only():
    nis = quantiles((1, 100))
    dof = np.full(nis.shape, 2)
    assert outliers_of(nis, dof) is None
    nis[0, :5] = 400.0
    assert outliers_of(nis, dof).count == 5
    nis[0, [1, 3]] = 5000.0, 9000.0  # the chance of both is 0 to a double
    assert outliers_of(nis, dof).step == 3
    nis[0, 5] = 400.0
    assert outliers_of(nis, dof) is None
    assert outliers_of(np.full((1, 1), 400.0), np.full((1, 1), 2)) is None
    limit = stats.chi2.isf(1e-9 / 100, 2)  # a right filter comes beyond it once in 1e9 records
    for value, found in ((limit - 1e-6, False), (limit + 1e-6, True)):
        nis[0, :6] = 1.0, 1.0, 1.0, 1.0, 1.0, value
        assert (outliers_of(nis, dof) is not None) == found


def test_outliers_beside_errors(rng):
    v = rng.normal(size=(60, 20, 2))
    v[7, 9] = [40.0, 0.0]
    P = identities(2, 60, 20)
    record = record_of_checked(
        "f", rng.normal(size=v.shape), P, innovations=v, innovation_covariances=P, optimal_gain=True
    )
    verdict = judge(record, Settings(false_alarm=SURE))
    assert verdict.status == "inconsistent"
    said = "inconsistent: 1 of 1200 innovations is an outlier, in run 7, step 10 (NIS 1600, 2 expected); NIS"
    assert verdict.reasons[0].startswith(said)


def test_the_monitor_alarms_and_names_the_outlier():
    monitor = cs.Monitor()
    nis = np.array([2.0] * 50 + [3948.0] + [2.0] * 9)
    alarms = [alarm for x in nis if (alarm := monitor.update(x, np.int64(2))) is not None]
    assert [alarm.step for alarm in alarms] == [51]
    assert alarms[0].rest == 1.0
    assert "; the NIS of this step is an outlier, and that of the others x1, e-value" in str(alarms[0])
    monitor = cs.Monitor()
    alarms = [alarm for _ in range(50) if (alarm := monitor.update(20.0, 2)) is not None]
    assert "outlier" not in str(alarms[0])
