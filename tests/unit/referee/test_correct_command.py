"""consistency correct: files in and out in the kind that they came in, lines for other programs, bad input."""

import json
import re
import runpy
import sys
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from command import consistency, refused
from scipy.spatial.transform import Rotation

from consistency.commands import main
from consistency.referee.diagnostics.groups import Groups
from consistency.referee.fit_covariance.fit_files import place_in, toml

pytestmark = pytest.mark.usefixtures("without_hints")
RUNS, DRIVES, STEPS = 24, 8, 20


def shown_ratio(text):
    """Ratio and interval of a table of ``analyse``."""
    return re.findall(r"\d+\.\d+ \[[^\]]*\]", text)[0]


def write_tables(folder, rng, runs=RUNS, factor=9.0, rho=0.3):
    """A table of estimates whose positions err by ``factor`` more than stated, and the truth."""
    folder.mkdir(parents=True, exist_ok=True)
    own = ["run,step,x,y,heading,P_xx,P_xy,P_xh,P_yy,P_yh,P_hh,satellites"]
    true = ["run,step,x,y,heading"]
    for run in range(1, runs + 1):
        w = rng.normal(size=3)
        for step in range(1, STEPS + 1):
            w = rho * w + np.sqrt(1 - rho**2) * rng.normal(size=3)
            size = 0.1 * rng.uniform(0.8, 1.25)
            error = w * [size * factor**0.5, size * factor**0.5, 0.01]
            pose = np.array([0.1 * step, 0.0, 0.01 * step])
            numbers = [*(pose - error), size**2, 0.0, 0.0, size**2, 0.0, 1e-4]
            own.append(f"{run},{step},{','.join(map(repr, map(float, numbers)))},{rng.integers(4, 12)}")
            true.append(f"{run},{step},{','.join(map(repr, map(float, pose)))}")
    paths = folder / "est.csv", folder / "truth.csv"
    for path, lines in zip(paths, (own, true), strict=True):
        path.write_text("\n".join(lines) + "\n")
    return paths


def write_trajectories(folder, rng, columns=36, apart=False, turned=False):
    """TUM trajectories whose positions err by 3 sigma of what is stated, in folders est, truth and, apart, P."""
    for name in ("est", "truth", "P"):
        (folder / name).mkdir(parents=True)
    sigma = np.array([0.1, 0.1, 0.2, 0.01, 0.02, 0.01])
    P = np.diag(sigma**2)
    P[0, 1] = P[1, 0] = 0.004
    P[2, 5] = P[5, 2] = 0.001
    L = np.linalg.cholesky(P)
    order = [3, 4, 5, 0, 1, 2] if turned else [0, 1, 2, 3, 4, 5]
    for run in range(DRIVES):
        t = 0.1 * np.arange(STEPS)
        e = (rng.normal(size=(STEPS, 6)) @ L.T) * [3, 3, 3, 1, 1, 1]
        true = np.column_stack([t, np.zeros_like(t), np.zeros_like(t)])
        turn = Rotation.from_rotvec(np.outer(t, [0.1, 0.2, 0.3]))
        own = Rotation.from_rotvec(-e[:, 3:]) * turn
        stated = np.diag(P)[None] ** 0.5
        if columns != 6:
            Q = P[np.ix_(order, order)]
            stated = (Q if columns == 36 else Q[np.triu_indices(6)]).reshape(1, -1)
        numbers = np.repeat(stated, STEPS, axis=0)
        beside = [numbers] if not apart else []
        np.savetxt(
            folder / f"est/run{run:02d}.txt", np.column_stack([t, true - e[:, :3], own.as_quat(), *beside]), "%.12g"
        )
        np.savetxt(folder / f"truth/run{run:02d}.txt", np.column_stack([t, true, turn.as_quat()]), "%.12g")
        if apart:
            np.savetxt(folder / f"P/run{run:02d}.txt", np.column_stack([t, numbers]), "%.12g")
    return folder / "est"


def loaded(path):
    module = ModuleType(path.stem)
    exec(compile(path.read_text(), str(path), "exec"), module.__dict__)
    return module


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    return write_tables(tmp_path_factory.mktemp("tables"), np.random.default_rng(1))


