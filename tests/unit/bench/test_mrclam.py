"""MRCLAM as a log: what the calibration finds in a recording whose faults are known."""

import gzip
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

import consistency as cs
from consistency.bench.runs.reproduce_findings import sibling

SCRIPTS = Path(__file__).parents[3] / "experiments"
conversion = sibling(str(SCRIPTS / "e15_mrclam.py"), "mrclam_log")
LAG, SCALE, BIAS = 0.2, 0.93, 0.003  # s; true over stated speed; rad/s
LANDMARKS = np.array([[2.0, 0.0], [-2.0, 1.0], [0.0, 3.0]])
CODES = (63, 81, 7)


def rates(t):
    """True speed and turn rate."""
    return 0.08 + 0.0 * t, 0.3 * np.sin(0.7 * t)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """One robot of 400 s: odometry ahead of it, too fast and turning; late stamps of the camera; a wrong barcode."""
    at, rng = tmp_path_factory.mktemp("MRCLAM_Dataset0"), np.random.default_rng(0)
    t = np.arange(0.0, 400.0, 0.01)
    v, omega = rates(t)
    heading = np.concatenate([[0.0], np.cumsum(omega[:-1] * 0.01)])
    x, y = (np.concatenate([[0.0], np.cumsum((v * f(heading))[:-1] * 0.01)]) for f in (np.cos, np.sin))
    ahead_v, ahead_omega = rates(t + LAG)
    np.savetxt(at / "Robot1_Odometry.dat.gz", np.column_stack([t, ahead_v / SCALE, ahead_omega - BIAS])[::2])
    wrapped = (heading + np.pi) % (2 * np.pi) - np.pi
    np.savetxt(at / "Robot1_Groundtruth.dat.gz", np.column_stack([t, x, y, wrapped])[::2])
    rows = []
    for k in range(100, len(t) - 100, 37):
        i = k % 3
        offset = (LANDMARKS[i] - [x[k], y[k]]) @ [1.0, 1j]
        z = abs(offset) + 0.1 * rng.normal(), np.angle(offset * np.exp(-1j * heading[k])) + 0.01 * rng.normal()
        rows.append((t[k] + conversion.CAMERA_LAG, CODES[i], *z))
    rows[-5] = (rows[-5][0], rows[-5][1], rows[-5][2] + 2.0, rows[-5][3])
    rows.append((399.0, 99, 1.0, 0.0))  # a barcode that nobody has
    np.savetxt(at / "Robot1_Measurement.dat.gz", rows)
    places = np.column_stack([[6, 7, 8], LANDMARKS, np.full((3, 2), 1e-4)])
    np.savetxt(at / "Landmark_Groundtruth.dat", places)
    np.savetxt(at / "Barcodes.dat", [(1, 5), *zip((6, 7, 8), CODES, strict=True)])
    return at


def test_the_calibration_finds_scale_bias_and_lag(folder):
    found = conversion.calibrate(conversion.read_robot(folder, 1))
    assert found.lag == pytest.approx(LAG)
    assert found.scale_v == pytest.approx(SCALE, abs=2e-3)
    assert found.scale_omega == pytest.approx(1.0, abs=5e-3)
    assert found.bias_omega == pytest.approx(BIAS, abs=2e-4)
    assert found.sigma == pytest.approx((0.1, 0.01), rel=0.15)
    assert np.abs(found.bias).max() < 0.02


def test_the_log_is_the_drive_after_the_calibration(folder):
    data = conversion.read_robot(folder, 1)
    trial, belief, _, dropped = conversion.log_of(data)
    assert belief.sensor.model == "range-bearing"
    assert dropped.gross == 1
    assert trial.steps == pytest.approx((400.0 - conversion.CALIBRATION) / conversion.DT, abs=5)
    pose = trial.truth[trial.step]
    offset = (trial.landmarks[trial.landmark, :2] - pose[:, :2]) @ [1.0, 1j]
    turn = np.angle(np.exp(1j * (trial.z[:, 1] + pose[:, 2])) * np.conj(offset))
    assert np.abs(turn).max() < 0.05  # 5 sigma: moved to the step, without the lag of the camera
    assert np.std(turn) == pytest.approx(0.01, rel=0.2)
    driven = np.array([trial.start, *trial.truth[1:]])[:, 2]
    assert np.abs(np.diff(driven) - trial.controls[:, 2] * conversion.DT).max() < 2e-3


def test_files_may_be_gzipped_or_not(folder, tmp_path):
    for path in folder.iterdir():
        unpacked = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
        (tmp_path / path.name.removesuffix(".gz")).write_bytes(unpacked)
    packed, plain = (conversion.read_robot(at, 1) for at in (folder, tmp_path))
    for name in ("odometry", "measurements", "truth", "landmarks"):
        np.testing.assert_array_equal(getattr(packed, name), getattr(plain, name))
    shutil.copy(folder / "Robot1_Odometry.dat.gz", tmp_path)
    with pytest.raises(cs.InputError, match=r"Odometry.dat.gz: stands beside Robot1_Odometry.dat; take one"):
        conversion.read_robot(tmp_path, 1)


def test_what_is_missing_is_named(folder, tmp_path):
    with pytest.raises(cs.InputError, match=r"Robot2_Odometry.dat: is missing; it must be a file of UTIAS MRCLAM"):
        conversion.read_robot(folder, 2)
    experiment = sibling(str(SCRIPTS / "e15_mrclam.py"), "e15_mrclam")
    with pytest.raises(cs.InputError, match="holds no folder MRCLAM_DatasetN"):
        experiment.drives(tmp_path)
    assert "e15_mrclam" in sys.modules
