"""Files as people have them: other names of columns, truth beside the estimates, other kinds, and chains of frames."""

import itertools
import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from command import refused
from numpy.testing import assert_allclose, assert_array_equal
from recorded import notes_of, read_recordings
from scipy.io import savemat
from scipy.spatial.transform import Rotation

import consistency as cs
from consistency.testing import assert_consistent

STEPS = 7
POSE = ("x", "y", "heading")


def matrices(n):
    root = np.random.default_rng().normal(size=(STEPS, n, n))
    return root @ np.swapaxes(root, 1, 2) + np.eye(n)


class Data:
    """Errors with covariances of n components, and clocks."""

    def __init__(self, axes):
        rng, n = np.random.default_rng(), len(axes)
        self.axes, self.P = axes, matrices(n)
        self.error, self.truth = 0.1 * rng.normal(size=(STEPS, n)), rng.normal(size=(STEPS, n))
        self.t, self.step = 1.0 + 0.1 * np.arange(STEPS), np.arange(1, STEPS + 1)
        self.state = None if axes == POSE else list(axes)

    def table(self, names=(), own="{}"):
        values = self.truth - self.error
        columns = {own.format(axis): values[:, i] for i, axis in enumerate(self.axes)}
        return pd.DataFrame(columns | dict(names))

    def true(self, spelling="{}"):
        return pd.DataFrame({spelling.format(axis): self.truth[:, i] for i, axis in enumerate(self.axes)})

    def stated(self, spelling, words):
        n = len(words)
        pairs = itertools.combinations_with_replacement(range(n), 2)
        return {spelling.format(words[i], words[j]): self.P[:, i, j] for i, j in pairs}

    def read(self, columns):
        """The record of est.csv, with these columns among the others in any order, and truth.csv, both by step."""
        est = write("est.csv", self.table(columns).sample(frac=1, axis=1), step=self.step)
        return cs.read(est, truth=write("truth.csv", self.true(), step=self.step), state=self.state)


def write(path, table, **columns):
    table.assign(**columns).to_csv(path, index=False)
    return Path(path)


def check(record, data):
    assert_allclose(record.errors.error[0], data.error, atol=1e-9)
    assert_allclose(np.asarray(record.errors.covariance[0]), data.P, rtol=1e-9)


CLOCKS = {
    "time": lambda t: {"time": t},
    "timestamp": lambda t: {"timestamp": t},
    "stamp": lambda t: {"Stamp": t},
    "header": lambda t: {"header.stamp": t},
    "unit": lambda t: {"time [ms]": 1e3 * t},
    "suffix": lambda t: {"t_us": 1e6 * t},
    "halves": lambda t: {"sec": np.floor(t), "nsec": np.round(1e9 * (t - np.floor(t)))},
    "since 1970": lambda t: {"timestamp": 1e9 * (1.7e9 + t)},
}


@pytest.mark.parametrize("clock", CLOCKS)
@pytest.mark.parametrize("axes", [POSE, ("a", "b")])
def test_a_time_by_another_name_is_t(clock, axes, inside):
    data = Data(axes)
    names = CLOCKS[clock](data.t)
    est = write("est.csv", data.table(data.stated("P_{}_{}", axes)), **names)
    record = cs.read(est, truth=write("truth.csv", data.true(), **names), state=data.state)
    check(record, data)
    start = 1.7e9 if clock == "since 1970" else 0.0
    assert_allclose(record.runs.t, start + data.t, atol=1e-6)
    if clock == "time":  # beside t in the other file, and in memory
        check(cs.read(est, truth=write("truth.csv", data.true(), t=data.t), state=data.state), data)
        check(cs.read(pd.read_csv(est), truth=pd.read_csv("truth.csv"), state=data.state), data)
    assert len(list(inside.iterdir())) == 2