@pytest.fixture(scope="module")
def written(tables, tmp_path_factory, without_hints):
    """The folder of a correction, and what was printed."""
    folder = tmp_path_factory.mktemp("correction") / "c"
    words = ["correct", tables[0], "--truth", tables[1], "--out", folder]
    with pytest.raises(SystemExit) as end, redirect_stdout(StringIO()) as out:
        main([*map(str, words)])
    assert not end.value.code
    return folder, out.getvalue()


def test_a_table_comes_back_with_other_covariances_alone(written, tables):
    folder, _ = written
    factors = {"P_xx": 9.0, "P_yy": 9.0, "P_hh": 1.0}
    for name in ("held-out", "corrected"):
        before, after = (path.read_text().splitlines() for path in (tables[0], folder / name / "est.csv"))
        assert before[0] == after[0]
        assert len(before) == len(after)
        for line, other in zip(before[1:], after[1:], strict=True):
            old, new = (dict(zip(before[0].split(","), text.split(","), strict=True)) for text in (line, other))
            for column, value in old.items():
                if column in factors:
                    assert float(new[column]) / float(value) == pytest.approx(factors[column], rel=0.6)
                elif not column.startswith("P_"):
                    assert new[column] == value


def test_analyse_says_of_held_out_what_was_printed_and_that_corrected_runs_were_fitted(written, tables, capsys):
    folder, printed = written
    out, _ = consistency(capsys, "analyse", folder / "held-out/est.csv", "--truth", tables[1])
    assert f"{shown_ratio(out)} after" in printed
    before, err = consistency(capsys, "analyse", *tables[:1], "--truth", tables[1])
    assert f"{shown_ratio(before)} before" in printed
    assert "fitted to these runs" not in err
    _, err = consistency(capsys, "analyse", folder / "corrected/est.csv", "--truth", tables[1])
    assert "fitted to these runs" in err
    assert str(folder / "held-out") in err


@pytest.mark.parametrize(
    "columns, apart, turned", [(36, False, False), (21, False, True), (36, True, True), (6, False, False)]
)
def test_trajectories_come_back_as_trajectories(columns, apart, turned, tmp_path, capsys):
    estimates = write_trajectories(tmp_path, np.random.default_rng(columns), columns, apart, turned)
    options = ["--truth", tmp_path / "truth", "--error", "so3"]
    if turned:
        options += ["--covariance-order", "rotation-translation"]
    own = [*options, "--covariance", tmp_path / "P"] if apart else options
    out = tmp_path / "c"
    printed, _ = consistency(capsys, "correct", estimates, *own, "--out", out)
    words = (estimates, *options, "--covariance", out / "held-out") if apart else (out / "held-out", *options)
    said, _ = consistency(capsys, "analyse", *words)
    if columns != 6:
        assert f"{shown_ratio(said)} after" in printed
    data = json.loads((out / "verdict.json").read_text())
    factors = {block["name"]: block["factor"] for block in data["blocks"]}
    assert factors["position"] == pytest.approx(9.0, rel=0.3)
    assert factors["attitude"] == pytest.approx(1.0, rel=0.3)
    name = "run03.txt"
    before = np.loadtxt((tmp_path / "P" if apart else estimates) / name)
    after = np.loadtxt(out / "corrected" / name)
    first = 1 if apart else 8
    assert (after[:, :first] == before[:, :first]).all()
    place = first + ({36: 21, 21: 15}[columns] if turned else 0)
    of_sigma = 0.5 if columns == 6 else 1.0
    assert after[0, place] / before[0, place] == pytest.approx(factors["position"] ** of_sigma, rel=1e-9)


def matrix_of(folder, P):
    """D P D + F by the numbers of a correction of x, y, heading."""
    blocks = {b["name"]: b for b in json.loads((folder / "verdict.json").read_text())["blocks"]}
    factor, floor = ([blocks["position"][key]] * 2 + [blocks["attitude"][key]] for key in ("factor", "floor"))
    return np.asarray(P * np.sqrt(np.outer(factor, factor)) + np.diag(floor))


P3 = np.array([[0.02, 0.001, 0.0002], [0.001, 0.03, 0.0001], [0.0002, 0.0001, 0.0004]])


