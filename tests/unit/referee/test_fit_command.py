"""consistency fit-covariance: files in and out, other programs' conventions, bad input."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import fit_covariance as world
import numpy as np
import pytest
import relative_poses as spatial
from command import consistency, refused
from fit_covariance import drives
from numpy.testing import assert_allclose, assert_array_less
from test_fit_model import drive_in

import consistency as cs
from consistency.referee.diagnostics.verdict import plain
from consistency.referee.extras import is_installed
from consistency.referee.fit_covariance.covariance_ratios import write_motions
from consistency.referee.fit_covariance.fit_files import (
    ceres,
    gtsam,
    robot_localization,
    seconds,
    snippets,
    straight,
    write_model,
)
from consistency.referee.geometry import composed, vectors
from consistency.referee.readers.options import make_reading

SPAN = "10m"


def write_tables(made, folder):
    """Drives as two CSV files with a column run."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = folder / "wheels.csv", folder / "truth.csv"
    for path, part in zip(paths, ("estimate", "truth"), strict=True):
        lines = ["run,t,x,y,heading"]
        for run, drive in enumerate(made, 1):
            rows = np.column_stack([drive.t, vectors(getattr(drive, part))])
            lines += [",".join([str(run), *map(repr, row)]) for row in rows.tolist()]
        path.write_text("\n".join(lines) + "\n")
    return paths


@pytest.fixture(scope="module")
def planar():
    return cs.fit_covariance(drives(np.random.default_rng(11), 5, length=400.0), SPAN, name="wheels")


@pytest.fixture(scope="module")
def full():
    rng = np.random.default_rng(12)
    return cs.fit_covariance([drive_in("SE(3)", rng, 500, name) for name in ("d0", "d1")], "3m", name="vio")


def loaded(text, tmp_path):
    """A written snippet as a module."""
    module = ModuleType("snippet")
    exec(compile(text, str(tmp_path / "snippet.py"), "exec"), module.__dict__)
    return module


# --- motions --------------------------------------------------------------------------------------------


def test_motions_read_back_have_the_same_verdict(planar, full, tmp_path):
    """To the last digit, in the plane and in space."""
    for model, motions, truth in ((planar, "motions.csv", "truth.csv"), (full, "motions", "truth")):
        out = tmp_path / model.name
        write_model(model, out)
        record = cs.read(out / motions, truth=out / truth, relative=1, motions=True)
        own, read = (
            json.dumps(each.statistics, default=str, sort_keys=True) for each in (model.verdict, cs.judge(record))
        )
        assert own == read
        stored = json.loads((out / "verdict.json").read_text())
        assert stored["referee"] == json.loads(json.dumps(plain(model.verdict.statistics)))
        assert stored["status"] == model.status


def test_a_window_that_is_left_out_begins_another_run(rng, tmp_path):
    made = drives(rng, 2, world.World(jumps=1), 600.0)
    model = cs.fit_covariance(made, SPAN)
    assert model.counts["jumps"] >= 1
    assert len(model.stretches) >= 3
    write_model(model, tmp_path / "out")
    record = cs.read(tmp_path / "out" / "motions.csv", truth=tmp_path / "out" / "truth.csv", relative=1, motions=True)
    assert np.isfinite(np.asarray(record.errors.nees)).sum() == model.counts["windows"]


def test_motions_without_a_clock_have_no_column_of_it(planar, tmp_path):
    stretches = planar.stretches
    for name, t in (("clock", stretches[0].own.t), ("none", np.full(len(stretches[0].own.t), np.nan))):
        (tmp_path / name).mkdir()
        write_motions([stretches[0].with_values(t=t)], tmp_path / name)
        head, first = (tmp_path / name / "motions.csv").read_text().splitlines()[:2]
        assert head.startswith("run,step,t,x,y,heading,P_" if name == "clock" else "run,step,x,y,heading,P_")
        assert head.count(",") == first.count(",")
        assert (tmp_path / name / "truth.csv").read_text().splitlines()[0] == head[: head.index(",P_")]


