"""The case studies whose library is installed, run again: a fault that is mended is told, and fails nothing."""

import json
import runpy
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs/case-studies"
STUDIES = json.loads((ROOT / "reports/reference/case-studies.json").read_text("utf-8"))["studies"]
LIVE = {
    "filterpy_ensemble": "filterpy", "filterpy_imm": "filterpy", "filterpy_linear": "filterpy",
    "forecast_fitted": "statsmodels",
    "gtsam_combined": "gtsam", "gtsam_imu": "gtsam",
    "opencv_calibration": "opencv-python-headless", "opencv_kalman": "opencv-python-headless",
    "statsmodels_missing": "statsmodels", "stonesoup_kalman": "stonesoup",
}  # fmt: skip


def installed(library):
    try:
        return version(library)
    except PackageNotFoundError:
        pytest.skip(f"{library} is not installed")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of the libraries
@pytest.mark.parametrize("case", LIVE)
def test_the_library_says_what_is_kept(case, tmp_path, monkeypatch):
    """The noise is that of the kept verdicts; of another version a control may be at fault by chance in 1 of 100."""
    here = installed(LIVE[case])
    out = tmp_path / "found.json"
    monkeypatch.syspath_prepend(str(FOLDER))
    monkeypatch.setattr(sys, "argv", [str(FOLDER / f"{case}.py"), "--out", str(out)])
    runpy.run_path(sys.argv[0], run_name="__main__")
    found = json.loads(out.read_text("utf-8"))
    kept = STUDIES[f"{case} new"]
    for row, before in zip(found["rows"], kept["rows"], strict=True):
        assert row["row"] == before["row"]
        if here == kept["version"]:
            assert row["status"] == before["status"], row["sentence"]
            assert_allclose(row["ratio"], before["ratio"], rtol=0.01)
        elif row["role"] == "control":
            assert row["status"] == "consistent", row["sentence"]
        elif row["status"] != before["status"]:
            print(f"no longer found: {row['row']} of {LIVE[case]} {here}: {row['sentence']}")


def test_the_script_makes_the_stored_draws(monkeypatch):
    """Rounding of the archives is that of float32; other processors differ in last digits."""
    stored = FOLDER / f"gtsam-{installed('gtsam')}.npz"
    if not stored.exists():
        pytest.skip("draws of another version are stored")
    monkeypatch.syspath_prepend(str(FOLDER))
    import gtsam_imu

    residual, stated, _, _ = gtsam_imu.simulate(np.random.default_rng(20070), 200, turns=(1.0,))[1.0]
    with np.load(stored) as archive:
        assert_allclose(residual, archive["errors"][:, 0], rtol=1e-4, atol=1e-6)
        assert_allclose(stated, archive["covariances"][:, 0], rtol=1e-4, atol=1e-9)