def test_beside_steps_a_time_is_not_looked_at(inside):
    data = Data(("a", "b"))
    table = data.table(data.stated("P_{}_{}", data.axes)).assign(step=data.step)
    est = write("est.csv", table, time="at noon")
    truth = write("truth.csv", data.true(), step=data.step, time=data.t + 5)
    record = cs.read(est, truth=truth, state=data.state)
    check(record, data)
    assert np.isnan(record.runs.t).all()
    with pytest.raises(cs.InputError, match=r"est\.csv, line 2: column 'time': not a number \(at noon\)"):
        cs.read(est, truth=truth, state=data.state, max_dt=0.1)
    write("est.csv", table, time=data.t)
    check(cs.read(est, truth=write("truth.csv", data.true(), time=data.t + 5), state=data.state, time_offset=5.0), data)


def test_the_monitor_knows_a_time(inside):
    from consistency.referee.readers.formats.innovation_files import read_nis

    table = pd.DataFrame({"timestamp": [3.0, 2.0, 4.0], "nis": 1.0, "nis_dof": 1})
    log = read_nis(write("nis.csv", table))
    assert log.t.tolist() == [3.0, 2.0, 4.0]  # shown; the order is that of the file, as before
    assert np.isnan(read_nis(write("nis.csv", table, timestamp="noon")).t).all()


NAMES = [
    ("P{}{}", "123"), ("P_{}{}", "123"), ("P_{}_{}", "123"), ("P[{}][{}]", "012"), ("p{}{}", "own"),
    ("P{}_{}", "own"), ("cov_{}_{}", "own"), ("cov_{}{}", "own"), ("cov{}{} [m^2]", "own"),
]  # fmt: skip


@pytest.mark.parametrize("spelling, words", NAMES)
@pytest.mark.parametrize("axes", [POSE, ("a", "b", "c")])
def test_a_covariance_by_other_names(spelling, words, axes, inside):
    data = Data(axes)
    record = data.read(data.stated(spelling, axes if words == "own" else tuple(words)))
    check(record, data)
    assert any(note.startswith("est.csv: read ") and " as P_" in note for note in record.origin.notes)


@pytest.mark.parametrize("spelling", ["cov_{}{}", "P_{}{}"])
@pytest.mark.parametrize("word", ["theta", "th", "t", "yaw", "psi", "h"])
def test_words_for_the_heading(spelling, word, inside):
    data = Data(POSE)
    stated = data.stated(spelling, ("x", "y", word))
    own, true = data.table(stated), data.true()
    heading = word if word in ("theta", "yaw", "psi") else "theta"
    est = write("est.csv", own.rename(columns={"heading": heading}), time=data.t)
    check(cs.read(est, truth=write("truth.csv", true.rename(columns={"heading": "yaw"}), stamp=data.t)), data)


def test_a_lower_triangle_by_another_name_has_to_agree(inside):
    data = Data(("a", "b"))
    upper = data.stated("P{}{}", ("1", "2"))
    check(data.read(upper | {"P21": data.P[:, 1, 0]}), data)
    with pytest.raises(cs.InputError, match="line 2: the covariance is not symmetric"):
        data.read(upper | {"P21": data.P[:, 1, 0] + 1})


def test_of_eleven_components_the_numbers_are_apart(inside):
    data, words = Data(tuple("abcdefghijk")), tuple(map(str, range(1, 12)))
    check(data.read(data.stated("P_{}_{}", words)), data)
    with pytest.raises(cs.InputError, match="column 'P_a_a' is missing"):
        data.read(data.stated("P{}{}", words))  # P111 is that of 1 and 11


@pytest.mark.parametrize(
    "spelling", ["var_{}", "{}_var", "variance_{}", "sd_{}", "{}_sd", "{}_std", "{}_sigma", "sd{}"]
)
@pytest.mark.parametrize("axes", [POSE, ("a", "b")])
def test_variances_and_deviations_by_other_names(spelling, axes, inside):
    data = Data(axes)
    variance = np.diagonal(data.P, axis1=1, axis2=2)
    words = ("x", "y", "theta") if axes == POSE else axes
    values = variance if "var" in spelling else np.sqrt(variance)
    record = data.read({spelling.format(word): values[:, i] for i, word in enumerate(words)})
    assert record.errors.parts == tuple((i,) for i in range(len(axes)))
    assert_allclose(record.errors.nees[0], (data.error**2 / variance).sum(axis=1), rtol=1e-9)


