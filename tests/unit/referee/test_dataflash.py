"""Flight logs of ArduPilot through the monitor, written message by message with pymavlink."""

import json
import sys
from unittest import mock

import numpy as np
import pytest
from command import consistency, refused
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats

from consistency.referee.diagnostics.monitor import GateRatios
from consistency.referee.errors import InputError
from consistency.referee.readers.formats.flight_logs import read_ratios
from consistency.referee.verdicts.monitor_sources import read_innovations

pytest.importorskip("pymavlink", reason="needs the extra 'ardupilot'")

from dataflash_log import Flight

STEP = 100_000  # us between messages
GATES = {
    "EK3_VEL_I_GATE": 500,
    "EK3_POS_I_GATE": 300,
    "EK3_HGT_I_GATE": 200,
    "EK3_MAG_I_GATE": 300,
    "EK3_YAW_I_GATE": 250,
}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.bin"


def flight(path, ratios, message="XKF4", gates=GATES):
    """Test ratios by field."""
    log = Flight(message).set(gates)
    for k, row in enumerate(zip(*ratios.values(), strict=True)):
        log.log(message, 10**7 + k * STEP, dict(zip(ratios, map(float, row), strict=True)))
    return log.write(path)


def test_ratios_by_sensor_with_the_gates_of_the_log(tmp_path):
    heights = [0.0, 0.1, 0.0, 1.5, 0.99, 1.01]
    ratios, notes = read_ratios(flight(tmp_path / "a.bin", {"SH": heights, "SM": [0.2] * 6}))
    assert [(each.sensor, each.gate, each.components) for each in ratios] == [("hgt", 2.0, 1), ("mag", 2.5, 4)]
    assert_allclose(ratios[0].ratio, heights[1:])  # before the first it is not fused
    assert_allclose(ratios[0].t, 10.1 + 0.1 * np.arange(5))
    assert ratios[0].above(1.0) == pytest.approx(0.4)
    assert notes == [f"{tmp_path / 'a.bin'}: read as test ratios of XKF4, 6 messages"]


@pytest.mark.parametrize("components", [1, 3])
def test_a_right_filter_stays_within_its_shares(components):
    """Whether the ratio is the largest of the components or the root of a mean, by quantiles and not by chance.

    The shares are of 2e5 draws: an excess of 6 standard deviations has a chance of 1e-9.
    """
    e = np.random.default_rng().normal(size=(200_000, components))
    weight = np.array([0.9, 0.05, 0.05])[:components]
    for sigma in (np.abs(e).max(axis=1), np.sqrt((e**2 @ weight) / weight.sum())):
        of = GateRatios("pos", np.arange(len(e)) * 1.0, sigma / 2.0, 2.0, components)
        assert of.above(of.unusual) < 0.05 + 6 * np.sqrt(0.05 / len(e))
        assert of.above(1.0) < of.rejected + 6 * np.sqrt(of.rejected / len(e))
    assert of.unusual == pytest.approx(stats.norm.isf(0.025 / components) / 2.0)
    assert GateRatios("hgt", e[:, 0], e[:, 0], 2.0, 1).rejected == pytest.approx(stats.chi2.sf(4.0, 1))


def test_shares_over_time():
    of = GateRatios("hgt", np.array([0.0, 1.0, 2.0, 9.0, 10.0]), np.array([0.1, 2.0, 2.0, 0.3, 2.0]), 5.0, 1)
    begin, share = of.over_time(1.0)
    assert_allclose(begin, np.arange(10.0))
    assert_array_equal(share, [0.0, 1.0, 1.0, *[np.nan] * 6, 0.5])


def test_older_filters_cores_and_gates_that_are_missing(tmp_path):
    """EKF2 without the number of a core; its SVT is no airspeed; a gate below 1 sigma counts as 1; cores are chosen."""
    path = tmp_path / "old.BIN"
    fields = {"SV": [0.5, 0.1], "SP": [0.3, 0.3], "SVT": [0.7, 0.7]}
    ratios, notes = read_ratios(flight(path, fields, "NKF4", {"EK2_VEL_I_GATE": 50, "EK3_POS_I_GATE": 300}))
    assert [each.sensor for each in ratios] == ["vel", "pos"]
    assert ratios[0].gate == 1.0
    assert np.isnan([ratios[1].gate, ratios[1].unusual, ratios[1].rejected, ratios[1].above(ratios[1].unusual)]).all()
    assert notes[1].endswith("PARM holds no gate of pos; what a right filter would exceed is not known")
    log = Flight("XKF4").set({**GATES, "EK3_HGT_I_GATE": 400}).set({"EK3_HGT_I_GATE": 350})
    for core, value in ((0, 0.2), (1, 0.9)):
        log.log("XKF4", 10**7, {"C": core, "SH": value, "SVT": 0.1})
    log.write(path)
    with pytest.raises(InputError, match=r"more than one core of the EKF \(0, 1\); choose with --run"):
        read_ratios(path)
    (only,), _ = read_ratios(path, "hgt", 1)
    assert (only.ratio.tolist(), only.gate) == ([0.9], 3.5)
    with pytest.raises(InputError, match=r"--filter sonar: is not in .*; there are: hgt, tas"):
        read_ratios(path, "sonar", 0)


