"""What surrounds a command does not change what it says: locale, umask, style of figures, a disk that is full."""

import errno
import os
import shutil
import signal
import stat
import subprocess
import sys
from collections import namedtuple
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import consistency as cs
from consistency.commands import main
from consistency.referee import system
from consistency.referee.parsing import require_name
from consistency.referee.programs import process
from consistency.referee.programs.process import program_of
from consistency.referee.readers.formats import file_kinds
from consistency.referee.readers.formats.sheet import read_sheet, require_distinct
from consistency.referee.readers.formats.text_blocks import Block, floats, read_numbers
from consistency.referee.readers.mix_ups.reading_fit import fit_of
from consistency.referee.readers.truth_matching import make_poses
from consistency.referee.show import as_md, figures
from consistency.referee.show.blocks import Document
from consistency.referee.show.figures import canvas
from consistency.referee.system import NewFolder, require_free

HEAD = "t,x,y,heading,P_xx,P_xy,P_xh,P_yy,P_yh,P_hh\n"


@pytest.fixture
def files(tmp_path, monkeypatch, rng):
    """Estimates of 60 steps beside their truth, right but for chance, in the working directory."""
    monkeypatch.chdir(tmp_path)
    rows = [f"{k},{x},{y},{h},0.01,0,0,0.01,0,0.01\n" for k, (x, y, h) in enumerate(0.1 * rng.standard_normal((60, 3)))]
    Path("est.csv").write_text(HEAD + "".join(rows))
    Path("truth.csv").write_text("t,x,y,heading\n" + "".join(f"{k},0,0,0\n" for k in range(60)))
    return tmp_path


def analyse(*words):
    with pytest.raises(SystemExit) as end:
        main(["analyse", *words, "--truth", "truth.csv"])
    return int(end.value.code or 0)