# --- other programs --------------------------------------------------------------------------------------


def integrated(twist, v, w, dt, n):
    """Covariance (x, y, yaw) in the last frame after n messages, each integrated with its twist covariance.

    A filter that predicts with a measured twist u moves by u dt, so that each step adds dt^2 times the covariance of u.
    """
    P, step = np.zeros((3, 3)), world.matrices_of(np.array([[v * dt, 0.0, w * dt]]))[0]
    A = np.linalg.inv(step)
    Ad = np.array([[A[0, 0], A[0, 1], A[1, 2]], [A[1, 0], A[1, 1], -A[0, 2]], [0, 0, 1]])
    for _ in range(n):
        R = np.array(twist(v, w, dt)).reshape(6, 6)[np.ix_([0, 1, 5], [0, 1, 5])]
        P = Ad @ P @ Ad.T + dt**2 * R
    return P


@pytest.mark.parametrize("w", [0.0, 0.15])
def test_a_twist_integrates_to_the_covariance_of_the_model(planar, w, tmp_path):
    twist = loaded(robot_localization(planar), tmp_path).twist_covariance
    dt, n, v = 0.005, 2000, 1.0
    motion = composed(np.repeat(world.matrices_of(np.array([[v * dt, 0.0, w * dt]])), n, 0))[-1]
    C = planar.covariance([motion[0, 2], motion[1, 2], np.arctan2(motion[1, 0], motion[0, 0])])
    got = integrated(twist, v, w, dt, n)
    assert_allclose(got, C, rtol=0.01, atol=1e-3 * np.sqrt(np.outer(np.diag(C), np.diag(C))).max())


def test_a_twist_at_rest_reaches_the_floor_in_the_time_of_a_span(planar, tmp_path):
    twist = loaded(robot_localization(planar), tmp_path).twist_covariance
    n = 100
    P = integrated(twist, 0.0, 0.0, seconds(planar) / n, n)
    assert_allclose(np.diag(P), planar.noise.floor)
    assert (np.array(twist(0.0, 0.0, 0.1))[[0, 7, 35]] > 0).all()
    assert seconds(planar) == pytest.approx(10.0)  # 1 m/s


def test_gtsam_has_the_same_matrix(planar, full, tmp_path):
    """The rotation is first in Pose3; a motion at rest has the floor."""
    gtsam_ = pytest.importorskip("gtsam")
    snippet = loaded(gtsam(planar), tmp_path)
    for motion in ([9.0, 1.5, 0.4], [0.0, 0.0, 0.0]):
        got = snippet.noise(gtsam_.Pose2(*motion)).covariance()
        assert_allclose(got, planar.covariance(motion), rtol=1e-9, atol=1e-15)
    snippet = loaded(gtsam(full), tmp_path)
    turn = spatial.exp(np.array([[2.5, 0.3, -0.2, 0.1, -0.2, 0.4]]))[0]
    order = [3, 4, 5, 0, 1, 2]
    for T in (turn, np.eye(4)):
        C = full.covariance(spatial.vectors(T[None])[0])
        got = snippet.noise(gtsam_.Pose3(T)).covariance()
        assert_allclose(got, C[np.ix_(order, order)], rtol=1e-8, atol=1e-15)
    # a factor of gtsam has the error in the frame at the end of the motion
    e = np.array([0.01, -0.02, 0.03, 0.1, 0.2, -0.1])
    factor = gtsam_.BetweenFactorPose3(0, 1, gtsam_.Pose3(turn), gtsam_.noiseModel.Unit.Create(6))
    values = gtsam_.Values()
    values.insert(0, gtsam_.Pose3())
    values.insert(1, gtsam_.Pose3(turn).compose(gtsam_.Pose3.Expmap(e)))
    assert_allclose(factor.unwhitenedError(values), e, atol=1e-12)


