"""consistency correct of estimates that state no covariance: the variances that are found, judged on other runs."""

import json
import re

import numpy as np
import pytest
from command import consistency, refused
from scipy.spatial.transform import Rotation

import consistency as cs

RUNS, STEPS = 24, 20
SIGMA = {"x": 0.02, "y": 0.05, "z": 0.1, "roll": 0.01, "pitch": 0.02, "yaw": 0.01}
SIGMAS = np.array(list(SIGMA.values()))


def write_trajectories(folder, rng, covariance=None):
    """TUM trajectories without covariances, or with the same one in every line, and their truth."""
    for name in ("est", "truth"):
        (folder / name).mkdir()
    for run in range(RUNS):
        t = 0.1 * np.arange(STEPS)
        e = SIGMAS * rng.normal(size=(STEPS, 6))
        true = np.column_stack([t, np.sin(t + run), 0.1 * t])
        turn = Rotation.from_rotvec(np.outer(t, [0.1, 0.2, 0.3]))
        own = Rotation.from_rotvec(-e[:, 3:]) * turn
        beside = [] if covariance is None else [np.tile(np.ravel(covariance), (STEPS, 1))]
        np.savetxt(folder / f"est/r{run:02d}.txt", np.column_stack([t, true - e[:, :3], own.as_quat(), *beside]))
        np.savetxt(folder / f"truth/r{run:02d}.txt", np.column_stack([t, true, turn.as_quat()]))
    return folder / "est", ["--truth", folder / "truth"]


def write_table(folder, rng, columns="", cells="", sigmas=(0.2, 0.05), runs=RUNS, steps=STEPS, factor=None):
    """A table of two states by run and step, whose further columns hold the same cells in every line."""
    own, true = [f"run,step,a,b,kind{columns}"], ["run,step,a,b"]
    for run in range(1, runs + 1):
        for step in range(1, steps + 1):
            kind = "light" if (run + step) % 2 else "dark"
            e = np.array(sigmas) * rng.normal(size=2) * ((factor or 1.0) if kind == "dark" else 1.0)
            own.append(f"{run},{step},{step - e[0]!r},{run - e[1]!r},{kind}{cells}".replace("np.float64", ""))
            true.append(f"{run},{step},{step},{run}")
    for name, lines in (("est", own), ("truth", true)):
        (folder / f"{name}.csv").write_text("\n".join(lines).replace("(", "").replace(")", "") + "\n")
    return folder / "est.csv", ["--truth", folder / "truth.csv", "--state", "a,b"]


def corrected(capsys, folder, path, options, *words):
    """What ``correct`` prints and writes as data, and the sigma of each component."""
    out, err = consistency(capsys, "correct", path, *options, *words, "--out", folder / "c")
    data = json.loads((folder / "c/verdict.json").read_text())
    return out, err, data, {block["name"]: np.sqrt(block["factor"]) for block in data["blocks"]}


def test_poses_without_a_covariance_get_a_variance_for_each_axis(tmp_path, capsys):
    """480 steps: sigmas are known to 3 %, and 15 % is reached by chance less than once in 1e5."""
    path, options = write_trajectories(tmp_path, np.random.default_rng(1))
    out, err, data, sigmas = corrected(capsys, tmp_path, path, options)
    assert "est: consistent after: none was stated" in out
    assert "states no covariance" in err
    assert data["assumed"]
    for axis, sigma in SIGMA.items():
        assert sigmas[axis] == pytest.approx(sigma, rel=0.15)
    assert re.search(r"y +0\.00\d+ \[.*\] +0\.0[45]\d* m \[", out)
    assert re.search(r"yaw .* rad \[", out)
    assert "log score" not in out
    assert "stated " not in out.split("held-out  ", 1)[1].split("\n")[0]
    line = np.array((tmp_path / "c/corrected/r03.txt").read_text().splitlines()[4].split(), float)
    assert line[:8] == pytest.approx(np.loadtxt(path / "r03.txt")[4])
    assert line[8:].reshape(6, 6) == pytest.approx(np.diag([sigmas[axis] ** 2 for axis in SIGMA]))
    of_held_out = np.loadtxt(tmp_path / "c/held-out/r03.txt")[0, 8:]
    assert of_held_out[0] != line[8]  # by the other runs
    assert of_held_out[0] == pytest.approx(line[8], rel=0.1)
    said, _ = consistency(capsys, "analyse", tmp_path / "c/held-out", *options)
    assert re.findall(r"\d\.\d+ \[[^\]]*\]", said)[0] in out
    assert "held-out is consistent" in said


