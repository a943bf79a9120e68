"""Relative poses over windows: groups, covariances by finite differences, windows, frames, files and refusals."""

import json
import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import relative_poses as world
from command import consistency, refused
from documents import ROOT
from numpy.testing import assert_allclose
from records import changed
from relative_poses import AXES, DECLARED, drive, exp, motion_stretch, pose_stretch, recorded, vectors

import consistency as cs
from consistency.referee.diagnostics.verdict import plain
from consistency.referee.diagnostics.whiteness import ENOUGH
from consistency.referee.geometry import composed, matrices, propagated, to_left
from consistency.referee.readers.pipeline.relative_motions import windows_of
from consistency.referee.readers.runs_to_record import Relative
from consistency.referee.verdicts.compare_sources import baseline, compare_with
from consistency.referee.verdicts.judge_sources import judge_all

GROUPS = tuple(world.SIGMA)
SURE = 1e-5  # false-alarm rate of a verdict in a test
DATA = Path(os.environ.get("CONSISTENCY_DATA", Path(__file__).parents[4] / "shared" / "data"))


# --- frames ------------------------------------------------------------------------------------------


def statistics(stretches, size, motions):
    return dict(plain(verdict_of(stretches, size, motions).statistics))


def verdict_of(stretches, size, motions):
    return judge_all([recorded(stretches, size, motions)])["log"]


def same(a, b):
    assert type(a) is type(b)
    if isinstance(a, dict):
        assert isinstance(b, dict)
        assert a.keys() == b.keys()
        for key in a:
            same(a[key], b[key])
    elif isinstance(a, list):
        assert isinstance(b, list)
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            same(x, y)
    elif isinstance(a, float):
        assert a == pytest.approx(b, rel=1e-9, abs=1e-9, nan_ok=True)
    else:
        assert a == b


@pytest.mark.parametrize("size", ["5", "1s", "2m"])
@pytest.mark.parametrize("group", GROUPS)
def test_another_world_of_the_truth_changes_no_number_of_motions(group, size, rng):
    stretch = motion_stretch(drive(rng, group, 200))
    G = exp(3.0 * rng.normal(size=(1, len(AXES[group]))))
    turned = stretch.with_values(truth=vectors(G @ matrices(stretch.true.values)))
    same(statistics([stretch], size, True), statistics([turned], size, True))


@pytest.mark.parametrize("group", GROUPS)
def test_another_world_of_either_changes_no_number_of_poses(group, rng):
    runs = [pose_stretch(rng, group, 8, 5, 1.0, run) for run in range(21)]
    kind, n = DECLARED[group], len(AXES[group])
    turned = []
    for run in runs:
        G, H = exp(2.0 * rng.normal(size=(2, n)))[:, None]
        T = matrices(run.own.estimate)
        # the covariance of the same uncertainty, about the axes of the other world
        J = np.linalg.inv(to_left(G @ T, kind)) @ to_left(T, kind)
        cross = run.own.cross.copy()
        cross[1:] = J[:-1] @ run.own.cross[1:] @ np.swapaxes(J[1:], 1, 2)
        turned.append(
            run.with_values(
                estimate=vectors(G @ T), truth=vectors(H @ matrices(run.true.values)),
                covariance=propagated(J, run.own.covariance), cross=cross,
            )
        )  # fmt: skip
    same(statistics(runs, "1", False), statistics(turned, "1", False))


# --- verdicts --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("group", GROUPS)
def test_right_motions_are_consistent_and_wrong_ones_are_found(group, rng):
    """One of the two fails by chance in fewer than 1e-5 of all draws: 100 windows, and a ratio of 4."""
    for ratio, status in ((1.0, "consistent"), (4.0, "overconfident"), (0.2, "conservative")):
        record = recorded([motion_stretch(drive(rng, group, 500, ratio))], "5", True)
        verdict = cs.judge(record, false_alarm=SURE, detect=4.0)
        assert verdict.status == status
        assert (verdict.runs, verdict.steps, verdict.unit) == (100, 1, "window")
        assert "windows" in verdict.reasons[0] or status != "consistent"


def test_windows_that_may_depend_are_steps_of_their_run(rng):
    runs = [pose_stretch(rng, "SE(2)", 11, 5, 1.0, run) for run in range(25)]
    verdict = verdict_of(runs, "1", False)
    assert (verdict.runs, verdict.steps, verdict.unit) == (25, 10, "run")


def windows_as_runs(stretches):
    """Windows of one step, declared to be independent."""
    relative = Relative(1, "step", independent=True)
    return world.relative_recording("log", "log", stretches, AXES["SE(2)"], range(3), relative)