def test_names_that_were_read_before_are_read_so(inside):
    data = Data(POSE)
    canonical = data.stated("P_{}{}", ("x", "y", "h"))
    check(data.read(canonical | {f"P{i}{j}": 1.0 for i, j in itertools.product("123", repeat=2)}), data)
    deviations = {f"sigma_{axis}": 1.0 for axis in POSE} | {f"var_{axis}": 9.0 for axis in POSE}
    assert_allclose(data.read(deviations).errors.nees[0], (data.error**2).sum(axis=1), rtol=1e-9)
    check(data.read(canonical | {"x_est": 9.0, "theta": 9.0}), data)
    canonical.pop("P_xh")
    with pytest.raises(cs.InputError, match=r"column 'P_xh' is missing; .*state=a,b judges fewer"):
        data.read(canonical)


# --- truth beside the estimates ----------------------------------------------------------------------


@pytest.mark.parametrize("own, true", [
    ("{}", "true_{}"), ("{}_est", "{}_true"), ("{}_hat", "gt_{}"), ("est_{}", "{}_gt"), ("{}", "truth_{}"),
    ("{}_est", "{}_truth"),
])  # fmt: skip
def test_truth_and_estimate_in_one_table(own, true, inside):
    data = Data(POSE)
    table = data.table(data.stated("P_{}{}", ("x", "y", "h")), own).join(data.true(true))
    est = write("est.csv", table.rename(columns=lambda name: name.replace("heading", "theta")), time=data.t)
    check(cs.read(est), data)
    check(cs.read(pd.read_csv(est)), data)
    state = Data(("a", "b"))
    table = state.table(state.stated("P{}{}", ("1", "2")), own).join(state.true(true))
    record = cs.read(write("est.csv", table, step=state.step), state=state.state, error="vector")
    check(record, state)
    assert "est.csv: the truth stands in columns beside the estimates" in record.origin.notes


def in_space(data, stated, true, own="{}"):
    """A table of poses without turns, their truth beside them."""
    names = ["x", "y", "z", "qx", "qy", "qz", "qw"]
    still = pd.DataFrame({f"q{axis}": np.full(STEPS, float(axis == "w")) for axis in "xyzw"})
    sides = [pd.DataFrame(values[:, :3], columns=names[:3]).join(still)
             for values in (data.truth - data.error, data.truth)]  # fmt: skip
    return pd.concat([side.rename(columns=spelling.format) for side, spelling in zip(sides, (own, true), strict=True)]
                     + [pd.DataFrame(stated)], axis=1)  # fmt: skip


@pytest.mark.parametrize("own, true, folder", [("{}", "{}_gt", False), ("{}_est", "true_{}", True)])
def test_truth_beside_poses_in_space(own, true, folder, inside):
    data = Data(("x", "y", "z", "1", "2", "3"))
    table = in_space(data, data.stated("P{}{}", tuple("123456")), true, own).assign(t=data.t)
    table.loc[2, true.format("y")] = np.nan
    Path("est").mkdir()
    est = write("est/one.csv", table)
    record = cs.read("est" if folder else est)
    assert_allclose(record.errors.error[0, :, :3], np.delete(data.error[:, :3], 2, axis=0), atol=1e-9)
    assert "1 of 7 estimates have no truth" in notes_of(record)
    assert any(note.endswith("the truth stands in columns beside the estimates") for note in record.origin.notes)
    other = write("truth.csv", data.true().iloc[:, :3], t=data.t, qx=0.0, qy=0.0, qz=0.0, qw=1.0)
    assert_allclose(cs.read(est, truth=other).errors.error[0, :, :3], data.error[:, :3], atol=1e-9)