@pytest.mark.parametrize("covariance", [np.zeros((6, 6)), np.zeros(6), 0.01 * np.eye(6)])
def test_zeros_and_one_number_for_metres_and_radians_state_nothing(covariance, tmp_path, capsys):
    path, options = write_trajectories(tmp_path, np.random.default_rng(2), covariance)
    _, _, data, sigmas = corrected(capsys, tmp_path, path, options)
    assert (data["assumed"], data["status"]) == (True, "consistent")
    assert sigmas["z"] == pytest.approx(0.1, rel=0.15)
    line = np.loadtxt(tmp_path / "c/corrected/r00.txt")[0]
    assert line[8] == pytest.approx(sigmas["x"] ** (2 if covariance.ndim == 2 else 1))
    assert len(line) == 8 + covariance.size


def test_another_covariance_is_stated(tmp_path, capsys):
    path, options = write_trajectories(tmp_path, np.random.default_rng(3), np.diag(SIGMAS**2))
    _, _, data, sigmas = corrected(capsys, tmp_path, path, options)
    assert not data["assumed"]
    assert set(sigmas) == {"position", "attitude"}
    assert sigmas["position"] == pytest.approx(1.0, rel=0.1)
    errors = np.random.default_rng(3).normal(size=(RUNS, STEPS, 2))
    of_one = cs.correct(errors, np.broadcast_to(np.eye(2), (RUNS, STEPS, 2, 2)), axes=["x", "y"])
    assert not of_one.assumed  # 1 is a number like others where all units are alike
    assert len(of_one.blocks) == 1


@pytest.mark.parametrize("columns, cells", [("", ""), (",P_a_a,P_a_b,P_b_b", ",0,0,0"), (",sigma_a,sigma_b", ",0,0")])
def test_tables_without_a_covariance(columns, cells, tmp_path, capsys):
    path, options = write_table(tmp_path, np.random.default_rng(4), columns, cells)
    _, _, data, sigmas = corrected(capsys, tmp_path, path, options)
    assert (data["assumed"], data["status"]) == (True, "consistent")
    assert [sigmas[axis] for axis in "ab"] == pytest.approx([0.2, 0.05], rel=0.15)
    head, line = (tmp_path / "c/corrected/est.csv").read_text().splitlines()[:2]
    assert head == f"run,step,a,b,kind{columns or ',P_a_a,P_a_b,P_b_b'}"
    numbers = [float(cell) for cell in line.split(",")[5:]]
    stated = [sigmas["a"], sigmas["b"]] if "sigma" in columns else [sigmas["a"] ** 2, 0.0, sigmas["b"] ** 2]
    assert numbers == pytest.approx(stated)
    said, _ = consistency(capsys, "analyse", tmp_path / "c/held-out/est.csv", *options)
    assert "est is consistent" in said


def test_rows_are_runs_and_each_is_judged_by_the_others(tmp_path, capsys):
    rng = np.random.default_rng(5)
    errors = np.array([0.2, 0.05]) * rng.normal(size=(60, 2))
    names = [f"{k:03d}.jpg" for k in rng.permutation(60)]
    own = [f"{name},{-a!r},{1 - b!r}" for name, (a, b) in zip(names, errors.tolist(), strict=True)]
    (tmp_path / "est.csv").write_text("\n".join(["image,a,b", *own]) + "\n")
    (tmp_path / "truth.csv").write_text("\n".join(["image,a,b", *(f"{name},0,1" for name in sorted(names))]) + "\n")
    options = ["--truth", tmp_path / "truth.csv", "--state", "a,b"]
    for words, unit in ((["--independent"], "rows"), ([], "runs")):
        out, _, _, sigmas = corrected(capsys, tmp_path, tmp_path / "est.csv", options, *words, "--overwrite")
        assert f"60 {unit}, each judged by the factors of the others" in out
        squares = np.square(errors).sum(axis=0)
        assert [sigmas[axis] for axis in "ab"] == pytest.approx(np.sqrt(squares / 60))
        with np.load(tmp_path / "c/held-out/est.npz") as archive:
            held_out = dict(archive)
        expected = (squares - np.square(held_out["errors"][:, 0])) / 59
        assert np.diagonal(held_out["covariances"][:, 0], axis1=1, axis2=2) == pytest.approx(expected)
        assert (tmp_path / "c/corrected/est.csv").read_text().startswith("image,a,b,P_a_a,P_a_b,P_b_b\n")
        assert len({line.split(",", 3)[3] for line in (tmp_path / "c/corrected/est.csv").read_text().split()[1:]}) == 1


