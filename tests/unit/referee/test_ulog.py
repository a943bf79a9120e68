"""Flight logs of PX4 through the monitor: pairs, sensors, units, repeats, gaps, NaN, and every refusal."""

import struct
import sys
from unittest import mock

import numpy as np
import pytest
from command import consistency
from numpy.testing import assert_allclose
from recorded import read_recordings
from scipy import stats

from consistency.referee.errors import InputError
from consistency.referee.verdicts.monitor_sources import make_monitor, read_innovations, watch

pytest.importorskip("pyulog", reason="needs the extra 'ulog'")

from flight import TOPICS, Flight, header, message

STEP = 20_000  # us between messages
NAN = float("nan")


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.ulg"


def flight(innovations, variances, field="gps_hpos", *, sample=True, start=10**7):
    """Innovations (N, n) of one sensor with their variances (N, n)."""
    log = Flight(sample=sample)
    for k, (own, variance) in enumerate(zip(innovations, variances, strict=True)):
        log.both(start + k * STEP, {field: (own, variance)})
    return log


def draws(ratio=1.0, steps=400, n=2):
    """White innovations whose true variance is ``ratio`` times the one that is logged, which changes."""
    rng = np.random.default_rng()
    variance = np.exp(rng.normal(size=(steps, n)))
    return np.sqrt(ratio * variance) * rng.normal(size=(steps, n)), variance


def test_the_nis_of_a_sensor_is_the_sum_over_its_components(path):
    own, variance = draws()
    flight(own, variance).write(path)
    log = read_innovations(path)
    assert log.name == "gps_hpos"
    assert_allclose(log.nis, (own**2 / variance).sum(axis=1), rtol=1e-5)  # floats of four bytes
    assert (log.dof == 2).all()
    assert_allclose(log.t, 10.0 + 0.02 * np.arange(len(own)), rtol=1e-12)
    assert log.step.tolist() == list(range(1, len(own) + 1))
    one = read_innovations(path, "gps_hpos[1]")
    assert_allclose(one.nis, own[:, 1] ** 2 / variance[:, 1], rtol=1e-5)
    assert (one.dof == 1).all()


def test_an_honest_filter_raises_no_alarm_and_one_that_is_not_does(path):
    """False-alarm rate 1e-5; a variance four times too small is found in 400 steps of 2 with certainty."""
    for ratio, alarm in ((1.0, False), (4.0, True)):
        flight(*draws(ratio)).write(path)
        watched = watch(read_innovations(path), make_monitor("optimal", false_alarm=1e-5))
        assert (watched.alarm is not None) == alarm
        assert watched.alarm is None or watched.alarm.direction == "overconfident"


def test_repeats_nan_and_sensors_that_are_not_fused_are_no_measurements(path):
    own = np.array([[1.0, 2.0], [1.0, 2.0], [1.0, 3.0], [NAN, NAN], [NAN, 2.0], [3.0, 1.0], [0.0, 0.0], [0.0, 4.0]])
    variance = np.array(
        [[4.0, 1.0], [4.0, 1.0], [4.0, 1.0], [4.0, 1.0], [1.0, 1.0], [9.0, NAN], [0.0, 0.0], [1.0, 2.0]]
    )
    log = read_innovations(flight(own, variance).write(path))
    assert_allclose(log.nis, [4.25, NAN, 9.25, NAN, 4.0, 1.0, NAN, 8.0])
    assert log.dof.tolist() == [2, 0, 2, 0, 1, 1, 0, 2]
    assert "gps_hpos: 5 innovations in 8 messages; 1 message repeat" in log.notes[0]


def test_what_has_no_partner_is_left_out_and_counted(path):
    own, variance = draws(steps=6)
    log = Flight()
    for k in range(6):
        stamp = 5_000_000 + k * STEP
        if k != 1:
            log.log(TOPICS[0], stamp, {"gps_hpos": own[k]})
        if k != 4:
            log.log(TOPICS[1], stamp, {"gps_hpos": variance[k]})
    found = read_innovations(log.write(path))
    keep = [0, 2, 3, 5]
    assert_allclose(found.nis, (own**2 / variance).sum(axis=1)[keep], rtol=1e-5)
    assert_allclose(found.t, 5.0 + 0.02 * np.array(keep))
    assert any("2 messages have no partner" in note for note in found.notes)


def test_logs_without_the_time_of_the_sample_go_by_that_of_publication(path):
    own, variance = draws(steps=5)
    found = read_innovations(flight(own, variance, sample=False).write(path))
    assert_allclose(found.nis, (own**2 / variance).sum(axis=1), rtol=1e-5)