@pytest.mark.parametrize("spelling", ["var_{}", "{}_var", "sd_{}", "{}_sd"])
def test_variances_and_deviations_of_poses_in_space(spelling, inside):
    data, words = Data(("x", "y", "z", "1", "2", "3")), ("x", "y", "z", "roll", "pitch", "yaw")
    stated = {spelling.format(word): np.full(STEPS, 4.0) for word in words}
    record = cs.read(write("est.csv", in_space(data, stated, "true_{}"), t=data.t), axes=words)
    variance = 4.0 if "var" in spelling else 16.0
    assert_allclose(np.asarray(record.errors.covariance)[0, 3], variance * np.eye(6))
    assert record.errors.parts == tuple((i,) for i in range(6))
    other = {f"var_{word}": 9.0 for word in words} | {f"sd_{word}": np.full(STEPS, 2.0) for word in words}
    both = cs.read(write("est.csv", in_space(data, other, "true_{}"), t=data.t), axes=words)  # as in the plane
    assert_allclose(np.asarray(both.errors.covariance)[0, 3], 4.0 * np.eye(6))


def test_rows_without_a_truth_beside_them_do_not_count(inside):
    data = Data(("a", "b"))
    table = data.table(data.stated("P_{}_{}", data.axes)).join(data.true("true_{}")).assign(step=data.step)
    table.loc[3, "true_b"] = np.nan
    two = pd.concat([table.assign(filter="one"), table.assign(filter="two", true_a=table["true_a"] + 1.0)])
    one, two_ = read_recordings(write("est.csv", two), state=data.state)
    expected = np.delete(data.error, 3, axis=0)
    assert_allclose(one.errors.error[0], expected, atol=1e-9)
    assert_allclose(two_.errors.error[0], expected + np.array([1.0, 0.0]), atol=1e-9)
    other = write("truth.csv", data.true() + 2.0, step=data.step)  # a truth that is named counts
    assert_allclose(cs.read("est.csv", other, state=data.state, filter="one").errors.error[0], data.error + 2.0)
    with pytest.raises(cs.InputError, match="column 'true_b' is missing"):
        cs.read(write("est.csv", table.drop(columns="true_b")), state=data.state)


def test_motions_beside_their_truth_are_drives(inside):
    from consistency.referee.fit_covariance.drives import read_drives

    data = Data(POSE)
    [drive] = read_drives(write("est.csv", data.table().join(data.true("true_{}")), t=data.t))
    assert_allclose(drive.truth[:, :2, 2], data.truth[:, :2])
    assert_allclose(drive.estimate[:, :2, 2], (data.truth - data.error)[:, :2])


# --- other kinds -------------------------------------------------------------------------------------

UNKNOWN = {
    "orbit.oem": ("CCSDS_OEM_VERS = 2.0\nMETA_START\n", "COV_REF_FRAME"),
    "orbit.txt": ("CCSDS_OEM_VERS = 2.0\nMETA_START\n", "COV_REF_FRAME"),
    "gnss_log_1.txt": ("# \n# Header Description:\n# \n# Raw,utcTimeMillis\n# Fix,Provider\nFix,GPS,1\n", "Android"),
    "gga.nmea": ("$GPGGA,1\n", "NMEA"),
    "e.h5": ("\x89HDF", "h5py"),
    "e.bin": ("", "'consistency monitor'"),
    "e.npy": ("", "load it"),
    "e.json": ("{}", "jsonl"),
    "e.xlsx": ("", "save the sheet as .csv"),
    "e.dat": ("a b\n", "rename text to .csv"),
    "e.abc": ("", ""),
}


@pytest.mark.parametrize("name", UNKNOWN)
def test_an_unknown_kind_is_refused_with_the_way_in(name, inside, capsys):
    content, hint = UNKNOWN[name]
    Path(name).write_text(content)
    line = "numpy.savez('{}.npz', {})".format(Path(name).stem, "errors=truth - estimates, covariances=P")
    for words in (["analyse", name], ["analyse", name, "--truth", name]):
        said = refused(capsys, *words)
        assert f"{name}: unknown kind of file; known are .csv" in said
        assert hint in said
        assert line in said
    fit = refused(capsys, "fit-covariance", name, "--truth", name, "--span", "1m", "--out", "out")
    assert "numpy.savez" in fit
    assert "estimates=poses" in fit
    if name != "e.bin":
        assert "nis=nis, nis_dof=dof" in refused(capsys, "monitor", name, "--innovations", "optimal")


