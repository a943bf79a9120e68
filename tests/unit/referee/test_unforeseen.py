"""Exit status 1 is said by a verdict alone: what no code foresaw ends in 2, and a fault of ours is named as one."""

from pathlib import Path
from unittest import mock

import numpy as np
import pytest

import consistency as cs
from consistency.commands import main
from consistency.referee.parsing import reading

POSES = (
    "t,x,y,heading,P_xx,P_xy,P_xh,P_yy,P_yh,P_hh\n0,0.1,0,0,0.01,0,0,0.01,0,0.001\n1,1.1,0,0,0.01,0,0,0.01,0,0.001\n"
)
TRUTHS = {
    "columns.txt": "0 0 0 0\n1 1 0 0\n",
    "noted.txt": "# of a survey\n0 0 0 0\n1 1 0 0\n",
    "commas.tum": "0,0,0,0\n1,1,0,0\n",
}


def ended(*words):
    with pytest.raises(SystemExit) as end:
        main(list(words))
    return int(end.value.code or 0)


@pytest.mark.parametrize("truth", TRUTHS)
@pytest.mark.parametrize("command", ["analyse", "fit-covariance"])
def test_positions_alone_are_no_truth_of_planar_poses(tmp_path, capsys, command, truth):
    (tmp_path / "est.csv").write_text(POSES if command == "analyse" else "t,v,omega\n0,1,0\n1,1,0\n")
    (tmp_path / truth).write_text(TRUTHS[truth])
    span = [] if command == "analyse" else ["--span", "1s"]
    assert ended(command, str(tmp_path / "est.csv"), "--truth", str(tmp_path / truth), *span) == 2
    said = capsys.readouterr().err
    assert f"{truth}: holds positions without orientations" in said
    assert "--state x,y" in said


@pytest.mark.parametrize("error", [ValueError("such"), TypeError("such"), OSError("such"), ModuleNotFoundError("such")])
@pytest.mark.parametrize("debug", [True, False])
def test_an_unforeseen_exception_ends_in_2_with_its_kind_and_place(capsys, error, debug):
    with mock.patch("consistency.commands.app.app", side_effect=error):
        assert ended(*["--debug"] * debug, "plan") == 2
    said = capsys.readouterr().err
    last = said.splitlines()[-1]
    assert last.startswith(f"consistency: unforeseen {type(error).__name__} in ")
    assert ": such; " in last
    assert ("Traceback" in said) == debug
    assert debug or said.count("\n") == 1


def test_debug_stands_before_any_command(capsys):
    assert ended("--debug", "plan", "--dof", "3", "--detect", "1.2") == 0
    assert "runs" in capsys.readouterr().out


@pytest.mark.parametrize("kind", [NameError, UnboundLocalError, TypeError, AttributeError, IndexError])
def test_a_programming_error_of_ours_is_not_reworded(kind):
    code = compile(
        "def parse():\n    raise KIND('ours')", str(Path(cs.__file__).parent / "referee" / "some.py"), "exec"
    )
    names = {"KIND": kind}
    exec(code, names)
    with pytest.raises(kind, match="ours"), reading("file"):
        names["parse"]()


@pytest.mark.parametrize("kind", [TypeError, AttributeError, NameError, IndexError, ValueError])
def test_whatever_a_library_raises_of_a_file_is_its_damage(kind):
    with pytest.raises(cs.InputError, match=r"file: .*damaged.*of a library"), reading("file"):
        raise kind("of a library")


def test_a_value_error_of_ours_is_the_files_fault():
    with pytest.raises(cs.InputError, match="file: "), reading("file"):
        cs.nees(np.ones(2), -np.eye(2))