def test_plain_python_and_ros_have_the_same_matrix(written):
    folder, _ = written
    pasted, expected = loaded(folder / "corrected_covariance.py"), matrix_of(folder, P3)
    assert np.array(pasted.corrected(P3.tolist())) == pytest.approx(expected)
    full = np.full((6, 6), 0.001)
    full[np.ix_([0, 1, 5], [0, 1, 5])] = P3
    found = np.reshape(pasted.ros_covariance(full.ravel()), (6, 6))
    assert found[np.ix_([0, 1, 5], [0, 1, 5])] == pytest.approx(expected)
    assert found[2, 0] / 0.001 == pytest.approx((expected[0, 0] / P3[0, 0]) ** 0.5)
    assert found[2:5, 2:5] == pytest.approx(full[2:5, 2:5])


def test_gtsam_takes_the_corrected_covariance(written):
    gtsam = pytest.importorskip("gtsam")
    noise = loaded(written[0] / "corrected_covariance.py").gtsam_noise(P3)
    assert noise.covariance() == pytest.approx(matrix_of(written[0], P3))
    gtsam.PriorFactorPose2(0, gtsam.Pose2(), noise)


def test_gtsam_has_the_rotation_first_in_space(tmp_path, capsys):
    estimates = write_trajectories(tmp_path, np.random.default_rng(3))
    consistency(capsys, "correct", estimates, "--truth", tmp_path / "truth", "--error", "so3", "--out", tmp_path / "c")
    pasted = loaded(tmp_path / "c/corrected_covariance.py")
    blocks = {b["name"]: b["factor"] for b in json.loads((tmp_path / "c/verdict.json").read_text())["blocks"]}
    variances = np.diag(np.array(pasted.corrected(np.eye(6).tolist(), axes=pasted.GTSAM)))
    assert variances == pytest.approx([blocks["attitude"]] * 3 + [blocks["position"]] * 3)


def test_an_inconsistent_correction_is_written_only_anyway(tmp_path, capsys):
    rng = np.random.default_rng(7)
    P = np.broadcast_to(np.eye(2), (40, 30, 2, 2)).copy()
    errors = rng.standard_t(2.1, size=(40, 30, 2))
    np.savez(tmp_path / "heavy.npz", errors=errors, covariances=P, axes=np.array(["x", "y"]))
    words = ("correct", tmp_path / "heavy.npz", "--out", tmp_path / "c")
    out, err = consistency(capsys, *words, status=1)
    assert "no factor mends this: heavy-tailed" in out
    assert "--anyway" in err
    assert not (tmp_path / "c").exists()
    consistency(capsys, *words, "--anyway")
    assert (tmp_path / "c/correction.toml").read_text().startswith("# inconsistent after")
    with np.load(tmp_path / "c/held-out/heavy.npz") as archive:
        assert archive["errors"] == pytest.approx(errors)


def test_a_run_that_failed_is_written_as_failed(tmp_path, capsys):
    errors = np.random.default_rng(8).normal(size=(24, 20, 2))
    errors[3, 7:] = np.nan
    P = np.broadcast_to(np.eye(2), (24, 20, 2, 2)).copy()
    np.savez(tmp_path / "est.npz", errors=errors, covariances=P)
    out, _ = consistency(capsys, "correct", tmp_path / "est.npz", "--out", tmp_path / "c", "--anyway")
    assert "no factor mends this: failed: 1 of 24 runs failed" in out
    said = json.loads(consistency(capsys, "analyse", tmp_path / "c/held-out/est.npz", "--json")[0])
    assert [failure[:2] for failure in said["est"]["statistics"]["failures"]] == [[3, 8]]


def test_an_undecided_correction_is_written_and_marked(tmp_path, capsys):
    estimates, truth = write_tables(tmp_path, np.random.default_rng(2), runs=5)
    out, _ = consistency(capsys, "correct", estimates, "--truth", truth, "--out", tmp_path / "c")
    assert "undecided after" in out
    assert "runs would decide" in out
    assert "factors of 5 runs are uncertain, which adds x1." in out
    assert (tmp_path / "c/correction.toml").read_text().startswith("# undecided after")
    consistency(capsys, "correct", estimates, "--truth", truth, "--fail-on", "inconsistent", status=1)


def test_named_runs_alone_are_held_out(tables, tmp_path, capsys):
    estimates, truth = tables
    consistency(capsys, "correct", estimates, "--truth", truth, "--held-out", "3,7", "--out", tmp_path / "c")
    lines = (tmp_path / "c/held-out/est.csv").read_text().splitlines()[1:]
    assert {line.split(",")[0] for line in lines} == {"3", "7"}
    lines = (tmp_path / "c/corrected/est.csv").read_text().splitlines()[1:]
    assert len({line.split(",")[0] for line in lines}) == RUNS