def test_declared_windows_are_runs(rng):
    record = windows_as_runs([pose_stretch(rng, "SE(2)", 11, 5, 1.0, run) for run in range(3)])
    verdict = judge_all([record])["log"]
    assert (verdict.runs, verdict.steps, verdict.unit) == (30, 1, "window")
    assert_allclose(verdict.scale.mean_anees, np.mean(record.errors.nees))


def declared(rng, windows, steps=10):
    """Independent windows of poses, by declaration only; true errors are 3 times what is stated."""
    return windows_as_runs([pose_stretch(rng, "SE(2)", steps + 1, 5, 9.0, run) for run in range(windows // steps)])


def test_few_windows_do_not_show_independence(rng):
    """Errors x9: found by 150 windows, and neither a fault nor an all-clear is said with 140."""
    few = judge_all([declared(rng, ENOUGH - 10)])["log"]
    assert few.status == "undecided"
    assert few.faults == ()
    assert few.answers == ()
    assert few.reasons[0].startswith("undecided: 140 windows are too few windows to show independence, which takes 150")
    assert "the covariance ratio would be" in few.reasons[0]
    assert not few.equivalence.shown
    enough = judge_all([declared(rng, ENOUGH)])["log"]
    assert enough.status == "overconfident"
    right = changed(declared(rng, 30), unshown="")
    assert judge_all([right])["log"].runs == 30
    base = baseline([declared(rng, 50)], "log")
    with pytest.raises(cs.InputError, match="at least 8 runs"):
        compare_with(base, base, [])


def test_a_failed_window_stays_failed(rng):
    stretch = pose_stretch(rng, "SE(2)", 30, 5, 1.0, 0)
    stretch.own.estimate[20] = np.nan
    assert judge_all([windows_as_runs([stretch])])["log"].status == "failed"


# --- files -----------------------------------------------------------------------------------------------


def lines(path, *columns):
    np.savetxt(path, np.column_stack(columns), fmt="%.17g")
    return path


@pytest.fixture
def motion_file(tmp_path, rng):
    """motions.tum with truth.tum beside it, 120 motions."""
    s = motion_stretch(drive(rng, "SE(3)", 120))
    lines(tmp_path / "truth.tum", s.own.t, s.true.values)
    return lines(tmp_path / "motions.tum", s.own.t, s.own.estimate, s.own.covariance.reshape(-1, 36))


def test_motions_as_tum(motion_file):
    record = cs.read(motion_file, motion_file.parent / "truth.tum", relative="1s", motions=True)
    assert record.origin.window == "1 s"
    assert record.errors.error.shape == (1, 12, 6)
    assert_allclose(record.runs.t, np.arange(1, 13), atol=1e-9)
    planar = cs.read(
        motion_file, motion_file.parent / "truth.tum", relative=10, motions=True, axes=["x", "y", "yaw"]
    )  # fmt: skip
    assert planar.errors.axes == ("x", "y", "yaw")
    assert_allclose(planar.errors.error, record.errors.error[:, :, [0, 1, 5]], atol=1e-12)


def test_poses_with_cross_covariances_as_tum(tmp_path, rng):
    s = pose_stretch(rng, "SE(3)", 9, 5, 1.0, 0)
    lines(tmp_path / "est.tum", s.own.t, s.own.estimate)
    lines(tmp_path / "truth.tum", s.own.t, s.true.values)
    cross = np.nan_to_num(s.own.cross).reshape(-1, 36)
    P = lines(tmp_path / "P.txt", s.own.t, s.own.covariance.reshape(-1, 36), cross)
    record = cs.read(tmp_path / "est.tum", tmp_path / "truth.tum", P, relative=1)
    found = windows_of(s, Relative(1, "step"))
    assert_allclose(record.errors.covariance[0], found.covariance, rtol=1e-9)
    assert_allclose(record.errors.error[0], found.error, atol=1e-12)
    with pytest.raises(cs.InputError, match="line 3: relative=2: the window spans 2 rows"):
        cs.read(tmp_path / "est.tum", tmp_path / "truth.tum", P, relative=2)
    keep = np.arange(9) != 4
    lines(tmp_path / "some.tum", s.own.t[keep], s.own.estimate[keep])
    with pytest.raises(cs.InputError, match=r"line 5: no pose of .* has this time"):
        cs.read(tmp_path / "some.tum", tmp_path / "truth.tum", P, relative=1)


def table(path, s, cross):
    pose = ("x", "y", "heading")
    columns = {"step": np.arange(len(s.own.t)), "t": s.own.t} | dict(zip(pose, s.own.estimate.T, strict=True))
    for i, a in enumerate("xyh"):
        for j, b in enumerate("xyh"):
            columns |= {f"P_{a}{b}": s.own.covariance[:, i, j]} if i <= j else {}
            columns |= {f"C_{a}{b}": s.own.cross[:, i, j]} if cross and s.own.cross is not None else {}
    pd.DataFrame(columns).to_csv(path, index=False)
    truth = {"step": np.arange(len(s.own.t)), "t": s.own.t} | dict(zip(pose, s.true.values.T, strict=True))
    pd.DataFrame(truth).to_csv(path.with_name("truth.csv"), index=False)
    return path


def test_tables_and_archives_of_motions(tmp_path, rng):
    s = motion_stretch(drive(rng, "SE(2)", 40))
    expected = recorded([s], "5", True)
    record = cs.read(table(tmp_path / "m.csv", s, False), tmp_path / "truth.csv", relative="0.5s", motions=True)
    assert_allclose(record.errors.nees, expected.errors.nees, rtol=1e-9)
    np.savez(tmp_path / "m.npz", estimates=s.own.estimate, truth=s.true.values, covariances=s.own.covariance)
    assert_allclose(cs.read(tmp_path / "m.npz", relative=5, motions=True).errors.nees, expected.errors.nees, rtol=1e-9)
    with pytest.raises(cs.InputError, match="relative=1s needs a column t"):
        cs.read(tmp_path / "m.npz", relative="1s", motions=True)


def test_tables_and_archives_of_poses_with_cross_covariances(tmp_path, rng):
    s = pose_stretch(rng, "SE(2)", 9, 5, 1.0, 0)
    expected = recorded([s], "1", False)
    record = cs.read(table(tmp_path / "p.csv", s, True), tmp_path / "truth.csv", relative=1)
    assert_allclose(record.errors.nees, expected.errors.nees, rtol=1e-9)
    arrays = {"estimates": s.own.estimate, "truth": s.true.values, "covariances": s.own.covariance}
    arrays["cross_covariances"] = s.own.cross
    np.savez(tmp_path / "p.npz", **arrays)
    assert_allclose(cs.read(tmp_path / "p.npz", relative=1).errors.nees, expected.errors.nees, rtol=1e-9)
    declared = cs.read(tmp_path / "p.npz", relative=1, windows="independent")
    assert cs.judge(declared).runs == 8
    np.savez(tmp_path / "q.npz", **arrays | {"cross_covariances": s.own.cross[:4]})
    with pytest.raises(cs.InputError, match="key 'cross_covariances' has shape"):
        cs.read(tmp_path / "q.npz", relative=1)
    data = pd.read_csv(tmp_path / "p.csv").drop(columns="C_yx")
    data.to_csv(tmp_path / "p.csv", index=False)
    with pytest.raises(cs.InputError, match="column 'C_yx' is missing"):
        cs.read(tmp_path / "p.csv", tmp_path / "truth.csv", relative=1)


# --- refusals and commands -------------------------------------------------------------------------------


def test_marginal_covariances_are_refused_with_the_remedy(motion_file, capsys):
    files = [str(motion_file), "--truth", str(motion_file.parent / "truth.tum")]
    cases = {
        ("--relative", "10"): "covariances of two poses do not tell that of the motion between them; give their cross",
        ("--motions",): "--motions: motions share no world with the truth; judge them with --relative",
        ("--windows", "independent"): "--windows goes with --relative",
        ("--relative", "10", "--windows", "all"): "--windows must be 'independent', got 'all'",
        ("--relative", "10", "--motions", "--time-offset", "estimate"): "needs poses in one world",
        ("--relative", "1000s", "--motions"): "only 12 s have truth; ask for shorter windows",
        ("--relative", "0.01s", "--motions"): "rows with truth are 0.1 s apart in the median; ask for longer windows",
        ("--relative", "2x", "--motions"): "--relative 2x: must be a whole number of steps",
    }
    for options, text in cases.items():
        assert text in refused(capsys, "analyse", *files, *options)


def test_what_has_no_poses_is_refused(tmp_path, rng):
    s = motion_stretch(drive(rng, "SE(2)", 10))
    path = table(tmp_path / "m.csv", s, False)
    with pytest.raises(cs.InputError, match="relative needs poses x, y, heading"):
        cs.read(path, tmp_path / "truth.csv", error="vector", relative=1, motions=True)
    with pytest.raises(cs.InputError, match="relative needs truth=FILE"):
        cs.read(path, relative=1, motions=True)
    np.savez(tmp_path / "e.npz", errors=np.ones((30, 4, 2)), covariances=np.broadcast_to(np.eye(2), (30, 4, 2, 2)))
    with pytest.raises(cs.InputError, match="relative needs the keys estimates, truth, covariances"):
        cs.read(tmp_path / "e.npz", relative=1)


def test_the_command_and_its_report(motion_file, capsys):
    out = motion_file.parent / "look"
    files = [str(motion_file), "--truth", str(motion_file.parent / "truth.tum"), "--motions", "--relative", "0.5s"]
    shown, notes = consistency(capsys, "analyse", *files, "--report", out)
    assert "24 windows of 0.5 s" in notes
    assert "what is constant over a window" in notes
    assert "of 24" in shown
    page = (out / "report.html").read_text()
    assert "24 windows of 0.5 s" in page
    assert "NEES of the motion over each window of 0.5 s" in page
    assert "24 windows, each of which counts as a run" in page
    assert "Windows of a log count as runs of one step here" in page
    told = json.loads((out / "verdict.json").read_text())["motions"]["statistics"]
    assert (told["runs"], told["unit"], told["convention"]) == (24, "window", "left")


# --- the front-end -----------------------------------------------------------------------------------------


def simulated_motions(rng, number):
    """Motions of a front-end, and true poses (number + 1, 4, 4); errors are of roll, pitch, yaw."""
    from consistency.referee.geometry import rotation
    from consistency.stereo.visual_odometry.relative_motion import RelativeMotion
    from consistency.stereo.visual_odometry.relative_pose import RelativePose

    root = np.diag([0.02, 0.01, 0.03, 0.002, 0.004, 0.003]) @ (np.eye(6) + 0.3 * rng.normal(size=(6, 6)))
    found, steps = list[object](), [np.eye(4)]
    none, of = np.empty((0, 4)), np.zeros(0, bool)
    for _ in range(number):
        vector = np.concatenate([[0.1, 0.0, 1.0], 0.4 * rng.normal(size=3)])
        true = vector + root @ rng.normal(size=6)
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = rotation(*true[3:]), true[:3]
        steps.append(step)
        fields = dict.fromkeys(RelativeMotion.__dataclass_fields__)
        values = {"pose": RelativePose.from_vector(vector), "covariance": root @ root.T, "inliers": of, "uv0": none}
        motion = object.__new__(RelativeMotion)
        for name in fields:
            object.__setattr__(motion, name, values.get(name))
        found.append(motion)
    return found, composed(np.array(steps))


def test_motions_of_the_front_end_are_read_and_right(tmp_path, rng):
    """Without images: 400 motions with large turns; x1.5 is found in all but 1e-5 of all draws."""
    from consistency.stereo.frontend.images_to_log import motions_text
    from consistency.stereo.visual_odometry.odometry import motion_covariances

    motions, truth = simulated_motions(rng, 400)
    R, t = np.array([m.pose.R for m in motions]), np.array([m.pose.t for m in motions])
    stamps = 0.1 * np.arange(401)
    (tmp_path / "motions.tum").write_text(motions_text(stamps, R, t, motion_covariances(motions)))
    lines(tmp_path / "truth.tum", stamps, vectors(truth))
    for size, count in (("1", 400), ("0.4s", 100)):
        record = cs.read(tmp_path / "motions.tum", tmp_path / "truth.tum", relative=size, motions=True)
        verdict = cs.judge(record, false_alarm=SURE)
        assert verdict.runs == count
        assert verdict.faults == ()
    assert cs.judge(record, false_alarm=SURE, detect=1.5).status == "consistent"


@pytest.mark.parametrize(
    "name, truth, size, count",
    [("kitti06_f0-50", "poses.txt", "0.5s", 10), ("euroc_static", "groundtruth_first97.csv", "1", 5)],
)
@pytest.mark.slow
def test_a_real_sequence_from_images_to_windows(tmp_path, name, truth, size, count, capsys):
    """Images, motions, windows: the verdict of docs/front-end.md, where the covariance is of pixel noise alone."""
    pytest.importorskip("cv2", reason="OpenCV (the extra vision) is not installed")
    if not (DATA / name).is_dir():
        pytest.skip(f"no {DATA / name}; set CONSISTENCY_DATA to the folder that holds {name}")
    log_folder = tmp_path / "log"
    consistency(capsys, "frontend", DATA / name, "--truth", DATA / name / truth, "--out", log_folder)
    record = cs.read(log_folder / "motions.tum", log_folder / "truth.tum", relative=size, motions=True)
    verdict = cs.judge(record)
    assert (verdict.runs, verdict.status) == (count, "overconfident")


def test_the_example_of_the_manual(inside):
    example = (ROOT / "docs/examples/wheel_odometry.py").read_text(encoding="utf-8")
    names = {}
    exec(example, names)
    verdict = cs.judge(names["record"])
    assert (verdict.runs, verdict.unit, verdict.status) == (60, "window", "consistent")