def test_gaps_and_losses_are_named(path):
    own, variance = draws(steps=20)
    log = Flight()
    for k in range(20):
        log.both(10**6 + k * STEP + (k > 10) * 3 * 10**6, {"gps_hpos": (own[k], variance[k])})
    log.lose(2900)
    log.lose(60)
    notes = "\n".join(read_innovations(log.write(path)).notes)
    assert "1 gap in the messages, the longest of 3.02 s" in notes
    assert "the logger lost messages 2 times, 2.96 s in all" in notes
    assert "damaged" not in notes


def test_a_log_that_is_cut_short_is_read_as_far_as_it_goes(path):
    own, variance = draws(steps=50)
    flight(own, variance).write(path)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 3 // 5])
    log = read_innovations(path)
    assert 20 < len(log.nis) < 40
    assert_allclose(log.nis, (own**2 / variance).sum(axis=1)[: len(log.nis)], rtol=1e-5)


def test_sensors_and_instances_are_chosen(path):
    (gps, S), (baro, T) = draws(steps=9), draws(steps=9, n=1)
    log = Flight()
    for k in range(9):
        log.both(10**6 + k * STEP, {"gps_hpos": (gps[k], S[k]), "baro_vpos": (baro[k], T[k])}, instance=0)
        log.both(10**6 + k * STEP, {"baro_vpos": (2.0 * baro[k], T[k])}, instance=1)
    log.write(path)
    with pytest.raises(InputError, match=r"holds more than one instance of the EKF2 \(0, 1\); choose with --run"):
        read_innovations(path)
    with pytest.raises(InputError, match=r"holds more than one sensor \(gps_hpos, baro_vpos\); choose with --filter"):
        read_innovations(path, run=0)
    first, second = (read_innovations(path, "baro_vpos", run) for run in (0, 1))
    assert_allclose(first.nis, baro[:, 0] ** 2 / T[:, 0], rtol=1e-5)
    assert_allclose(second.nis, 4.0 * first.nis, rtol=1e-5)
    with pytest.raises(InputError, match=r"--filter gps_hpos: is never fused in .*; there are: baro_vpos$"):
        read_innovations(path, "gps_hpos", 1)
    with pytest.raises(InputError, match=r"--filter sonar: is not in .*; there are: gps_hpos, baro_vpos$"):
        read_innovations(path, "sonar", 0)
    with pytest.raises(InputError, match="--run 3: is not in"):
        read_innovations(path, "baro_vpos", 3)


def test_what_cannot_be_judged_is_refused(path):
    own, variance = draws(steps=3)
    with pytest.raises(InputError, match=r"a\.ulg: no such file"):
        read_innovations(path)
    path.write_bytes(b"ULog")
    with pytest.raises(InputError, match=r"a\.ulg: cannot be read as a ULog, damaged or cut short"):
        read_innovations(path)
    Flight().write(path)
    with pytest.raises(InputError, match="holds no message 'estimator_innovations'"):
        read_innovations(path)
    lone = Flight()
    lone.log(TOPICS[0], 10**6, {"gps_hpos": own[0]})
    with pytest.raises(InputError, match="holds no message 'estimator_innovation_variances'"):
        read_innovations(lone.write(path))
    lone.log(TOPICS[1], 10**6, {"gps_hpos": variance[0]}, instance=1)
    with pytest.raises(InputError, match="no instance of the EKF2 has both"):
        read_innovations(lone.write(path))
    apart = Flight()
    apart.log(TOPICS[0], 10**6, {"gps_hpos": own[0]})
    apart.log(TOPICS[1], 2 * 10**6, {"gps_hpos": variance[0]})
    with pytest.raises(InputError, match="no message of estimator_innovations has its partner"):
        read_innovations(apart.write(path))
    with pytest.raises(InputError, match=r"field 'gps_hpos\[1\]' at 10\.02 s: -2 is below 0"):
        read_innovations(flight(own, np.array([[1.0, 1.0], [1.0, -2.0], [1.0, 1.0]])).write(path))
    with pytest.raises(InputError, match="holds no innovation with a variance; nothing was fused"):
        read_innovations(flight(own, 0.0 * variance).write(path))
    back = flight(own, variance)
    back.both(10**6, {"gps_hpos": (own[0], variance[0])})
    with pytest.raises(InputError, match="message 4 of estimator_innovations is older than the one before"):
        read_innovations(back.write(path))
    with mock.patch.dict(sys.modules, {"pyulog": None}), pytest.raises(InputError, match="needs pyulog: pip install "):
        read_innovations(path)