# --- variances of nothing ------------------------------------------------------------------------------


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("variance", [1e-25, 1e-100, 1e-162, 1e-200, 1e-310, 5e-324])
@pytest.mark.parametrize("every", [1, 20])
def test_a_variance_of_nothing_is_not_positive_definite(files, capsys, variance, every):
    lines = (files / "est.csv").read_text().splitlines()
    for k in range(1 + every // 2, len(lines), every):
        lines[k] = lines[k].replace("0.01,0,0,0.01", f"{variance},0,0,{variance}")
    (files / "est.csv").write_text("\n".join(lines) + "\n")
    status = analyse("est.csv")
    said = "".join(capsys.readouterr())
    if every == 1:
        assert status == 2
        assert "variance zero: x, y" in said
    else:
        assert status == 0
        assert "covariance is not positive definite (est.csv, line 12)" in " ".join(said.split())


def test_a_fit_leaves_out_what_has_no_variance(rng):
    errors = rng.standard_normal((50, 2))
    P = np.tile(np.eye(2), (50, 1, 1))
    P[::2] *= 1e-24
    fit = fit_of([(errors, P)])
    assert fit.w.shape == (25, 2)


# --- figures and reports -------------------------------------------------------------------------------


def test_figures_have_our_style_whatever_the_user_has_set(monkeypatch):
    import matplotlib as mpl

    def draw():
        figure, (axes,) = canvas(2.0)
        axes.plot([0, 1], [0, 1])
        axes.set_title("a $title$")
        return figure

    plain = figures.svg(draw)
    with mpl.rc_context({"text.usetex": True, "font.size": 40.0, "savefig.bbox": "tight", "lines.linewidth": 9.0}):
        assert figures.svg(draw) == plain
        assert figures.drawn(draw).axes[0].title.get_fontsize() == figures.drawn(draw).axes[0].title.get_size() < 10
        assert mpl.rcParams["text.usetex"]


def test_a_backend_that_is_not_there_is_not_asked_for(files):
    code = "from consistency.referee.show.figures import own_style\nwith own_style():\n    print('drawn')"
    (files / "matplotlibrc").write_text("axes.prop_cycle: bad(\nno.such.key: 3\n")
    env = {**os.environ, "MPLBACKEND": "nonsense", "MATPLOTLIBRC": str(files)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env)
    assert (done.returncode, done.stdout, done.stderr) == (0, "drawn\n", "")


def test_the_verdict_is_said_before_anything_is_drawn(files, capsys, monkeypatch):
    said = []

    def paint(_):
        said.append(capsys.readouterr().out)
        raise cs.InputError("no picture")

    monkeypatch.setattr(figures, "paint", paint)
    assert analyse("est.csv", "--report", "report") == 2
    assert "undecided" in said[0]
    assert not Path("report").exists()


@pytest.mark.skipif(os.name == "nt", reason="umask")
@pytest.mark.parametrize("mask, folder, file", [(0o077, 0o700, 0o600), (0o002, 0o775, 0o664)])
def test_the_umask_holds(files, mask, folder, file):
    before = os.umask(mask)
    try:
        analyse("est.csv", "--report", "report")
        analyse("est.csv", "--report", "report.md")
    finally:
        os.umask(before)
    modes = {path: stat.S_IMODE(path.stat().st_mode) for path in (*Path("report").iterdir(), Path("report.md"))}
    assert set(modes.values()) == {file}
    assert len(modes) > 3
    assert stat.S_IMODE(Path("report").stat().st_mode) == folder


def test_a_signal_removes_what_is_half_written(tmp_path):
    before = list(system.AT_STOP)
    with NewFolder(tmp_path / "out", "verdict") as new:
        (new.path / "half").write_text("half")
        (removal,) = [each for each in system.AT_STOP if each not in before]
        removal()
        assert not new.path.exists()
    assert before == system.AT_STOP


REPORTING = """
import sys, time
import consistency.commands as cli
from consistency.__main__ import main
from consistency.referee.system import NewFolder
from pathlib import Path
sys.argv = ["consistency", "analyse"]
def work():
    with NewFolder(Path("out"), "verdict"):
        print("there", flush=True)
        time.sleep(60)
cli.main = work
main()
"""


@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_a_report_that_is_ended_leaves_nothing(tmp_path):
    with subprocess.Popen([sys.executable, "-c", REPORTING], stdout=subprocess.PIPE, cwd=tmp_path) as command:
        command.stdout.readline()
        assert list(tmp_path.iterdir())
        command.send_signal(signal.SIGTERM)
        assert command.wait(30) == -signal.SIGTERM
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "name, written",
    [
        ("a[b](http://c)", r"a\[b]\(http://c)"),
        ("*bold* _c_ a_b 2*3", r"\*bold\* \_c\_ a_b 2\*3"),
        ("~~no~~", r"\~~no\~~"),
        ("1.07 [0.34, 14.9]", "1.07 [0.34, 14.9]"),
        ("[1](http://c)", r"\[1]\(http://c)"),
    ],
)
def test_markdown_has_names_as_they_are(name, written):
    assert as_md.render(Document(name, "", ())).splitlines()[0] == f"## {written}"


# --- names and places ----------------------------------------------------------------------------------


@pytest.mark.skipif(os.name == "nt", reason="root")
def test_the_root_is_no_folder_for_a_report():
    with pytest.raises(cs.InputError, match=r"--report /: exists already"):
        require_free(Path("/"), False, "verdict", "--report")


@pytest.mark.parametrize("char", "\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")
def test_a_name_turns_no_text_around(char):
    with pytest.raises(cs.InputError, match=rf"u{ord(char):04x}.*control character; rename"):
        require_name(f"est{char}vsc.exe", "file")
    for name in ("é.csv", "עברית.csv", "数.csv"):
        assert require_name(name, "file") == name


def test_a_name_that_the_locale_does_not_know_is_said():
    with pytest.raises(cs.InputError, match=r"locale.*PYTHONUTF8=1"):
        require_name(b"\xc3\xa9.csv".decode("ascii", "surrogateescape"), "file")


