"""Help of the command line: examples that parse, words of a person, completion."""

from __future__ import annotations

import shlex
import subprocess
import sys

import pytest
import typer
from command import consistency, refused
from documents import parsed

from consistency.referee.cli.app import app
from consistency.referee.cli.commands import COMMANDS as ROWS

ROOT = typer.main.get_command(app)
COMMANDS = ROOT.commands  # type: ignore[attr-defined]
LINES = [line for row in ROWS.values() for line in row.examples]


@pytest.mark.parametrize("line", LINES)
def test_an_example_parses(line: str) -> None:
    name, values = parsed(shlex.split(line))
    assert line in COMMANDS[name].epilog
    assert values


def test_every_command_that_takes_something_has_an_example() -> None:
    assert {name for name, row in ROWS.items() if not row.examples} == {"list"}


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_help_is_for_people(name: str) -> None:
    with ROOT.make_context("consistency", [name]) as root:
        context = COMMANDS[name].make_context(name, [], parent=root, resilient_parsing=True)
        text = COMMANDS[name].get_help(context)
    assert "list[" not in text
    assert "-h, --help" in text


def test_completion_is_offered() -> None:
    options = {option for parameter in ROOT.params for option in parameter.opts}
    assert {"--install-completion", "--show-completion"} <= options


@pytest.mark.parametrize("name", ["run", "analyse", "tune"])
def test_help_alone_is_that_of_typer(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    shown = []
    for words in ([name, "--help"], [name, "--help", "--help"]):  # the second goes through typer
        shown.append(consistency(capsys, *words)[0])
    assert f"Usage: consistency {name} " in shown[0]
    assert [text.partition(f" {name} ")[2] for text in shown] == [shown[0].partition(f" {name} ")[2]] * 2


def test_help_of_no_command_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    refused(capsys, "runn", "--help")


def test_help_imports_nothing_that_checks_values() -> None:
    code = "import sys; sys.argv[1:] = ['run', '-h']; from consistency.referee.cli.app import _show_help; \
_show_help(None) or sys.exit(3); sys.exit('pydantic' in sys.modules or 'numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0