OLD = {"vel_pos_innov": 6, "mag_innov": 3, "heading_innov": 1, "flow_innov": 2}  # of ekf2_innovations, PX4 v1.9


def old_flight(path, own, variance):
    """The message of older firmware: (N, 12) innovations and their variances, as its definition orders them."""
    fields = [f"{name}{end}" for end in ("", "_var") for name in OLD]
    sizes = [*OLD.values(), *OLD.values()]
    names = "".join(f"float{f'[{n}]' if n > 1 else ''} {name};" for name, n in zip(fields, sizes, strict=True))
    out = [header(), message("F", f"ekf2_innovations:uint64_t timestamp;{names}".encode())]
    out.append(message("A", struct.pack("<BH", 0, 0) + b"ekf2_innovations"))
    for k, row in enumerate(np.hstack([own, variance]).astype("<f4")):
        out.append(message("D", struct.pack("<HQ", 0, 10**7 + k * STEP) + row.tobytes()))
    path.write_bytes(b"".join(out))
    return path


def test_the_older_message_holds_innovations_and_variances(path):
    """Six of velocity and position are three sensors, as they are fused at different times: GPS, and the barometer."""
    own, variance = draws(n=12)
    held = own.copy()
    held[1::2, 5], still = held[::2, 5], variance.copy()
    still[1::2, 5] = still[::2, 5]  # the height comes half as often
    old_flight(path, held, still)
    ratio = (held**2 / still).astype(float)
    columns = {"vel": [0, 1, 2], "hpos": [3, 4], "mag": [6, 7, 8], "heading": [9], "flow": [10, 11], "mag[1]": [7]}
    for sensor, places in columns.items():
        log = read_innovations(path, sensor)
        assert_allclose(log.nis, ratio[:, places].sum(axis=1), rtol=1e-5)
        assert (log.dof == len(places)).all()
    height = read_innovations(path, "vpos")
    assert_allclose(height.nis[::2], ratio[::2, 5], rtol=1e-5)
    assert np.isnan(height.nis[1::2]).all()
    with pytest.raises(InputError, match=r"more than one sensor \(vel, hpos, vpos, mag, heading, …\)"):
        read_innovations(path)


# --- what is fused -------------------------------------------------------------------------------------


def flag(log, stamp, instance=0, late=100, **flags):
    """The flags of the EKF2 as they are after the data of ``stamp``, us, published ``late`` us later."""
    stamps = {"timestamp": ("Q", stamp + late), "timestamp_sample": ("Q", stamp)}
    fields = {name: ("B", value) for name, value in flags.items()}
    log.other("estimator_status_flags", stamps | fields, instance)


@pytest.mark.parametrize(
    "sensor, size, flags",
    [
        ("gps_hpos", 2, {"cs_gps": 1}),
        ("gps_hpos", 2, {"cs_gnss_pos": 1}),
        ("gps_vpos", 1, {"cs_gps_hgt": 1}),
        ("baro_vpos", 1, {"cs_baro_hgt": 1}),
        ("mag_field", 3, {"cs_mag_3d": 1, "cs_mag": 0}),
        ("mag_field", 3, {"cs_mag_3d": 0, "cs_mag": 1}),
    ],
)
def test_what_is_not_fused_by_its_flag_does_not_count(path, sensor, size, flags):
    """The flags are logged as they change; between two messages those before hold, before the first one the first."""
    own, variance = draws(steps=20, n=size)
    own[:5] = -1e6
    log = flight(own, variance, sensor)
    none = dict.fromkeys(flags, 0)
    for k, values in ((2, none), (5, flags), (12, none), (17, flags)):
        flag(log, 10**7 + k * STEP, **values)
    found = read_innovations(log.write(path))
    idle = np.isin(np.arange(20), [0, 1, 2, 3, 4, 12, 13, 14, 15, 16])
    assert (found.dof == np.where(idle, 0, size)).all()
    assert_allclose(found.nis[~idle], (own**2 / variance).sum(axis=1)[~idle], rtol=1e-5)
    assert f"10 messages do not count, as the EKF2 did not fuse the sensor ({', '.join(flags)} 0)" in found.notes[-1]


def test_flags_of_others_change_nothing(path):
    own, variance = draws(steps=6)
    log = flight(own, variance)
    flag(log, 10**7, cs_opt_flow=0, cs_gps_hgt=0)
    flag(log, 10**7, instance=1, cs_opt_flow=0, cs_gps_hgt=0)
    found = read_innovations(log.write(path))
    assert (found.dof == 2).all()
    assert len(found.notes) == 1