@pytest.mark.skipif(os.name == "nt", reason="locales")
def test_a_locale_without_unicode_ends_no_command(files):
    text = (files / "est.csv").read_text().replace("heading", "größe", 1)
    (files / "est.csv").write_text(text, encoding="utf-8")
    env = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    command = [sys.executable, "-m", "consistency", "analyse", "est.csv", "--truth", "truth.csv"]
    done = subprocess.run(command, capture_output=True, env=env)
    assert done.returncode == 2
    assert rb"gr\xf6\xdfe" in done.stderr


def test_an_array_called_an_archive_is_named(tmp_path):
    with (tmp_path / "a.npz").open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(cs.InputError, match=r"a\.npz: is a single array; save with numpy\.savez"):
        cs.read(tmp_path / "a.npz")


def test_a_disk_that_is_full_is_no_failed_run(tmp_path, monkeypatch):
    """The program ended well, or not: what it wrote may be cut short, and its run is not finished."""
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(1, 1, 0))
    for code in ("pass", "raise OSError"):
        program, folder = program_of([sys.executable, "-c", code], Path.cwd()), tmp_path / code
        with pytest.raises(cs.InputError, match=r"disk is full.*run 3 does not count; .*--resume"):
            process.run_program(program, folder, 3, {"seed": "1"}, None, process.Processes())
        assert not (folder / "run.json").exists()
    monkeypatch.undo()
    monkeypatch.setattr(process, "finish", lambda _: (_ for _ in ()).throw(OSError(errno.EACCES, "no")))
    with pytest.raises(OSError, match="no"):
        process.run_program(program, tmp_path / "other", 3, {"seed": "1"}, None, process.Processes())


# --- many files, many columns, many rows -----------------------------------------------------------------


def test_each_partner_is_found_without_a_listing_of_its_folder(tmp_path, monkeypatch):
    for name in ("a.txt", "b.tum", "c.TXT", "d.csv", "d.txt", "e.parquet", "f.dat"):
        (tmp_path / name).touch()
    listed = []
    monkeypatch.setattr(Path, "iterdir", lambda self: listed.append(self) or iter(()))
    wanted = {
        "a.tum": "a.txt",
        "b.txt": "b.tum",
        "c.txt": "c.TXT",
        "d.csv": "d.txt",
        "e.csv": "e.parquet",
        "f.dat": "f.dat",
    }
    found = {name: file_kinds.paired(tmp_path, Path("est") / name, "--truth").name for name in wanted}
    assert found == wanted
    assert not listed
    with pytest.raises(cs.InputError, match=r"--truth .*'g'.*paired by name"):
        file_kinds.paired(tmp_path, Path("est/g.txt"), "--truth")


def test_many_names_are_not_compared_each_with_each():
    class Names(list):
        def count(self, _):
            raise AssertionError("a header of a million names would take hours")

    require_distinct(Names("abc"), "a.csv")
    with pytest.raises(cs.InputError, match=r"a\.csv: column 'b' is duplicated"):
        require_distinct(Names("abcb"), "a.csv")


def block(text, ends=True):
    return Block(Path("a.csv"), text.encode(), 1, ends)


@pytest.mark.parametrize(
    "text, separator, right",
    [
        ("1,2\n3,-4.5e-3\n", ",", [[1, 2], [3, -4.5e-3]]),
        ("1,2\r\n3,4\r\n", ",", [[1, 2], [3, 4]]),
        ("1;2\n", ";", [[1, 2]]),
        ("1\t2\n", "\t", [[1, 2]]),
        ("1  2\n 3,4\n", "", [[1, 2], [3, 4]]),
        ("1e999,2\n", ",", [[np.inf, 2]]),
        *((text, ",", None) for text in (
            "1,\n", "1,2,\n", "1,,2\n", "#,1\n",
            "1 ,2\n", "1,2\n\n", "1,2\n3\n4,5,6\n", "1-2,\n", "1-2\n", "1.2.3,4\n", "1e,2\n",
            "nan,2\n", "1_0,2\n", "0x1,2\n", '"1",2\n', "1;2\n", "1,2\r3,4\n", "a,2\n", "", "1,2\n,\n3,4,5,6\n",
        )),
        *((text, "", None) for text in ("1 2 3\n", "1\n2 3 4\n", "1;2\n", "\n", "1-2 3\n")),
    ],
)  # fmt: skip
def test_plain_numbers_are_read_at_once_and_nothing_else_is(text, separator, right):
    values = block(text).numbers(2, separator)
    if right is None:
        assert values is None
    else:
        assert values.tolist() == right
    assert block(text, ends=False).numbers(2, separator) is None