def test_a_truth_of_an_unknown_kind(inside, capsys):
    np.savetxt("est.txt", np.column_stack([np.arange(3), np.zeros((3, 6)), np.ones(3)]))
    Path("truth.txt").write_text(UNKNOWN["gnss_log_1.txt"][0])
    said = refused(capsys, "analyse", "est.txt", "--truth", "truth.txt")
    assert re.search(r"truth\.txt: unknown kind of file; .*Android", said)


def arrays(n=2):
    rng = np.random.default_rng()
    root = rng.normal(size=(4, 5, n, n))
    P = root @ np.swapaxes(root, -1, -2) + np.eye(n)
    dof = {"nis": rng.chisquare(2, (4, 5)), "nis_dof": np.array([1, 2, 3, 2, 1]) + np.zeros((4, 5), int)}
    return {"errors": rng.normal(size=(4, 5, n)), "covariances": P, "t": np.arange(5.0), **dof}


@pytest.mark.parametrize("n", [1, 2, 3])
def test_files_of_matlab_are_archives(n, inside):
    given = arrays(n)
    flat = {key: each[..., 0] if n == 1 and key == "errors" else each for key, each in given.items()}
    flat["covariances"] = given["covariances"][..., 0, 0] if n == 1 else given["covariances"]  # as MATLAB has it
    names = np.array([f"axis {i}" for i in range(n)], object)
    savemat("est.mat", flat | {"axes": names, "lengths": np.array([5, 4, 5, 3])})
    np.savez("est.npz", **given, axes=[*names], lengths=[5, 4, 5, 3])
    own, npz = cs.read("est.mat"), cs.read("est.npz")
    for value, key in (
        ("errors", "error"), ("errors", "covariance"), ("errors", "nees"), ("innovations", "nis"),
        ("innovations", "nis_dof"), ("runs", "t"),
    ):  # fmt: skip
        assert_array_equal(getattr(getattr(own, value), key), getattr(getattr(npz, value), key))
    assert own.errors.axes == npz.errors.axes
    from consistency.referee.readers.formats.innovation_files import read_nis

    assert_array_equal(read_nis(Path("est.mat"), run=1).nis, read_nis(Path("est.npz"), run=1).nis)


def test_what_a_file_of_matlab_may_hold(inside):
    rng = np.random.default_rng()
    nees = rng.chisquare(3, (6, 4))
    savemat("nees.mat", {"nees": nees, "dof": 3.0, "mask": (nees > 100).astype("uint8")})
    record = cs.read("nees.mat")
    assert_array_equal(record.errors.nees, nees)
    assert record.errors.dof == 3
    savemat("one.mat", {"errors": np.ones((6, 1)), "covariances": np.ones((6, 1))})  # six runs, or six steps?
    with pytest.raises(cs.InputError, match=r"'covariances' has shape \(6, 1\): one run of one component has \(1, st"):
        cs.read("one.mat")
    savemat("one.mat", {"errors": np.ones((1, 6)), "covariances": np.ones((1, 6))})
    assert cs.read("one.mat").errors.error.shape == (1, 6, 1)
    Path("new.mat").write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64" + bytes(600))
    with pytest.raises(cs.InputError, match=r"new\.mat: is of MATLAB 7\.3; write it with save\(\.\.\., '-v7'\)"):
        cs.read("new.mat")


def lines(path, rows):
    Path(path).write_text("\n".join(map(json.dumps, rows)) + "\n")
    return Path(path)


@pytest.mark.parametrize("suffix", [".jsonl", ".ndjson"])
def test_json_lines_are_a_table(suffix, inside):
    data = Data(POSE)
    own = (data.truth - data.error).tolist()
    rows = [
        {"time": t, "x": x, "y": y, "yaw": h, "P": P, "note": "a", "filter": "mine"}
        for t, (x, y, h), P in zip(data.t.tolist(), own, data.P.tolist(), strict=True)
    ]
    true = [dict(zip(("stamp", *POSE), row, strict=True)) for row in np.column_stack([data.t, data.truth]).tolist()]
    record = cs.read(lines(f"est{suffix}", rows), truth=lines(f"truth{suffix}", true))
    check(record, data)
    assert record.name == "mine"
    del rows[4]["x"]
    [failure] = cs.read(lines(f"est{suffix}", rows), truth=f"truth{suffix}").failures
    assert (failure.step, failure.reason) == (5, f"estimate is not finite (est{suffix}, line 5)")


