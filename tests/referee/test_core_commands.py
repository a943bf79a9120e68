"""Commands on files: what they print, and their exit status."""

import json
import subprocess
import sys

import inputs
import pytest

from consistency.commands import main


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    at = tmp_path_factory.mktemp("files")
    for name, scale in (("fair", 1.0), ("bold", 1.6)):
        inputs.planar(at, name, scale, optimal=True)
    (at / "short.csv").write_text("run,step,x,y\n0,1,0,0\n")
    (at / "later.csv").write_text("step,x,y,heading\n99,0,0,0\n")
    return at


def consistency(folder, *words, text=None):
    """Exit status, standard output and standard error of a process of its own."""
    done = subprocess.run(
        [sys.executable, "-m", "consistency", *words],
        cwd=folder, input=text, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    return done.returncode, done.stdout, done.stderr


def here(words, capsys):
    """As :func:`consistency`, in this process."""
    with pytest.raises(SystemExit) as end:
        main(words)
    return end.value.code or 0, *capsys.readouterr()


def test_a_verdict_in_words(folder, monkeypatch, capsys):
    status, out, _ = consistency(folder, "analyse", "bold.csv", "--truth", "truth.csv", "--fail-on", "inconsistent")
    assert status == 1
    assert "overconfident" in out
    monkeypatch.chdir(folder)
    status, out, _ = here(["analyse", "fair.csv", "--truth", "truth.csv", "--fail-on", "inconsistent"], capsys)
    assert status == 0
    assert "consistent" in out


def test_a_baseline_is_written_and_compared_with(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    status, out, _ = here(["baseline", "fair.csv", "--truth", "truth.csv", "--out", "base.json"], capsys)
    assert status == 0
    assert "baseline in base.json" in out
    words = ("base.json", "--truth", "truth.csv", "--fail-on", "worse", "--json")
    assert here(["compare", "fair.csv", *words], capsys)[0] == 0
    status, out, _ = here(["compare", "bold.csv", *words], capsys)
    assert status == 1
    assert [row["worse"] for row in json.loads(out)] == [True]
    status, _, err = here(["baseline", "fair.csv", "--truth", "truth.csv", "--out", "base.json"], capsys)
    assert status == 2
    assert "base.json: exists already" in err


def test_innovations_from_a_pipe(folder):
    lines = "nis,nis_dof\n" + "".join(f"{nis},2\n" for nis in [1.0, 3.0] * 20 + [20.0] * 20)
    status, out, err = consistency(folder, "monitor", "-", "--innovations", "optimal", "--fail-on", "alarm", text=lines)
    assert status == 1
    assert "alarm" in out + err


@pytest.mark.parametrize("command", ["", "analyse", "compare", "baseline", "monitor", "plan"])
def test_help(command, capsys):
    status, out, err = here([*command.split(), "--help"], capsys)
    assert (status, err) == (0, "")
    assert "Usage: " in out
    assert ("\n  --truth " in out) == (command in ("analyse", "compare", "baseline"))
    assert ("\n  --false-alarm " in out) == (command in ("analyse", "compare", "monitor", "plan"))


@pytest.mark.parametrize(
    "words, expected",
    [
        ("analyse nowhere.csv", "nowhere.csv: no such file"),
        ("analyse short.csv --truth truth.csv", "short.csv: column 'heading' is missing"),
        ("analyse fair.csv --truth later.csv", "later.csv"),
        ("analyse fair.csv --truth truth.csv --filter other", "--filter other: is not in these files; there are: fair"),
        ("analyse fair.csv --truth truth.csv --error nonsense", "--error nonsense: must be one of"),
        ("analyse fair.csv --truth truth.csv --detect x", "--detect"),
        ("analyse fair.csv --truth", "--truth"),
        ("monitor truth.csv --innovations optimal", "truth.csv: "),
        ("plan --detect 1", "--detect"),
        ("nonsense", "nonsense"),
    ],
)
def test_bad_input_ends_in_one_line(words, expected, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    status, out, err = here(words.split(), capsys)
    assert (status, out) == (2, "")
    assert err.startswith("consistency: ")
    assert err.count("\n") == 1
    assert expected in err