def test_held_out_has_the_files_of_judged_runs_alone(rng, tmp_path, capsys):
    estimates = write_trajectories(tmp_path / "tum", rng)
    options = ("--truth", tmp_path / "tum/truth", "--held-out", "run01,run06", "--anyway", "--out", tmp_path / "c")
    consistency(capsys, "correct", estimates, *options)
    assert sorted(path.name for path in (tmp_path / "c/held-out").iterdir()) == ["run01.txt", "run06.txt"]
    assert len(list((tmp_path / "c/corrected").iterdir())) == DRIVES


def test_one_log_is_cut_into_pieces(tmp_path, capsys):
    rng = np.random.default_rng(4)
    errors = 2.0 * rng.normal(size=(1, 2000, 2))
    np.savez(tmp_path / "log.npz", errors=errors, covariances=np.broadcast_to(np.eye(2), (1, 2000, 2, 2)).copy())
    assert "one log has no other to judge its factors by" in refused(capsys, "correct", tmp_path / "log.npz")
    out, _ = consistency(capsys, "correct", tmp_path / "log.npz", "--split", "25", "--out", tmp_path / "c")
    assert "25 pieces, each judged by the factors of the others" in out
    few, _ = consistency(capsys, "correct", tmp_path / "log.npz", "--split", "10")
    assert "10 pieces of one log are too few" in few
    said, _ = consistency(capsys, "analyse", tmp_path / "c/held-out/log.npz")
    assert f"{shown_ratio(said)} after" in out


def test_bad_input_is_named_and_nothing_is_written(tables, tmp_path, capsys):
    estimates, truth = tables
    good = ("--truth", truth, "--out", tmp_path / "c")
    assert "--per must be 'axis'" in refused(capsys, "correct", estimates, *good, "--per", "block")
    assert "turns the axes" in refused(capsys, "correct", estimates, *good, "--per", "axis", "--align", "se3")
    assert "no run '99'" in refused(capsys, "correct", estimates, *good, "--held-out", "99")
    assert "declare the one" in refused(capsys, "correct", estimates, *good, "--error", "guess")
    assert not (tmp_path / "c").exists()
    (tmp_path / "c").mkdir()
    assert "exists already" in refused(capsys, "correct", estimates, *good)


def test_a_folder_of_tables_comes_back_as_one(tmp_path, capsys):
    paths = write_tables(tmp_path, np.random.default_rng(6), runs=6)
    for path in paths:
        head, *lines = path.read_text().splitlines()
        path.unlink()
        (tmp_path / path.stem).mkdir()
        for run in range(1, 7):
            own = [line for line in lines if line.startswith(f"{run},")]
            (tmp_path / path.stem / f"drive{run}.csv").write_text("\n".join([head, *own]) + "\n")
    options = ("--truth", tmp_path / "truth")
    out, _ = consistency(capsys, "correct", tmp_path / "est", *options, "--out", tmp_path / "c", "--anyway")
    assert sorted(path.name for path in (tmp_path / "c/held-out").iterdir()) == [
        f"drive{run}.csv" for run in range(1, 7)
    ]
    said, _ = consistency(capsys, "analyse", tmp_path / "c/held-out", *options)
    assert f"{shown_ratio(said)} after" in out
    consistency(capsys, "correct", tmp_path / "est", *options, "--held-out", "drive2,drive5")


def test_two_estimators_are_told_apart(tables, tmp_path, capsys):
    lines = tables[0].read_text().splitlines()
    both = [f"filter,{lines[0]}", *(f"a,{line}" for line in lines[1:]), *(f"b,{line}" for line in lines[1:])]
    (tmp_path / "two.csv").write_text("\n".join(both) + "\n")
    words = ("correct", tmp_path / "two.csv", "--truth", tables[1])
    assert "name one by --filter; there are: a, b" in refused(capsys, *words)
    out, _ = consistency(capsys, *words, "--filter", "b", "--out", tmp_path / "c")
    assert out.startswith("b: ")
    rows = (tmp_path / "c/held-out/two.csv").read_text().splitlines()[1:]
    assert {row.split(",")[0] for row in rows} == {"b"}