def test_numbers_read_at_once_are_those_of_python_to_the_last_bit(rng):
    values = rng.standard_normal((500, 3)) * 10.0 ** rng.integers(-320, 300, (500, 3))
    rows = [[form % value for form, value in zip(("%.17g", "%.6f", "%.9e"), row, strict=True)] for row in values]
    found = block("".join(",".join(row) + "\n" for row in rows)).numbers(3, ",")
    of_python = floats(rows)
    assert found.tobytes() == of_python.tobytes()


@pytest.mark.parametrize("size", [40, 200, 2**22])
def test_blocks_of_numbers_and_of_others_are_one_file(tmp_path, monkeypatch, size):
    """Lines keep their numbers, wherever a block ends."""
    monkeypatch.setattr("consistency.referee.readers.formats.text_blocks.BLOCK", size)
    rows = [f"{k},{k / 7},{-k}" for k in range(1, 100)]
    rows[30] = "31,,nan"
    (tmp_path / "a.csv").write_text("t,a,b\n# note\n" + "\n".join(rows[:50]) + "\n\n" + "\n".join(rows[50:]) + "\n")
    sheet = read_sheet(tmp_path / "a.csv")
    assert sheet.line.tolist() == [*range(3, 53), *range(54, 103)]
    assert sheet.data["t"].tolist() == list(range(1, 100))
    assert np.flatnonzero(np.isnan(sheet.data["a"])).tolist() == [30]
    (tmp_path / "a.txt").write_text("\n".join(row.replace(",", " ") for row in rows if "nan" not in row) + "\n")
    lines = read_numbers(tmp_path / "a.txt", (3,), "t a b")
    assert lines.line.tolist() == list(range(1, 99))
    assert lines.values[:, 2].tolist() == [-k for k in range(1, 100) if k != 31]
    with pytest.raises(cs.InputError, match=r"a\.txt, line 1: has 3 columns; should be t a"):
        read_numbers(tmp_path / "a.txt", (2,), "t a")


def test_sound_poses_have_no_variance_that_counts_as_none():
    P = np.tile(np.diag([1e-25, 1e-23, 4.0]), (2, 1, 1))
    P[:, 0, 2] = P[:, 2, 0] = 1e-14
    t, pose = np.arange(2.0), np.zeros((2, 3))
    poses = make_poses(lambda _: "", t, pose, P, np.ones(2, bool), t, pose, "planar", "so2", 0.01)
    assert poses.sound().variances.tolist() == [[0.0, 1e-23, 4.0]] * 2
    assert poses.sound().own.covariance[0, 0, 2] == 1e-14
    assert poses.own.covariance[0, 0, 0] == 1e-25


def test_the_commit_is_that_of_the_checkout_around_the_package(monkeypatch):
    asked = []

    def run(command, **_):
        asked.append(command)
        return SimpleNamespace(stdout="# branch.oid abc\n1 .M N... consistency/types.py\n")

    monkeypatch.setattr(system.Path, "exists", lambda _: True)
    monkeypatch.setattr(system.subprocess, "run", run)
    assert system._git_commit.__wrapped__() == "abc-dirty"
    assert asked[0][:3] == ["git", "-C", str(Path(system.__file__).parents[2])]
    assert (Path(asked[0][2]) / "consistency/__init__.py").is_file()
