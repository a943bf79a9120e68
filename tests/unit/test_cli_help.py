"""Help of the command line: examples that parse, words of a person, completion."""

from __future__ import annotations

import shlex

import pytest
import typer
from documents import parsed

from consistency.cli.app import app
from consistency.cli.examples import EXAMPLES

ROOT = typer.main.get_command(app)
COMMANDS = ROOT.commands  # type: ignore[attr-defined]
LINES = [line for lines in EXAMPLES.values() for line in lines]


@pytest.mark.parametrize("line", LINES)
def test_an_example_parses(line: str) -> None:
    name, values = parsed(shlex.split(line))
    assert line in COMMANDS[name].epilog
    assert values


def test_every_command_that_takes_something_has_an_example() -> None:
    assert set(EXAMPLES) == {name for name in COMMANDS if name != "list"}


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