def test_flags_are_those_of_the_same_instance(path):
    own, variance = draws(steps=6)
    log = Flight()
    for k in range(6):
        for instance in (0, 1):
            log.both(10**7 + k * STEP, {"gps_hpos": (own[k], variance[k])}, instance)
    flag(log, 10**7, instance=1, cs_gps=1)
    flag(log, 10**7, instance=0, cs_gps=0)
    log.write(path)
    assert (read_innovations(path, run=1).dof == 2).all()
    with pytest.raises(InputError, match=r"a\.ulg: holds no innovation with a variance; nothing was fused"):
        read_innovations(path, run=0)


def test_a_sensor_that_no_flag_ever_fuses_is_refused(path):
    log = Flight()
    for k in range(6):
        log.both(10**7 + k * STEP, {"gps_hpos": ((1.0, k), (1.0, 1.0)), "baro_vpos": (k, 1.0)})
    flag(log, 10**7, cs_gps=0, cs_baro_hgt=1)
    with pytest.raises(InputError, match=r"--filter gps_hpos: is never fused in .*; there are: baro_vpos"):
        read_innovations(log.write(path), "gps_hpos")
    assert read_innovations(path).name == "baro_vpos"


@pytest.mark.parametrize("bit, sensor", [(2, "gps_hpos"), (11, "gps_vpos"), (9, "baro_vpos"), (5, "mag_field")])
def test_bits_of_the_status_stand_for_flags(path, bit, sensor):
    log = Flight(sample=False)
    for k in range(8):
        log.both(10**7 + k * STEP, {sensor: (1.0 + k, 4.0)})
        mode = 1 << bit if k >= 3 else 0xFFFFFFFF ^ (1 << bit)
        log.other("estimator_status", {"timestamp": ("Q", 10**7 + k * STEP + 40), "control_mode_flags": ("I", mode)})
    found = read_innovations(log.write(path), sensor)
    assert (np.isnan(found.nis) == (np.arange(8) < 3)).all()
    assert "3 messages do not count" in found.notes[-1]


@pytest.mark.parametrize("clock", [0, 7])
def test_one_message_needs_no_partner_though_its_clock_stands_still(path, clock):
    """As in the sample log of pyulog, whose 682 messages were one."""
    own, variance = draws(steps=300, n=1)
    log = Flight()
    for y, S in zip(own[:, 0], variance[:, 0], strict=True):
        fields = {"timestamp": ("Q", clock), "hagl_innov": ("f", y), "hagl_innov_var": ("f", S)}
        log.other("ekf2_innovations", fields)
    log.other("estimator_status", {"timestamp": ("Q", 5), "control_mode_flags": ("I", 0)})
    found = read_innovations(log.write(path))
    assert_allclose(found.nis, own[:, 0] ** 2 / variance[:, 0], rtol=1e-5)
    assert np.isnan(found.t).all()
    assert not any("partner" in note for note in found.notes)
    assert watch(found, make_monitor("optimal", false_alarm=1e-5)).alarm is None


def test_two_topics_whose_clock_stands_still_have_no_partners(path):
    log = Flight()
    for k in range(5):
        log.both(0, {"gps_hpos": ((1.0, k), (1.0, 1.0))})
    with pytest.raises(InputError, match=r"a\.ulg: the timestamps of estimator_innovations are all 0 s"):
        read_innovations(log.write(path))


def test_a_flight_that_is_to_be_analysed_is_sent_to_the_monitor(path):
    with pytest.raises(InputError, match=r"a\.ulg: unknown kind of file; .*consistency monitor"):
        read_recordings(flight(*draws(steps=3)).write(path))


def test_one_command_from_a_flight_to_a_picture(tmp_path, capsys):
    """False-alarm rate 1e-3 of the mission is the tool's; here the innovations are their own quantiles."""
    values = np.sqrt(stats.chi2.ppf((np.arange(200) * 77 % 200 + 0.5) / 200, 1))[:, None]
    path = flight(values, np.ones((200, 1)), "baro_vpos").write(tmp_path / "a.ulg")
    out, err = consistency(capsys, "monitor", path, "--innovations", "optimal", "--plot", tmp_path / "a.png")
    assert "baro_vpos" in out
    assert "no alarm" in out
    assert "200 innovations in 200 messages" in err
    assert (tmp_path / "a.png").stat().st_size > 10_000