def test_ceres_header_whitens(full, tmp_path):
    """Compiled where there is a compiler, read as text otherwise: S^-1/2 S S^-1/2' = I."""
    (tmp_path / "ceres_noise.h").write_text(ceres(full))
    compiler = shutil.which("g++") or shutil.which("c++")
    if compiler:
        (tmp_path / "main.cc").write_text(
            '#include <cstdio>\n#include "ceres_noise.h"\n'
            'int main() { for (double x : kSqrtInformation) std::printf("%.17g ", x); return kErrorSize != 6; }\n'
        )
        subprocess.run([compiler, "-std=c++17", "-o", "a.out", "main.cc"], cwd=tmp_path, check=True)
        numbers = subprocess.run(["./a.out"], cwd=tmp_path, check=True, capture_output=True, text=True).stdout.split()
    else:
        numbers = ceres(full).split("{")[1].split("}")[0].replace(",", " ").split()
    L = np.array(numbers, float).reshape(6, 6)
    assert_allclose(L @ straight(full) @ L.T, np.eye(6), atol=1e-8)


def test_an_axis_that_never_moved_has_a_covariance_in_each_export(rng, tmp_path):
    """z, roll and pitch of a drive on a plane, at rest and moving."""

    def raised(T):
        out = np.tile(np.eye(4), (len(T), 1, 1))
        out[:, :2, :2], out[:, :2, 3] = T[:, :2, :2], T[:, :2, 2]
        return out

    flat = [replace(d, estimate=raised(d.estimate), truth=raised(d.truth)) for d in drives(rng, 2, length=400.0)]
    model = cs.fit_covariance(flat, SPAN)
    n = model.noise
    assert (n.per_m[2:5] < 1e-12).all()
    assert (n.floor > 0).all()
    C = model.covariance([0.0, 0, 0, 0, 0, 0, 1])
    assert_allclose(C, np.diag(n.floor))
    twist = loaded(robot_localization(model), tmp_path).twist_covariance
    for v in (0.0, 1.0):
        assert_array_less(n.floor[2:5] / seconds(model) / 0.1 * (1 - 1e-9), np.array(twist(v, 0.0, 0.1))[[14, 21, 28]])
    L = np.array(ceres(model).split("{")[1].split("}")[0].replace(",", " ").split(), float).reshape(6, 6)
    assert_allclose(np.diag(np.linalg.inv(L.T @ L))[2:5], n.floor[2:5], rtol=1e-6)
    for stretch in model.stretches:
        assert (np.linalg.eigvalsh(stretch.own.covariance[1:]) > 0).all()
    snippet = gtsam(model)
    assert all(f"{each:.17g}" in snippet for each in n.floor)


@pytest.mark.skipif(sys.version_info < (3, 11), reason="tomllib is of Python 3.11")
def test_noise_toml_has_all_figures(planar):
    import tomllib

    read = tomllib.loads(snippets(planar)["noise.toml"])
    n = planar.noise
    for key, values in (("variance_per_m", n.per_m), ("variance_per_rad", n.per_rad), ("floor", n.floor)):
        assert read["noise"][key] == values.tolist()
    assert read["spans"][0]["whole"]["value"] == planar.ratio.value
    assert read["status"] == planar.status
    assert read["fitted_drives"] == [f"drive {i}" for i in range(1, 6)]


# --- the command -----------------------------------------------------------------------------------------------