def test_the_nis_of_innovations_with_their_variances(path):
    rng = np.random.default_rng()
    own, variance = rng.normal(size=(30, 3)), np.exp(rng.normal(size=(30, 3)))
    own[7], variance[7] = own[6], variance[6]
    log = Flight("XKFD", "XKF0")
    for k in range(30):
        values = {f"I{a}": e for a, e in zip("XYZ", own[k], strict=True)} | {
            f"IV{a}": v for a, v in zip("XYZ", variance[k], strict=True)
        }
        log.log("XKFD", 10**7 + k * STEP, values)
        log.log("XKF0", 10**7 + k * STEP, {"ID": k % 3, "innov": 0.01 * (k - 15), "SIV": 0.5})
    log.write(path)
    odometry, beacon = (read_innovations(path, sensor) for sensor in ("odometry", "beacon"))
    there = np.arange(30) != 7
    assert_allclose(odometry.nis[there], (own**2 / variance).sum(axis=1)[there], rtol=1e-5)
    assert odometry.dof.tolist() == [3 * int(each) for each in there]
    assert odometry.notes[0].endswith("odometry: 29 innovations in 30 messages XKFD; 1 repeat the innovation before")
    assert_allclose(beacon.nis, (0.01 * (np.arange(30) - 15) / 0.5) ** 2)
    assert_allclose(beacon.t, 10.0 + 0.1 * np.arange(30))


def test_one_command_from_a_flight_to_a_picture(tmp_path, capsys):
    path = flight(tmp_path / "a.bin", {"SH": [0.3] * 90 + [1.2] * 10, "SP": [0.1] * 100})
    out, err = consistency(capsys, "monitor", path, "--plot", tmp_path / "a.png")
    for said in ("hgt", "2 sigma", "10.0%", "100.0% from 18.91 s", "no NIS", "no verdict and no alarm", "≤ 0.05"):
        assert said in " ".join(out.split())
    assert "read as test ratios of XKF4, 100 messages" in err
    assert (tmp_path / "a.png").stat().st_size > 10_000
    data = json.loads(consistency(capsys, "monitor", path, "--json", "--filter", "hgt")[0])
    assert list(data["sensors"]) == ["hgt"]
    assert data["sensors"]["hgt"]["above_1"] == pytest.approx(0.1)
    assert data["sensors"]["hgt"]["unusual_above"] == pytest.approx(stats.norm.isf(0.025) / 2.0)
    assert [piece["unusual"] for piece in data["sensors"]["hgt"]["over_time"]][-1] == pytest.approx(1.0)
    assert "alarm" not in data


def test_what_cannot_be_used_is_one_line(path, capsys):
    assert "a.bin: no such file" in refused(capsys, "monitor", path)
    for content in (b"", b"not a log", bytes(1000)):
        path.write_bytes(content)
        assert "a.bin: is not a flight log of ArduPilot" in refused(capsys, "monitor", path)
    Flight().write(path)
    assert "holds no message XKF4 or NKF4" in refused(capsys, "monitor", path)
    flight(path, {"SH": [0.0, 0.0]})
    assert "the test ratios of XKF4 are 0 throughout" in refused(capsys, "monitor", path)
    flight(path, {"SH": [0.5, 0.5]})
    assert "holds no message XKFD" in refused(
        capsys, "monitor", path, "--innovations", "optimal", "--filter", "odometry"
    )
    for option in (("--fail-on", "alarm"), ("--gate", "0.99")):
        said = refused(capsys, "monitor", path, *option)
        assert f"{option[0]}: {path} holds test ratios, of which nothing is judged, unless --filter names" in said
    back = Flight("XKF4", "XKFD")
    for stamp in (10**7, 10**6):
        back.log("XKF4", stamp, {"SH": 0.4})
        back.log("XKFD", 10**6, {"IVX": -1.0})
    back.write(path)
    assert "message 2 of XKF4 is older than the one before" in refused(capsys, "monitor", path)
    said = refused(capsys, "monitor", path, "--innovations", "optimal", "--filter", "odometry")
    assert "XKFD at 1 s: -1 is below 0, beside IX" in said
    with mock.patch.dict(sys.modules, {"pymavlink.DFReader": None}):
        assert "a log of ArduPilot needs pymavlink: pip install " in refused(capsys, "monitor", path)


def test_a_log_that_is_cut_short_is_read_as_far_as_it_goes(path):
    flight(path, {"SH": np.linspace(0.1, 0.9, 50)})
    whole = path.read_bytes()
    path.write_bytes(whole[:-700])
    (only,), _ = read_ratios(path)
    assert 20 < len(only.ratio) < 45
    assert_allclose(only.ratio, np.linspace(0.1, 0.9, 50)[: len(only.ratio)], atol=0.006)