def write_grouped(folder, rng, words=False):
    """A table whose covariance is right in half of the steps of each run, and too small by 16 in the others."""
    own, true = ["run,step,a,b,P_a_a,P_a_b,P_b_b,seen"], ["run,step,a,b"]
    for run in range(RUNS):
        for step in range(1, STEPS + 1):
            poor = bool(rng.integers(2))
            a, b = (rng.normal(size=2) * (4.0 if poor else 1.0)).tolist()
            seen = str(rng.uniform(0, 5) if poor else rng.uniform(5, 10))
            if words:
                seen = "tunnel" if poor else "open"
            own.append(f"{run},{step},{a!r},{b!r},1.0,0.0,1.0,{seen}")
            true.append(f"{run},{step},0,0")
    paths = folder / "est.csv", folder / "truth.csv"
    for path, lines in zip(paths, (own, true), strict=True):
        path.write_text("\n".join(lines) + "\n")
    return paths


@pytest.mark.parametrize("words", [False, True])
def test_factors_go_by_group(words, tmp_path, capsys):
    estimates, truth = write_grouped(tmp_path, np.random.default_rng(words), words)
    options = ["--truth", truth, "--state", "a,b", "--by", "seen", *([] if words else ["--bins", "5,"])]
    out, _ = consistency(capsys, "correct", estimates, *options, "--out", tmp_path / "c", "--anyway")
    poor, good = ("seen is tunnel", "seen is open") if words else ("seen <= 5", "seen > 5")
    data = json.loads((tmp_path / "c/verdict.json").read_text())
    factors = {(block["group"], block["name"]): block["factor"] for block in data["blocks"]}
    for name in "ab":
        assert factors[poor, name] == pytest.approx(16.0, rel=0.4)
        assert factors[good, name] == pytest.approx(1.0, rel=0.4)
    said, _ = consistency(capsys, "analyse", tmp_path / "c/held-out/est.csv", *options)
    assert f"{shown_ratio(said)} after" in out
    module = loaded(tmp_path / "c/corrected_covariance.py")
    at = {poor: "tunnel" if words else 2.0, good: "open" if words else 5.1}
    for line in (tmp_path / "c/corrected/est.csv").read_text().splitlines()[1:20]:
        *_, first, _, _, value = line.split(",")
        group = poor if (value == "tunnel" if words else float(value) <= 5) else good
        assert float(first) == pytest.approx(factors[group, "a"])
        assert module.corrected([[1.0, 0.0], [0.0, 1.0]], at[group])[0][0] == pytest.approx(factors[group, "a"])


def test_a_value_on_an_edge_is_below_it():
    numbers = Groups("n", ("n <= 5", "5 < n <= 9", "n > 9"), np.zeros(1, int), (5.0, 9.0))
    assert [place_in(numbers, value) for value in ("5", "5.5", "9.0", "10", "", "nan")] == [0, 1, 1, 2, -1, -1]
    words = Groups("road", ("road is dry", "road is wet"), np.zeros(1, int), None)
    assert [place_in(words, value) for value in ("wet", " dry ", "icy")] == [1, 0, -1]
    assert place_in(None, "7") == -1


def test_factors_by_what_selects_on_the_outcome_are_refused(tables, tmp_path, capsys):
    words = ("correct", tables[0], "--truth", tables[1], "--by", "P_xx", "--out", tmp_path / "c")
    assert "selects on the outcome" in refused(capsys, *words)


def test_standard_deviations_come_back_as_such(tmp_path, rng):
    from consistency.referee.readers.formats.restated import text_files
    from consistency.referee.readers.options import make_reading

    (tmp_path / "s.csv").write_text('t;a;b;sigma_a;sigma_b;"note"\n0;1;2;3;4;"x; y"\n1;1;2;;4;z\n')
    (file,) = text_files(tmp_path / "s.csv", make_reading(state=("a", "b")))
    text = file.restated(lambda run, value: {"a": (4.0, 13.0)})
    assert text.splitlines()[1].split(";")[3:5] == ["7.0", "4.0"]
    assert text.splitlines()[2].split(";")[3:5] == ["", "4.0"]
    assert '"x; y"' in text