@pytest.mark.parametrize(
    "text, said",
    [
        ('{"a": 1\n', r"line 1 is not valid JSON"),
        ('{"a": 1, "a": 2}\n', r"line 1 is not valid JSON \(key 'a' is given twice"),
        ("[1, 2]\n", r"line 1: must be an object"),
        ('{"a.b": 1, "a": {"b": 2}}\n', r"line 1: must be an object, and no key a\.b beside b within a"),
        ('\n{"class": "TPV", "lat": 1.0}\n', r"line 2: is a report of gpsd, whose epx, epy and epv are of unknown"),
        ('{"t": true, "x": 1, "y": 2, "heading": 0}\n', r"column 't': a truth value or a date"),
        ("# nothing\n", r"holds no row"),
    ],
)
def test_json_lines_that_are_refused(text, said, inside):
    Path("est.jsonl").write_text(text)
    lines("truth.jsonl", [{"t": 0.0, "x": 0.0, "y": 0.0, "heading": 0.0}])
    with pytest.raises(cs.InputError, match=said):
        cs.read("est.jsonl", truth="truth.jsonl")


# --- NEES of a state that grows ----------------------------------------------------------------------


def test_nees_with_degrees_of_freedom_by_step(inside):
    """A right filter of 3 to 11 components is found at fault in 0.1 % of tests."""
    dof = 3 + 2 * np.minimum(np.arange(60) // 10, 4)
    nees = np.random.default_rng().chisquare(np.broadcast_to(dof, (50, 60)))
    verdict = assert_consistent(nees=nees, dof=dof)
    assert verdict.status == "consistent"
    assert verdict.scale is not None
    assert_allclose(verdict.scale.anees, 3.0 * (nees / dof).mean(axis=0))
    for shape in ((50, 60), (60,)):
        np.savez("nees.npz", nees=nees, dof=np.broadcast_to(dof, shape))
        record = cs.read("nees.npz")
        assert record.errors.dof == 3
        assert_allclose(record.errors.nees, 3.0 * nees / dof)
    assert any("its distribution is not judged" in text for text in cs.judge(record).reasons)
    with pytest.raises(AssertionError, match=r"overconfident: covariance too small by x1\.[45678]"):
        assert_consistent(nees=1.6 * nees, dof=dof)
    for bad in (dof - 3, dof + 0.5, dof[:-1]):
        with pytest.raises(ValueError, match="dof must be"):
            assert_consistent(nees=nees, dof=bad)
    whole = assert_consistent(nees=np.random.default_rng().chisquare(4, (50, 60)), dof=np.full(60, 4))
    assert "distribution" in {answer.question for answer in whole.answers}  # of one number it is judged, as before


# --- messages ----------------------------------------------------------------------------------------


def test_times_in_messages_have_all_their_digits(inside):
    pose = "0 0 0 0 0 0 1"
    Path("est.tum").write_text(f"1326030980.51 {pose}\n1326030980.53 {pose}\n1326030980.53 {pose}\n")
    with pytest.raises(cs.InputError, match=r"timestamp 1326030980\.53 is duplicated"):
        cs.read("est.tum", truth="est.tum")
    table = pd.DataFrame({"t": ["1326030980.5312", "1326030980.5312"], "a": 1.0, "P_a_a": 1.0})
    truth = write("truth.csv", pd.DataFrame({"t": [1.0, 2.0], "a": 1.0}))
    with pytest.raises(cs.InputError, match=r"t 1326030980\.5312 is duplicated"):
        cs.read(write("est.csv", table), truth=truth, state=["a"])
    table["t"] = ["1326030980.53", "1326030981.5312"]
    with pytest.raises(cs.InputError, match=r"t is 1326030980\.53 to 1326030981\.5312, but 1 to 2 in truth\.csv"):
        cs.read(write("est.csv", table), truth=truth, state=["a"])


def test_motions_of_stretches_of_other_lengths_are_no_broken_filters(inside):
    rng, sigma = np.random.default_rng(), 0.01
    for name, rows in (("long", 9), ("short", 5)):
        t = np.arange(float(rows))
        true = np.column_stack([t, t, np.zeros((rows, 5)), np.ones(rows)])
        motions = true.copy()
        motions[:, 1] = 1.0
        motions[:, 1:4] += sigma * rng.normal(size=(rows, 3))
        P = np.tile(np.diag(np.full(6, sigma**2)).ravel(), (rows, 1))
        for folder, values in (("est", np.column_stack([motions, P])), ("truth", true)):
            Path(folder).mkdir(exist_ok=True)
            np.savetxt(f"{folder}/{name}.tum", values, fmt="%.17g")
    record = cs.read("est", truth="truth", relative=1, motions=True)
    assert np.isfinite(record.errors.error).all(axis=-1).sum() == 8 + 4
    assert "broke down" not in notes_of(record)


# --- chains of frames --------------------------------------------------------------------------------


def test_a_chain_of_frames_is_composed(tmp_path):
    """map -> odom, at its own rate and off the stamps of odom -> base; base -> mast stands still; arm is apart."""
    pytest.importorskip("rosbags", reason="needs the extra 'ros'")
    from frames import write_frames

    rng = np.random.default_rng()
    slow, fast = 1000.0 + np.arange(0.0, 7.0, 2.0), 999.0 + 0.25 * np.arange(33)
    both = (fast >= slow[0]) & (fast <= slow[-1])
    rate, start, mast = rng.normal(size=3), rng.normal(size=3), Rotation.from_rotvec(rng.normal(size=3))
    odom = [Rotation.from_rotvec(0.1 * rate * t) for t in slow - 1000.0]  # turns evenly: right between its messages
    base = Rotation.from_rotvec(rng.normal(size=(33, 3)))
    at = {"odom": np.outer(slow, start), "base": rng.normal(size=(33, 3)), "mast": rng.normal(size=3)}
    links = [
        ("map", "odom", slow, at["odom"], [each.as_quat() for each in odom]),
        ("odom", "base", fast, at["base"], base.as_quat()),
        ("base", "mast", slow[:1], at["mast"][None], [mast.as_quat()]),
        ("world", "arm", slow, at["odom"], [each.as_quat() for each in odom]),
    ]
    bag = write_frames(tmp_path / "bag", links, fast)
    turned = Rotation.from_rotvec(np.outer(fast - 1000.0, 0.1 * rate))
    expected = np.outer(fast, start) + turned.apply(at["base"] + base.apply(at["mast"]))
    total = turned * base * mast
    expected, total = expected[both], total[both]
    [record] = read_recordings(bag, truth_topic="map:mast")  # the estimates are at the origin
    assert_allclose(record.errors.error[0, :, :3], expected, atol=1e-6)
    assert_allclose(Rotation.from_rotvec(record.errors.error[0, :, 3:]).as_matrix(), total.as_matrix(), atol=1e-9)
    [back] = read_recordings(bag, truth_topic="mast:map")
    assert_allclose(back.errors.error[0, :, :3], -total.inv().apply(expected), atol=1e-6)
    with pytest.raises(
        cs.InputError, match=r"map:arm: is not a transform of /tf; .*base:mast, map:odom, odom:base, world"
    ):
        read_recordings(bag, truth_topic="map:arm")


def test_zeros_are_no_covariance_of_the_truth(tmp_path):
    pytest.importorskip("rosbags", reason="needs the extra 'ros'")
    from frames import write_frames

    t = 1000.0 + np.arange(5.0)
    bag = write_frames(tmp_path / "bag", [], t, odometry=0.0)
    [record] = read_recordings(bag, topic="/pose", truth_topic="/odom")
    assert "covariance of its own" not in notes_of(record)
    with pytest.raises(cs.InputError, match="--truth-covariance columns: the messages of /odom state none"):
        read_recordings(bag, topic="/pose", truth_topic="/odom", truth_covariance="columns")
    stated = write_frames(tmp_path / "other", [], t, odometry=0.1)
    [record] = read_recordings(stated, topic="/pose", truth_topic="/odom")
    assert "the truth states a covariance of its own" in notes_of(record)