def test_the_command_on_tables(tmp_path, capsys):
    made = drives(np.random.default_rng(5), 3, length=300.0)
    estimates, truth = write_tables(made, tmp_path)
    words = ("fit-covariance", estimates, "--truth", truth, "--span", SPAN)
    out, err = consistency(capsys, *words, "--out", tmp_path / "noise")
    assert err == ""
    assert out.startswith("wheels: at 10 m ")
    left = "not corrected, as the interval holds none: way x["
    for each in (left, "held-out 10 m", "a new drive: ", "analyse counts each judged motion"):
        assert each in out
    names = {path.name for path in (tmp_path / "noise").iterdir()}
    assert names == {
        "noise.toml", "motions.csv", "truth.csv", "robot_localization_noise.py", "gtsam_noise.py", "ceres_noise.h",
        "verdict.json", "report.html", "manifest.json",
    }  # fmt: skip
    page = (tmp_path / "noise" / "report.html").read_text()
    assert '<p class="">Not corrected, as the interval holds none: ' in page  # a note is a sentence there
    assert '<table class="plain wide">' in page  # on a narrow screen each axis by itself
    assert '<td data-head="held-out 10 m">' in page
    if is_installed("plot"):
        assert page.count('<div class="chart"') == 1
        assert "<figcaption>Errors of corrected motions" in page
    said = json.loads(consistency(capsys, *words, "--json", "--held-out", "run 3")[0])
    assert said["fitted_drives"] == ["run 1", "run 2"]
    assert said["judged_drives"] == ["run 3"]
    same = cs.fit_covariance(cs.read_drives(estimates, truth), SPAN, held_out="run 3")
    assert said["noise"]["variance_per_m"] == pytest.approx(same.noise.per_m.tolist())
    half = (*words, "--held-out", "half", "--json")
    consistency(capsys, *half, "--fail-on", "inconsistent", status=1)
    kept, err = consistency(capsys, *half, "--keep-mean-error")
    assert (json.loads(kept)["mean"], err) == (
        {"way": 1.0, "turn": 1.0, "drift_rad_per_m": [0.0], "slip_m_per_rad": 0.0},
        "",
    )
    same, err = consistency(capsys, *half, "--no-correct")
    assert (same, err) == (kept, "consistency: --no-correct is now called --keep-mean-error\n")


def test_every_kind_of_file_gives_the_same_drive(tmp_path):
    drive = drives(np.random.default_rng(5), 1, length=100.0)[0]
    estimates, truth = write_tables([drive], tmp_path)
    E, M = vectors(drive.estimate), vectors(drive.truth)
    np.savez(tmp_path / "a.npz", estimates=E, truth=M, t=drive.t)
    for name, pose in (("a.tum", E), ("true.tum", M)):
        zero = np.zeros(len(pose))
        rows = [drive.t, pose[:, 0], pose[:, 1], zero, zero, zero, np.sin(pose[:, 2] / 2), np.cos(pose[:, 2] / 2)]
        np.savetxt(tmp_path / name, np.column_stack(rows), fmt="%.17g")
    found = [
        cs.read_drives(estimates, truth), cs.read_drives(tmp_path / "a.npz"),
        cs.read_drives(tmp_path / "a.tum", tmp_path / "true.tum"),
    ]  # fmt: skip
    for (each,) in found:
        assert_allclose(each.t, drive.t)
        assert_allclose(each.estimate[:, :2, :2], drive.estimate[:, :2, :2], atol=1e-9)
        assert_allclose(each.truth[:, 0, -1], drive.truth[:, 0, -1], atol=1e-9)