def test_variances_go_by_group(tmp_path, capsys):
    path, options = write_table(tmp_path, np.random.default_rng(6), factor=4.0)
    _, _, data, _ = corrected(capsys, tmp_path, path, options, "--by", "kind")
    sigma = {(each["group"], each["name"]): np.sqrt(each["factor"]) for each in data["blocks"]}
    assert sigma["kind is dark", "a"] == pytest.approx(0.8, rel=0.2)
    assert sigma["kind is light", "b"] == pytest.approx(0.05, rel=0.2)
    lines = (tmp_path / "c/corrected/est.csv").read_text().splitlines()[1:]
    for kind in ("dark", "light"):
        (variance,) = {line.split(",")[5] for line in lines if f",{kind}," in line}
        assert float(variance) == pytest.approx(sigma[f"kind is {kind}", "a"] ** 2)


def test_one_covariance_for_two_kinds_of_errors_is_not_called_right(tmp_path, capsys):
    path, options = write_table(tmp_path, np.random.default_rng(7), factor=6.0)
    out, err = consistency(capsys, "correct", path, *options, "--independent", "--out", tmp_path / "c", status=1)
    assert "inconsistent after: none was stated" in out
    assert "no factor mends this" in out
    assert not (tmp_path / "c").exists()
    assert "--anyway" in err


def test_a_broken_estimate_stays_a_failure(tmp_path, capsys):
    path, options = write_table(tmp_path, np.random.default_rng(8))
    lines = path.read_text().splitlines()
    cells = lines[50].split(",")
    lines[50] = ",".join([*cells[:2], "nan", *cells[3:]])
    path.write_text("\n".join(lines) + "\n")
    out, _ = consistency(capsys, "correct", path, *options)
    assert "inconsistent after: none was stated" in out
    assert "1 of 24 runs failed" in out


def test_errors_in_memory_and_archives(tmp_path, capsys):
    errors = np.array([0.02, 0.3]) * np.random.default_rng(9).normal(size=(200, 2))
    found = cs.correct(errors, axes=["x", "v"], independent=True)
    assert (found.assumed, found.unit, found.status) == (True, "row", "consistent")
    assert found.fit.factors.factor == pytest.approx(np.square(errors).mean(axis=0))
    assert "none was stated" in repr(found)
    np.savez(tmp_path / "e.npz", errors=errors, axes=["x", "v"])
    np.savez(tmp_path / "p.npz", estimates=-errors, truth=np.zeros((200, 2)), axes=["x", "v"])
    for name in ("e", "p"):
        out, _ = consistency(capsys, "correct", tmp_path / f"{name}.npz", "--independent")
        assert f"ratio of the one found {found.after.ratio.value:.2f} [" in out
    assert "needs errors and covariances" in refused(capsys, "analyse", tmp_path / "e.npz")


def test_others_send_here(tmp_path, capsys):
    path, options = write_trajectories(tmp_path, np.random.default_rng(10))
    assert "'consistency correct' finds one" in refused(capsys, "analyse", path, *options)
    sent = refused(capsys, "fit-covariance", path, *options, "--span", "1")
    assert "'consistency correct' with --independent finds the covariance" in sent
    assert "--independent" in refused(capsys, "correct", path / "r00.txt", "--truth", tmp_path / "truth/r00.txt")


def test_one_diagonal_covariance_of_the_wrong_shape_is_told_of_a_factor_an_axis():
    errors = np.array([1.0, 1.0, 9.0]) * np.random.default_rng(11).normal(size=(40, 20, 3))
    P = np.broadcast_to(np.diag([1.0, 4.0, 9.0]), (40, 20, 3, 3))
    from consistency.referee.fit_covariance.correct import correction_lines

    lines = " ".join(correction_lines(cs.correct(errors, P, axes=["x", "y", "z"])))
    assert "--per axis finds a variance for each component" in lines
    alike = errors + errors[..., ::-1]  # which no factor mends
    by_axis = cs.correct(alike, P, axes=["x", "y", "z"], per_axis=True)
    assert by_axis.status == "inconsistent"
    assert "--per axis" not in " ".join(correction_lines(by_axis))
