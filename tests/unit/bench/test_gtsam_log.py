"""Stereo factors as of GTSAM's examples as a log, of a drive that is known."""

import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scripts import experiment

from consistency.bench.store.recorded_log import read_log
from consistency.referee.errors import InputError

script = experiment("gtsam_log")
F, B, CENTRE = 721.5377, 0.5, (600.0, 170.0)
FRAMES, FIRST = 6, 3  # frames are counted from FIRST on
POINTS = np.random.default_rng(55).uniform((-5, -1, 10), (5, 1, 30), (20, 3))


def pose(k):
    """Of the camera, 4 x 4: ahead by 1 m a frame and turning."""
    a = 0.02 * k
    T = np.eye(4)
    T[:3, :3] = [[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]]
    T[:3, 3] = [0.01 * k * k, 0.0, k]
    return T


@pytest.fixture
def files(tmp_path):
    rows, told = [], []
    for k in range(FRAMES):
        told.append([FIRST + k, *pose(k).ravel()])
        for i, (x, y, z) in enumerate((POINTS - pose(k)[:3, 3]) @ pose(k)[:3, :3]):
            u = CENTRE[0] + F * x / z
            rows.append([FIRST + k, 7 + i, u, u - F * B / z, CENTRE[1] + F * y / z, x, y, z])
    true = [[0.104 * k, *pose(k - FIRST)[:3].ravel()] for k in range(FIRST + FRAMES)]
    out = {name: tmp_path / f"{name}.txt" for name in ("factors", "poses", "calibration", "truth")}
    for name, table in (("factors", rows), ("poses", told), ("truth", true)):
        np.savetxt(out[name], table)
    np.savetxt(out["calibration"], [[F, F, 0.0, *CENTRE, B]])
    return out


def run(files, out, *more, truth=True):
    given = [part for name, path in files.items() if truth or name != "truth" for part in (f"--{name}", str(path))]
    old, sys.argv = sys.argv, ["gtsam_log.py", *given, "--out", str(out), *more]
    try:
        script.main()
    finally:
        sys.argv = old


def test_a_drive_becomes_a_log_with_truth_and_without(files, tmp_path):
    run(files, tmp_path / "with")
    run(files, tmp_path / "without", truth=False)
    log, blind = (read_log(tmp_path / name) for name in ("with", "without"))
    trial = log.trials[0]
    assert (trial.steps, trial.n_landmarks, len(trial.z)) == (FRAMES - 1, 20, 20 * (FRAMES - 1))
    assert (tmp_path / "with/truth.tum").is_file()
    assert blind.trials[0].truth is None
    assert_allclose(trial.t[-1], 0.104 * (FRAMES - 1), atol=1e-9)
    assert_allclose(blind.trials[0].t[-1], 0.1 * (FRAMES - 1), atol=1e-9)
    assert_allclose(trial.truth[-1, 2], -0.02 * (FRAMES - 1), atol=1e-9)  # type: ignore[index]
    assert trial.truth[-1, 0] == pytest.approx(FRAMES - 1, rel=0.01)  # type: ignore[index]
    assert_array_equal(blind.trials[0].z, trial.z)
    x, y, z = ((POINTS - pose(1)[:3, 3]) @ pose(1)[:3, :3]).T
    assert_allclose(trial.observation(1).z, np.column_stack([F * x / z, F * y / z, F * B / z]), rtol=1e-9)
    assert (log.belief.sensor.f, log.belief.sensor.B) == (F, B)


def test_it_begins_where_it_is_told(files, tmp_path):
    run(files, tmp_path / "log", "--first", str(FIRST + 2))
    trial = read_log(tmp_path / "log").trials[0]
    assert trial.steps == FRAMES - 3
    x, _, z = ((POINTS - pose(3)[:3, 3]) @ pose(3)[:3, :3]).T
    assert_allclose(trial.observation(1).z[:, 0], F * x / z, rtol=1e-9)


@pytest.mark.parametrize(
    "name, text, said",
    [
        ("factors", None, r"factors\.txt: "),
        ("factors", "1 2 3\n", r"factors\.txt: must hold 8 finite numbers a line, not 3"),
        ("factors", "50 1 2 1 2 3 4 5\n", r"factors\.txt: no line is of the frames 4 to 8"),
        ("poses", "1 2\n", r"poses\.txt: must hold 17 finite numbers a line, not 2"),
        ("poses", "\n".join(" ".join([n, *["0"] * 16]) for n in "135"), r"poses\.txt: the first number of each line"),
        ("calibration", "500 500 0 1 1 0.5\n", r"calibration\.txt: no rectified camera of KITTI has f = 500 px"),
        ("truth", "x\n", r"truth\.txt: must hold 13 finite numbers a line"),
        ("truth", ("0 " * 13 + "\n") * 9, r"truth\.txt: the times in its first column must increase"),
        ("truth", ("0 " * 13 + "\n") * 4, "--first 0: leaves 1 frames of .*poses"),
    ],
)
def test_unusable_files(files, tmp_path, name, text, said):
    files[name].unlink()
    if text is not None:
        files[name].write_text(text)
    with pytest.raises(InputError, match=said) as told:
        run(files, tmp_path / "log")
    assert "\n" not in str(told.value)
    assert not (tmp_path / "log").exists()