def test_offset_of_clocks_motions_and_folders_of_speeds(tmp_path):
    """Estimates 0.2 s late are shifted; motions are compounded; speeds in a folder are integrated."""
    drive = drives(np.random.default_rng(5), 1, length=100.0)[0]
    estimates, _ = write_tables([replace(drive, t=drive.t - 0.2)], tmp_path / "late")
    true = write_tables([drive], tmp_path)[1]
    (shifted,) = cs.read_drives(estimates, reading=make_reading(truth=true, time_offset=0.2))
    assert_allclose(shifted.t, drive.t)
    assert_allclose(shifted.truth, drive.truth, atol=1e-9)
    steps = np.linalg.inv(drive.estimate[:-1]) @ drive.estimate[1:]
    rows = np.column_stack([drive.t, np.concatenate([np.zeros((1, 3)), vectors(steps)])])
    motions = tmp_path / "motions.csv"
    motions.write_text("t,x,y,heading\n" + "\n".join(",".join(map(repr, row)) for row in rows.tolist()) + "\n")
    one = tmp_path / "one.csv"
    one.write_text(true.read_text().replace("run,", "").replace("\n1,", "\n"))
    (found,) = cs.read_drives(motions, reading=make_reading(truth=one, motions=True))
    assert_allclose(found.estimate, drive.estimate, atol=1e-9)
    for name in ("wheels", "truth"):
        (tmp_path / "drives" / name).mkdir(parents=True)
    for name in ("a", "b"):
        (tmp_path / "drives" / "wheels" / f"{name}.csv").write_text("t,v,omega\n0,1,0.1\n1,2,0\n2,0,0\n3,0,0\n")
        (tmp_path / "drives" / "truth" / f"{name}.csv").write_text(
            "t,x,y,heading\n0,0,0,0\n1,1,0,0\n2,2,0,0\n3,3,0,0\n"
        )
    several = cs.read_drives(tmp_path / "drives" / "wheels", tmp_path / "drives" / "truth")
    assert [each.name for each in several] == ["a", "b"]
    assert vectors(several[0].estimate)[-1] == pytest.approx(
        [10 * np.sin(0.1) + 2 * np.cos(0.1), 10 * (1 - np.cos(0.1)) + 2 * np.sin(0.1), 0.1]
    )
    (tmp_path / "drives" / "truth" / "b.csv").unlink()
    with pytest.raises(cs.InputError, match="holds no table 'b' for"):
        cs.read_drives(tmp_path / "drives" / "wheels", tmp_path / "drives" / "truth")


def test_bad_input_is_one_line(tmp_path, capsys):
    made = drives(np.random.default_rng(5), 2, length=300.0)
    estimates, truth = (str(path) for path in write_tables(made, tmp_path))
    broken = tmp_path / "broken.csv"
    broken.write_text(Path(estimates).read_text().replace("run,t,x,y,heading", "run,t,x,y,angle"))
    words = Path(estimates).read_text().splitlines()
    nan = tmp_path / "nan.csv"
    nan.write_text("\n".join([words[0], words[1], ",".join(["1", "0.5", "nan", "0", "0"]), *words[3:]]) + "\n")
    late = tmp_path / "late.csv"
    late.write_text("run,t,x,y,heading\n1,9000,0,0,0\n1,9001,1,0,0\n2,9000,0,0,0\n2,9001,1,0,0\n")
    (tmp_path / "full").mkdir()
    good = ("--truth", truth, "--span", SPAN)
    cases = [
        ((str(tmp_path / "none.csv"), *good), "no such file"),
        ((estimates, "--span", SPAN), "--truth"),
        ((estimates, "--truth", truth), "--span"),
        ((estimates, "--truth", truth, "--span", "900m"), "--span 900m"),
        ((str(broken), *good), "heading"),
        ((str(nan), *good), "line 3"),
        ((str(late), *good), "--max-dt"),
        ((estimates, *good, "--axes", "6"), "--axes 6"),
        ((estimates, *good, "--cautious", "0.9"), "--cautious"),
        ((estimates, *good, "--fail-on", "wrong"), "--fail-on"),
        ((estimates, *good, "--time-offset", "fast"), "seconds"),
        ((estimates, *good, "--keep-mean-error", "--by-turn"), "--by-turn"),
        ((estimates, *good, "--out", str(tmp_path / "full")), "exists already"),
        ((estimates, *good, "--second", str(tmp_path / "none.csv")), "no such file"),
        ((estimates, *good, "--overwrite"), "--overwrite"),
    ]
    before = sorted(path.name for path in tmp_path.iterdir())
    for given, word in cases:
        out = () if "--out" in given or "--overwrite" in given else ("--out", str(tmp_path / "new"))
        assert word in refused(capsys, "fit-covariance", *given, *out), given
        assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_picture(planar, full, tmp_path):
    pytest.importorskip("matplotlib")
    for model in (planar, full):
        figure = model.plot(tmp_path / f"{model.name}.png")
        assert (tmp_path / f"{model.name}.png").read_bytes()[:4] == b"\x89PNG"
        assert len(figure.axes) == min(len(model.spans), 3) + 3
