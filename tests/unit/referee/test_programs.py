"""``consistency monte-carlo``: runs of a program, in their folders, and the verdict on what they wrote."""

import fcntl
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from programs import COPY, STEPS, script, write_tables

import consistency as cs
from consistency.commands import main
from consistency.referee.diagnostics.exceedance import runs_to_show
from consistency.referee.diagnostics.number_of_runs import gate_runs
from consistency.referee.errors import InputError
from consistency.referee.programs.process import LARGEST_SEED, Processes, program_of, run_program, seed_of
from consistency.referee.readers.pipeline.program_runs import filled
from consistency.testing import ConsistencyError, InsufficientTrials, assert_program_consistent

pytestmark = pytest.mark.skipif(os.name == "nt", reason="monte-carlo is refused on Windows")
OF_STATE = ("--state", "a,b,c")
FILTER, BRAVE, BOUNDED = (("./filter", "{run}"), ("./brave", "{run}"), ("./bounded", "{run}"))


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with a program and its tables, from which the command is called."""
    write_tables(tmp_path, 70)
    script(tmp_path, COPY)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def consistency(place, capsys):
    """Exit status and output of a command in this process."""

    def called(*words):
        with pytest.raises(SystemExit) as end:
            main([*words])
        return end.value.code or 0, *capsys.readouterr()

    return called


@pytest.fixture
def monte_carlo(consistency):
    """The command for states a, b, c, by default of the program of the place into the folder ``out``."""

    def called(*options, out="out", program=FILTER):
        return consistency("monte-carlo", *OF_STATE, *options, "--out", out, "--", *program)

    return called


def run_files(out, name):
    return sorted(path.parent.name for path in out.glob(f"runs/*/{name}"))


def failures(out):
    """Reason of each failed run of a folder."""
    record = cs.read(out)
    return {failure.run: failure.reason for failure in record.failures}


# --- words and seeds ---------------------------------------------------------------------------------------


def test_seeds_are_different_positive_and_stable():
    seeds = [seed_of(5, run) for run in range(20_000)]
    assert len(set(seeds)) == len(seeds)
    assert min(seeds) >= 1
    assert max(seeds) <= LARGEST_SEED
    assert np.mean(seeds) == pytest.approx(LARGEST_SEED / 2, rel=0.03)  # six standard errors are 2.5 %
    assert [seed_of(0, run) for run in range(3)] == [993546987, 87129705, 1960261598]
    assert len({seed_of(seed, 0) for seed in range(100)}) == 100


def test_only_known_braces_are_replaced():
    values = {"run": "7", "seed": "12", "here": "/a b"}
    assert filled("{run}{seed}-{other} {{run}} {here}/x {input}", values) == "712-{other} {7} /a b/x {input}"


@pytest.mark.parametrize(
    "words, name",
    [
        (["./filter", "sim.py"], "./filter"),
        (["{here}/filter"], "filter"),
        (["/bin/sh"], "sh"),
        (["sh", "-u", "{here}/sim.sh", "{seed}"], "sim.sh"),
        (["sh", "-c", "sim.sh; sim.py"], "sh"),
        (["sh", "tables/0.csv"], "sh"),
    ],
)
def test_a_program_is_called_as_its_user_does(place, words, name):
    script(place, "", "sim.sh")
    assert program_of(words, place).name == name


def test_a_study_of_before_is_called_after_its_file(place, monte_carlo):
    assert monte_carlo("--runs", "3")[0] == 0
    assert cs.read(place / "out").name == "./filter"
    path = place / "out/manifest.json"
    manifest = json.loads(path.read_text())
    del manifest["program"]
    path.write_text(json.dumps(manifest))
    assert cs.read(place / "out").name == "estimates"


def test_words_come_as_they_are(place, monte_carlo):
    script(place, f'{COPY}; shift; printf "%s\\n" "$@" > words', "say")
    odd = ["two words", "{other} {seed", "a\"b'c", "$HOME `ls` *", "ünï→", "", "--flag", "--"]
    status, _, err = monte_carlo("--runs", "2", program=("./say", "{run}", *odd, "{seed}"))
    assert status == 0, err
    assert (place / "out/runs/0001/words").read_text().split("\n")[:-1] == [*odd, str(seed_of(0, 1))]


def test_a_run_has_a_folder_and_an_environment_of_its_own(place, monte_carlo):
    script(place, f"{COPY}; pwd > at; env > env; cat > input; echo seen; echo err >&2", "look")
    words = ("--runs", "2", "--seed", "9", "--jobs", "1")
    assert monte_carlo(*words, program=("./look", "{run}", "{seed}"))[0] == 0
    at = place / "out/runs/0001"
    assert (at / "at").read_text().strip() == str(at)
    env = (at / "env").read_text()
    for line in ("RUN=1", f"SEED={seed_of(9, 1)}", f"OUT={at}", f"HERE={place}", "WORKER=0"):
        assert f"CONSISTENCY_{line}\n" in env
    assert (at / "input").read_text() == ""
    assert (at / "program.log").read_text() == "seen\nerr\n"
    shell = ("sh", "-c", 'pwd; cp $0.csv "$1"/estimates.csv', "{run}", "{out}")
    assert monte_carlo("--runs", "2", "--cwd", "tables", out="out2", program=shell)[0] == 0
    assert (place / "out2/runs/0000/program.log").read_text() == f"{place}/tables\n"


@pytest.mark.parametrize(
    "words, message",
    [
        (["./nothing", "{seed}"], "./nothing: no such program"),
        (["nothing-of-this-name"], "nothing-of-this-name: no such command"),
        (["filter", "{seed}"], "write ./filter for the file that is here"),
        (["./tables", "{seed}"], "./tables: is a folder"),
        (["tables/0.csv"], "cannot be executed; make it so with chmod +x"),
    ],
)
def test_a_program_that_is_none_is_refused_before_any_folder(words, message, place, monte_carlo):
    status, out, err = monte_carlo(program=words)
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert message in err
    assert not (place / "out").exists()


@pytest.mark.parametrize(
    "options, message",
    [
        (["--runs", "0"], "--runs must be at least 1"),
        (["--jobs", "0"], "--jobs must be at least 1"),
        (["--timeout", "-1"], "--timeout must be a positive number"),
        (["--runs", "3", "--until-decided"], "give --max-runs instead of --runs"),
        (["--max-runs", "3"], "--max-runs goes with --until-decided"),
        (["--each", "tables/*", "--runs", "3"], "do not go with --each"),
        (["--each", "nowhere/*"], "no file or folder is called so"),
        (["--error", "guess"], "consistency analyse DIR"),
        (["--keep", "none"], "--keep must be"),
        (["--resume", "--overwrite"], "give one of them"),
        (["--cwd", "nowhere"], "no such folder"),
        (["--seed", "-1"], "--seed must be 0 or more"),
        (["--estimates", "{here}/one.csv"], "is one file for all runs; let the program write into {out}"),
        (["--truth", "{here}/none.csv"], "none.csv is not there"),
        (["--each", "tables/1?.csv", "--truth", "t/{name}.csv"], "t/10.csv is not there (nor are 9 others)"),
        (["--junit", "a.txt"], "must end in .xml"),
        (["--report", "tables/0.csv"], "exists already"),
    ],
)
def test_options_that_do_not_go_together(options, message, place, monte_carlo):
    status, _, err = monte_carlo(*options)
    assert status == 2
    assert message in err
    assert not (place / "out").exists()


@pytest.mark.parametrize("part", ["{input}", "{name}"])
def test_a_recorded_file_needs_its_option(part, place, monte_carlo, consistency):
    status, _, err = monte_carlo(program=("./filter", f"--log={part}.csv"))
    assert (status, f"{part} in the command needs --each" in err) == (2, True)
    (place / "out").mkdir()  # an empty folder is taken
    _, _, err = consistency("monte-carlo", "--out", "out", "--", *FILTER)
    assert "as its covariance P_* says" in err


def test_windows_is_refused_in_one_line(place, monkeypatch, monte_carlo):
    monkeypatch.setattr("consistency.referee.programs.study.IS_WINDOWS", True)
    status, _, err = monte_carlo()
    assert (status, err.count("\n"), (place / "out").exists()) == (2, 1, False)
    assert "on Windows run it in WSL" in err


def test_a_relative_path_is_pointed_out(place, monte_carlo):
    (place / "ekf.yaml").touch()
    words = (*FILTER, "--config=ekf.yaml", "{here}/ekf.yaml")
    _, _, err = monte_carlo("--runs", "2", program=words)
    assert err.count("ekf.yaml is not seen from the run's folder; write {here}/ekf.yaml") == 1


# --- verdicts ----------------------------------------------------------------------------------------------


def test_a_right_program_is_consistent_and_a_bold_one_is_not(place, monte_carlo, consistency):
    """With the number of runs that the plan gives for three components; false alarm 1e-6."""
    judged = ("--false-alarm", "0.000001", "--detect", "2", "--fail-on", "inconsistent", "--json")
    status, out, err = monte_carlo(*judged)
    assert status == 0, err
    (verdict,) = json.loads(out).values()
    runs = 1 + max(int(name) for name in run_files(place / "out", "run.json"))
    planned = json.loads(consistency("plan", "--detect", "2", "--false-alarm", "0.000001", "--json")[1])
    assert verdict["status"] == "consistent"
    assert runs == planned["runs"]
    write_tables(place, 70, 4.0, "bold")
    script(place, COPY.replace("tables", "bold"), "brave")
    options = (*judged, "--junit", "j.xml", "--report", "r.md", "--overwrite")
    status, out, _ = monte_carlo(*options, program=BRAVE)
    (verdict,) = json.loads(out).values()
    assert (status, verdict["status"]) == (1, "overconfident")
    assert '<testcase classname="./brave" name="./brave">\n<failure' in (place / "j.xml").read_text()
    assert "overconfident" in (place / "r.md").read_text()
    assert monte_carlo(*options, program=BRAVE)[0] == 1  # replaces all of them


def test_the_folder_is_read_by_other_commands(place, monte_carlo, consistency):
    assert monte_carlo("--runs", "40")[0] == 0
    before = monte_carlo("--runs", "40", "--json", out="two")[1]
    assert consistency("analyse", "out", "--json")[1] == before
    skipped = monte_carlo("--runs", "40", "--skip", "1", "--detect", "3", "--json", out="skipped")[1]
    assert consistency("analyse", "skipped", "--json")[1] == skipped != before
    assert consistency("baseline", "out", "--out", "base.json")[0] == 0
    status, out, _ = consistency("compare", "two", "base.json")
    assert status == 0
    assert "40 of 40 runs have the same seed and truth in both" in out
    assert "run by run" in out
    planned = json.loads(consistency("plan", "--like", "out", "--json")[1])
    assert planned["like"]["./filter"]["pilot_runs"] == 40
    assert consistency("report", "out", "--html", "r.html")[0] == 0
    assert "./filter is " in (place / "r.html").read_text()


def test_runs_of_other_seeds_are_compared_as_independent(place, monte_carlo, consistency):
    for seed, out in (("0", "old"), ("1", "other")):
        assert monte_carlo("--runs", "20", "--seed", seed, out=out)[0] == 0
    write_tables(place, 70, 1.0, "shifted")
    for run in range(12, 70):  # the same seeds with another truth
        table = place / f"tables/{run}.csv"
        lines = table.read_text().splitlines()
        cells = lines[1].split(",")
        cells[4] = str(float(cells[4]) + 0.25)
        table.write_text("\n".join([lines[0], ",".join(cells), *lines[2:]]) + "\n")
    assert monte_carlo("--runs", "20", out="new")[0] == 0
    out = consistency("compare", "other", "old")[1]
    assert "as independent samples" in out
    assert "0 of 20 runs have the same seed and truth" in out
    out = consistency("compare", "new", "old")[1]
    assert "12 runs, run by run on the same trials" in out
    assert "12 of 20 runs have the same seed and truth" in out


def test_looks_end_the_runs_and_the_folder_keeps_them(place, monte_carlo, consistency):
    write_tables(place, 70, 9.0, "bold")
    script(place, COPY.replace("tables", "bold"), "brave")
    said = {}
    for jobs in ("1", "2"):
        options = ("--until-decided", "--jobs", jobs, "--json")
        status, said[jobs], err = monte_carlo(*options, out=f"of{jobs}", program=BRAVE)
        assert status == 0
        assert "12 runs: ./brave overconfident" in err
    assert said["1"] == said["2"]
    assert len(run_files(place / "of1", "run.json")) == 12
    assert len(list((place / "of2/runs").iterdir())) == len(run_files(place / "of2", "run.json"))
    assert consistency("analyse", "of2", "--json")[1] == said["2"]
    assert "undecided" in monte_carlo("--until-decided", "--max-runs", "5", out="few")[1]
    assert len(run_files(place / "few", "run.json")) == 5


def test_looks_need_whole_covariances(place, monte_carlo):
    script(place, 'cut -d, -f1-8,11,13 "$CONSISTENCY_HERE/tables/$1.csv" > estimates.csv')  # variances alone
    status, _, err = monte_carlo("--until-decided", "--overwrite")
    assert (status, "--until-decided: ./filter has bounds, members, components" in err) == (2, True)
    assert monte_carlo("--runs", "12", "--overwrite")[0] == 0


def test_one_run_for_each_recorded_file(place, monte_carlo, consistency):
    copied = ("cp", "{input}", "estimates.csv")
    status, out, _ = monte_carlo("--each", "tables/1?.csv", program=copied)
    assert status == 0
    assert "0 of 10" in out
    run = json.loads((place / "out/runs/0003/run.json").read_text())
    assert (run["values"]["name"], run["values"]["input"]) == ("13", str(place / "tables/13.csv"))
    (place / "truth").mkdir()
    (place / "est").mkdir()
    for run_number in range(10, 20):
        rows = [line.split(",") for line in (place / f"tables/{run_number}.csv").read_text().splitlines()]
        truth = [[row[0], *row[4:7]] for row in rows]
        truth[0] = ["step", "a", "b", "c"]
        own = [[row[0], *row[1:4], *row[7:]] for row in rows]
        for at, lines in (("truth", truth), ("est", own)):
            text = "".join(f"{','.join(line)}\n" for line in lines)
            (place / at / f"{run_number}.csv").write_text(text)
    options = ("--each", "est/*", "--truth", "truth/{name}.csv", "--json")
    status, out, err = monte_carlo(*options, out="two", program=copied)
    assert status == 0, err
    beside = json.loads(consistency("analyse", "out", "--json")[1])["cp"]
    assert json.loads(out)["cp"]["reasons"] == beside["reasons"]
    folder = consistency("analyse", "est", "--truth", "truth", *OF_STATE, "--json")[1]
    assert json.loads(folder)["est"]["reasons"] == beside["reasons"]


def test_one_truth_for_all_runs_stands_where_the_user_does(place, monte_carlo):
    rows = [line.split(",") for line in (place / "tables/0.csv").read_text().splitlines()]
    (place / "truth.csv").write_text("step,a,b,c\n" + "".join(f"{r[0]},0,0,0\n" for r in rows[1:]))
    words = ("--runs", "4", "--overwrite")
    status, _, err = monte_carlo("--truth", "truth.csv", *words)
    assert status == 2
    assert "write --truth {here}/truth.csv" in err
    assert monte_carlo("--truth", "{here}/truth.csv", *words)[0] == 0
    assert cs.read(place / "out").errors.error.shape == (4, STEPS, 3)


# --- runs that fail ----------------------------------------------------------------------------------------

FAULTS = """
case $1 in
  3) echo no inverse >&2; exit 3;;
  4) kill -SEGV $$;;
  6) exit 0;;
  7) head -c 220 "$CONSISTENCY_HERE/tables/7.csv" > estimates.csv; exit 0;;
  8) sed '3s/,[^,]*/,nan/' "$CONSISTENCY_HERE/tables/8.csv" > estimates.csv; exit 0;;
  9) rm -rf "$CONSISTENCY_OUT"; exit 0;;
  10) sleep 61 & echo $! > "$CONSISTENCY_HERE/child";;
  11) echo step > estimates.csv; exit 0;;