def test_lines_come_back_with_other_covariances_alone(tmp_path):
    """Spaces, quotes and ends of lines stay; a run that is left out, or none of the estimator, has no line."""
    from consistency.referee.readers.formats.restated import TextFile

    entries = {2: ("a", "a"), 3: ("a", "b")}
    numbers = TextFile(tmp_path / "a.txt", entries, True, run_column=0)
    (tmp_path / "a.txt").write_text("# t\n 1  0.5   2.0  1.0 \r\n2 0.5 2.0 1.0\n\n")
    text = numbers.restated(lambda run, value: {"a": (4.0, 1.0), "b": (9.0, 0.0)} if run == 1 else None)
    assert text == "# t\n 1  0.5   9.0  6.0 \r\n\n"
    words = TextFile(tmp_path / "a.csv", entries, True, filter_column=0, filter="x, y", by_column=1)
    (tmp_path / "a.csv").write_text('f,road,P,Q\n"x, y", "wet","2.0",\nz,dry,2.0,1.0\n')
    values = []
    text = words.restated(lambda run, value: values.append(value) or {"a": (4.0, 1.0)})
    assert text == 'f,road,P,Q\n"x, y", "wet",9.0,\n'
    assert values == ["wet"]


@pytest.mark.skipif(sys.version_info < (3, 11), reason="tomllib is of Python 3.11")
def test_numbers_tables_and_lists_of_tables_are_toml():
    import tomllib

    values = {
        "name": 'a "b"\nc',
        "none": None,
        "ends": [1.5, None],
        "table": {"x": 1, "inner": {"y": True}},
        "rows": [{"z": 1, "deep": {"w": 2.0}}, {"z": 2}],
        "referee": {"long": 1},
    }
    text = toml("two lines\nof comment", values)
    assert text.startswith("# two lines\n# of comment\n")
    read = tomllib.loads(text)
    assert str(read.pop("ends")) == "[1.5, nan]"
    assert read == {key: values[key] for key in ("name", "table", "rows")}


# --- examples with public data ----------------------------------------------------------------------------------------


def example(name):
    return runpy.run_path(str(Path(__file__).parents[3] / "docs/examples" / name))


def test_positions_by_satellite_are_those_that_the_ranges_have(rng, tmp_path):
    """Exact ranges to satellites give the place and the clock's error, and a covariance in east, north and up."""
    script = example("satellite_positions.py")
    place = np.array([3785108.0, 899901.0, 5037234.0])
    up = place / np.linalg.norm(place)
    away = rng.normal(size=(7, 3)) + 2.0 * up
    satellites = place + 2e7 * away / np.linalg.norm(away, axis=1)[:, None]
    turned = script["TURN"] * (satellites[:, 0] * place[1] - satellites[:, 1] * place[0])
    ranges = np.linalg.norm(satellites - place, axis=1) + turned + 30.0
    x, C = script["position_of"](np.column_stack([ranges, np.full(7, 4.0), satellites]), place + 100.0)
    assert x == pytest.approx([*place, 30.0], abs=1e-4)
    assert (np.linalg.eigvalsh(C) > 0).all()
    lines = [f"pseudorange3 0 {r} 4 {s[0]} {s[1]} {s[2]}" for r, s in zip(ranges, satellites, strict=True)]
    (tmp_path / "Berlin_Potsdamer_Platz_Input.txt").write_text("\n".join(lines))
    (tmp_path / "Berlin_Potsdamer_Platz_GT.txt").write_text(f"point3 0 {place[0]} {place[1]} {place[2]}")
    assert script["rows_of"](tmp_path / "Berlin_Potsdamer_Platz_Input.txt", "pseudorange3").shape == (7, 6)
    east, north, vertical = script["local_axes"](place)
    assert vertical @ up > 0.999
    assert np.cross(east, north) == pytest.approx(vertical)


def test_a_filter_between_beacons_is_told_where_it_is():
    script = example("radio_beacons.py")
    x, P = np.array([0.3, -0.2, 0.0]), np.eye(3)
    for beacon in ([5.0, 0.0], [0.0, 5.0], [-5.0, 0.0], [0.0, -5.0]) * 5:
        x, P = script["update"](x, P, 5.0, 1e-4, np.array(beacon))
    assert x[:2] == pytest.approx([0.0, 0.0], abs=0.01)
    x, P = script["predict"](x, P, [1.0, 1.0, 0.0, 0.1, 0.01, 0.01], 2.0)
    assert x == pytest.approx([2.0, 0.0, 0.0], abs=0.02)


@pytest.mark.parametrize("name", ["satellite_positions.py", "radio_beacons.py"])
def test_a_folder_without_the_data_is_named(name, tmp_path):
    with pytest.raises(SystemExit, match="no such file; DIR must be the folder datasets/"):
        example(name)["main"](tmp_path)