esac
"""


def test_each_failed_run_is_named_and_counted(place, monte_carlo):
    script(place, FAULTS + COPY)
    words = ("--runs", "20", "--fail-on", "inconsistent")
    status, out, err = monte_carlo(*words)
    assert status == 1
    assert "7 of 20 runs failed" in out
    expected = f"1 run failed (3): it ended with status 3; log out/runs/0003/program.log, seed {seed_of(0, 3)}"
    assert expected in err.replace(f"{place}/", "")
    expected = {
        3: "it ended with status 3; its log ends: no inverse",
        4: "it was killed by SIGSEGV",
        6: "the program wrote no estimates.csv (--estimates), and nothing else",
        7: "estimates.csv: its last line is cut short",
        8: "estimate is not finite",
        9: "the program deleted its folder",
        11: "estimates.csv: ",
    }
    found = failures(place / "out")
    assert found.keys() == expected.keys()
    for run, reason in expected.items():
        assert found[run].startswith(reason)
    assert len(run_files(place / "out", "run.json")) == 20
    with pytest.raises(ProcessLookupError):
        _wait_for_the_end(int((place / "child").read_text()))


def test_a_run_that_hangs_is_killed_with_its_children(place):
    script(place, "trap '' TERM INT HUP; sleep 60 & echo $! > child; wait")
    program, values = program_of(["./filter"], place), {"run": "0", "seed": "1", "out": str(place / "run")}
    done = run_program(program, place / "run", 0, values, 1.0, Processes())
    assert done.failure == "it was killed after 1 s (--timeout)"
    child = place / "run/child"
    if child.exists():  # a busy machine may not have come so far
        with pytest.raises(ProcessLookupError):
            _wait_for_the_end(int(child.read_text()))


def _wait_for_the_end(process):
    """Raise ProcessLookupError when a process is gone or nobody has taken its status."""
    for _ in range(200):
        os.kill(process, 0)
        state = Path(f"/proc/{process}/stat")
        if state.exists() and state.read_text().rpartition(")")[2].split()[0] == "Z":
            raise ProcessLookupError
        time.sleep(0.05)


def test_estimates_that_end_before_their_truth_have_failed(place, monte_carlo):
    text = 'cut -d, -f1,5-7 "$CONSISTENCY_HERE/tables/$1.csv" | sed "s/true_//g" > truth.csv\n'
    text += 'cut -d, -f1-4,8- "$CONSISTENCY_HERE/tables/$1.csv" > all.csv\n'
    script(place, text + "if [ $1 = 4 ]; then head -n 3 all.csv; else cat all.csv; fi > estimates.csv")
    words = ("--runs", "8", "--truth", "truth.csv", "--overwrite")
    monte_carlo(*words)
    assert failures(place / "out") == {4: "its estimates end at 2, its truth at 4"}
    table = np.loadtxt(place / "tables/6.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(cs.read(place / "out").errors.error[6], table[:, 4:7] - table[:, 1:4])  # its own truth
    script(place, text + "head -n 3 all.csv > estimates.csv")  # this is how the program works
    monte_carlo(*words)
    assert failures(place / "out") == {}


def test_a_table_that_ends_before_those_of_most_runs_has_failed(place, monte_carlo):
    script(place, COPY + "\n[ $1 = 4 ] && sed -i '$d' estimates.csv; exit 0")
    words = ("--runs", "8", "--overwrite")
    monte_carlo("--keep", "failed", *words)
    assert failures(place / "out") == {4: "its estimates end at 3, those of most runs at 4"}
    assert "first run 4: its estimates end at 3" in str(cs.judge(cs.read(place / "out")))  # and not in some step
    assert run_files(place / "out", "estimates.csv") == ["0004"]
    script(place, COPY + "\n[ $1 -gt 2 ] && sed -i '$d' estimates.csv; exit 0")  # runs of any length
    monte_carlo(*words)
    assert failures(place / "out") == {}


def test_first_runs_that_fail_alike_end_the_study(place, monte_carlo):
    script(place, "echo libfoo.so not found; exit 127")
    status, out, err = monte_carlo()
    assert (status, out) == (2, "")
    assert "libfoo.so not found" in err
    assert "the first 3 runs failed: it ended with status 127; the log is" in err
    assert len(run_files(place / "out", "run.json")) <= 4
    script(place, "echo libfoo.so not found; [ $1 = 1 ] && kill -TERM $$; exit 1")  # not alike: another one may work
    words = ("--runs", "6", "--jobs", "1", "--overwrite")
    status, _, err = monte_carlo(*words)
    assert status == 2
    assert "the first 6 runs failed: it ended with status 1" in err
    script(place, "[ $(($1 % 2)) = 1 ] && kill -TERM $$; exit 1")
    status, _, err = monte_carlo("--jobs", "1", "--overwrite")
    assert (status, "the first 20 runs failed" in err) == (2, True)


def test_two_runs_with_the_same_table_end_the_study(place, monte_carlo):
    status, _, err = monte_carlo(program=("./filter", "7"))
    assert status == 2
    assert "no word of the command holds {seed}" in err
    assert "runs 0 and 1 wrote the same table; does your program use {seed}?" in err
    assert len(run_files(place / "out", "run.json")) <= 3


def test_a_program_is_said_to_be_reproducible_or_not(place, monte_carlo):
    words = ("--runs", "3", "--check-seed", "--overwrite")
    assert "gave the same table; the program is reproducible" in monte_carlo(*words)[2]
    script(
        place,
        'n=$(ls "$CONSISTENCY_HERE/done" 2>/dev/null | wc -l); mkdir -p "$CONSISTENCY_HERE/done/$n"\nset -- $n\n'
        + COPY,
    )
    assert "gave different tables; the program is not reproducible" in monte_carlo(*words)[2]
    assert sorted(path.name for path in (place / "out/runs").iterdir()) == ["0000", "0001", "0002"]


# --- resuming, replacing, two at once ----------------------------------------------------------------------


def test_missing_runs_are_done_in_new_folders(place, monte_carlo):
    words = ("--runs", "14", "--json")
    before = monte_carlo(*words)[1]
    runs = place / "out/runs"
    for run in (2, 9):
        (runs / f"{run:04d}/run.json").unlink()
    (runs / "0005/run.json").write_text(
        '{"kind": "mine", "run": 5, "values": {}, "failure": "", "seconds": 0}'
    )  # of the program itself
    kept = (runs / "0003/estimates.csv").stat().st_mtime_ns
    assert "add --resume or --overwrite (overwrite=True in Python)" in monte_carlo(*words)[2]
    status, after, _ = monte_carlo("--resume", *words)
    assert (status, after) == (0, before)
    assert (runs / "0003/estimates.csv").stat().st_mtime_ns == kept
    assert run_files(place / "out", "run.json") == sorted(
        [*(f"{run:04d}" for run in range(14) if run not in (2, 9)), "0002-2", "0005-2", "0009-2"]
    )
    assert len(json.loads(monte_carlo("--resume", "--runs", "16", *words[2:])[1])) == 1
    assert len(cs.read(place / "out").run_numbers) == 16


def test_an_unfinished_folder_says_so(place, monte_carlo, consistency):
    monte_carlo("--runs", "14")
    manifest = place / "out/manifest.json"
    manifest.write_text(manifest.read_text().replace('"complete": true', '"complete": false'))
    (place / "out/runs/0002/run.json").unlink()
    status, out, err = consistency("analyse", "out")
    assert status == 0
    assert "0 of 13" in out
    assert "only 13 of 14 runs are there; the same 'consistency monte-carlo' with --resume continues" in err
    assert consistency("analyse", "out", "--fail-on", "inconsistent")[0] == 2


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda place: script(place, COPY + "\n# changed"), "filter has changed since the runs"),
        (lambda place: (place / "gains.txt").write_text("2"), "gains.txt has changed since"),
        (lambda place: {"seed": "4"}, "--seed has changed"),
        (lambda place: {"program": (*FILTER, "x")}, "the words of the command have changed"),
    ],
)
def test_another_study_is_not_resumed(change, message, place, monte_carlo):
    (place / "gains.txt").write_text("1")
    of_study = {"program": (*FILTER, "--gains={here}/gains.txt")}
    monte_carlo("--runs", "3", **of_study)
    changed = change(place)
    if isinstance(changed, dict):
        of_study |= changed
    seed = of_study.pop("seed", "0")
    status, _, err = monte_carlo("--runs", "3", "--seed", seed, "--resume", **of_study)
    assert status == 2
    assert message in err
    assert "use --overwrite" in err


def test_two_at_once_in_one_folder(place, monte_carlo):
    words = ("--runs", "3")
    monte_carlo(*words)
    with (place / "out/.lock").open("w") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        for how in ("--resume", "--overwrite"):
            status, _, err = monte_carlo(how, *words)
            assert status == 2
            assert "another 'consistency monte-carlo' works on it" in err
    assert len(run_files(place / "out", "run.json")) == 3


def test_only_a_folder_of_this_command_is_replaced(place, monte_carlo):
    status, _, err = monte_carlo("--overwrite", out="tables")
    assert status == 2
    assert "is not a folder of 'consistency monte-carlo'" in err
    assert len(list((place / "tables").iterdir())) == 70
    monte_carlo("--runs", "5")
    monte_carlo("--runs", "3", "--overwrite")
    assert len(run_files(place / "out", "run.json")) == 3


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_stopped_study_loses_no_finished_run(number, place, monte_carlo):
    """Of a command that is told to end no program is left; after SIGKILL one may live on."""
    script(
        place,
        f'[ -e "$CONSISTENCY_HERE/go" ] || [ $1 -lt 3 ] || {{ echo $$ > "$CONSISTENCY_HERE/at"; sleep 60; }}\n{COPY}',
    )
    options = ("--runs", "12", "--jobs", "1", "--json")
    words = (*OF_STATE, *options, "--out", "out", "--", *FILTER)
    command = subprocess.Popen([sys.executable, "-m", "consistency", "monte-carlo", *words], stderr=subprocess.PIPE)
    while not (place / "at").exists() or not (place / "at").read_text():
        assert command.poll() is None
        time.sleep(0.02)
    program = int((place / "at").read_text())
    command.send_signal(number)
    said = command.communicate()[1].decode()
    if number == signal.SIGTERM:
        assert command.returncode == 128 + number
        assert "the same command with --resume continues" in said
        with pytest.raises(ProcessLookupError):
            _wait_for_the_end(program)
    else:
        os.killpg(program, signal.SIGKILL)
    assert run_files(place / "out", "run.json") == ["0000", "0001", "0002"]
    (place / "go").touch()
    resumed = monte_carlo("--resume", *options)[1]
    assert resumed == monte_carlo(*options, out="new")[1]
    if number == signal.SIGKILL:  # otherwise the folder of the run that was stopped may be gone
        assert "0003-2" in run_files(place / "out", "run.json")


def test_files_of_sound_runs_are_deleted(place, monte_carlo, consistency):
    script(place, "[ $1 = 3 ] && { echo a; exit 1; }\n" + COPY)
    words = ("--runs", "20", "--json")
    whole = monte_carlo(*words)[1]
    kept = monte_carlo("--keep", "failed", "--overwrite", *words)[1]
    assert kept == whole
    assert run_files(place / "out", "estimates.csv") == []
    assert len(run_files(place / "out", "program.log")) == 20
    assert consistency("analyse", "out", "--json")[1] == whole
    assert monte_carlo("--keep", "failed", "--resume", *words)[1] == whole
    status, _, err = consistency("analyse", "out", "--error", "vector")
    assert status == 2
    assert "--keep failed" in err


# --- other statements --------------------------------------------------------------------------------------


@pytest.fixture
def stated(place):
    """Tables of the runs with bounds of a deviation of 1/2 at 68 %, on a and on b and c, and ten members of a."""
    draws = np.random.default_rng(8)
    (place / "stated").mkdir()
    for run in range(70):
        head, *rows = (place / f"tables/{run}.csv").read_text().splitlines()
        lines = [",".join([head.split(",P_")[0], "bound_a", "radius_b_c", *(f"e{i}" for i in range(10))])]
        for row in rows:
            cells = row.split(",")[:7]
            members = float(cells[4]) + 0.5 * (draws.normal() + draws.normal(size=10))
            lines.append(",".join(map(str, [*cells, 0.4972, 0.7549, *members])))
        (place / f"stated/{run}.csv").write_text("\n".join(lines) + "\n")
    script(place, COPY.replace("tables", "stated"), "bounded")
    return place


def test_a_program_may_state_bounds(stated, monte_carlo, consistency):
    options = ("--level", "68%", "--runs", "40", "--json")
    out = monte_carlo(*options, program=BOUNDED)[1]
    bounds = next(iter(json.loads(out).values()))["statistics"]["bounds"]
    assert [(one["name"], one["level"], one["runs"], one["steps"]) for one in bounds] == [
        ("bound_a", 0.68, 40, 4 * 40), ("radius_b_c", 0.68, 40, 4 * 40)
    ]  # fmt: skip
    tables = [np.loadtxt(stated / f"stated/{run}.csv", delimiter=",", skiprows=1) for run in range(40)]
    outside = np.mean([np.abs(table[:, 4] - table[:, 1]) > 0.4972 for table in tables])
    assert bounds[0]["rate"] == pytest.approx(outside)
    assert consistency("analyse", "out", "--json")[1] == out
    kept = monte_carlo("--keep", "failed", "--overwrite", *options, program=BOUNDED)[1]
    assert kept == out
    assert run_files(stated / "out", "estimates.csv") == []
    assert consistency("analyse", "out", "--json")[1] == out


def test_runs_of_bounds_and_members_are_planned_for_them(stated):
    """Those that show a right bound of 68 %; of members more than of a covariance, as their numbers show less."""
    options = {"state": ["a", "b", "c"], "jobs": 2, "detect": 3.0}
    levels = {"bound_a": "68%", "radius_b_c": "60%"}
    verdict = cs.monte_carlo(BOUNDED, level=levels, **options)
    assert verdict.runs == max(runs_to_show(0.68, 3.0), runs_to_show(0.6, 3.0))
    assert runs_to_show(0.68, 3.0) != runs_to_show(0.6, 3.0)
    few = InsufficientTrials
    with pytest.raises(few, match="plan --level 68%") as found:
        assert_program_consistent(BOUNDED, level="68%", runs=5, **options)
    assert found.value.needed == runs_to_show(0.68, 3.0)
    members = cs.monte_carlo(BOUNDED, members={"a": "e*"}, jobs=2, detect=5.0)
    assert 1.2 * gate_runs(1, 5.0) < members.runs < 70
    assert not members.failures


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (("--truth", "repeats"), ("--truth repeats", "column run", "analyse TABLE")),
        (("--level", "95%", "--until-decided"), ("--until-decided", "bounds", "--runs")),
        (("--level", "2"), ("--level 2", "below 100 %")),
        (("--level", "95%", "--alert-limit", "0"), ("--alert-limit 0",)),
    ],
)
def test_statements_that_a_program_cannot_make_are_refused(stated, words, parts, monte_carlo):
    status, _, err = monte_carlo(*words, program=BOUNDED)
    assert status == 2
    for part in parts:
        assert part in err


# --- Python ------------------------------------------------------------------------------------------------


def test_from_python(place):
    verdict = cs.monte_carlo(FILTER, 20, state=["a", "b", "c"], out="out")
    assert len(verdict.record.run_numbers) == 20
    assert (place / "out/runs/0019/run.json").exists()
    assert cs.judge(cs.read("out")).status == verdict.status
    with pytest.raises(InputError, match="must be a list of words"):
        cs.monte_carlo("./filter {run}")
    with pytest.raises(TypeError, match="unknown option 'states'"):
        cs.monte_carlo(FILTER, states=["a"])


def test_the_gate(place):
    """A right program passes with probability 1 - 1e-6, at a false-alarm rate of 1e-6."""
    options = {"state": ["a", "b", "c"], "false_alarm": 1e-6, "detect": 2.0, "jobs": 2}
    assert assert_program_consistent(FILTER, **options).consistent
    with pytest.raises(InsufficientTrials, match="4 runs do not show"):
        assert_program_consistent(FILTER, runs=4, **options)
    write_tables(place, 70, 4.0, "bold")
    script(place, COPY.replace("tables", "bold"), "brave")
    with pytest.raises(ConsistencyError, match=re.escape("assert_program_consistent: ./brave is overconfident")):
        assert_program_consistent(BRAVE, **options)
