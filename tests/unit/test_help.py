"""The help: commands in groups with a line each, options of files in panels, those that are needed first at the top."""

import re
import tomllib

import pytest
import typer
from command import consistency
from documents import ROOT

from consistency.commands.app import COMMANDS, GROUPS, PANELS, app

PANELLED = ("analyse", "report", "compare", "baseline")
VERBS = [
    "Check",
    "Compare",
    "Compute",
    "Convert",
    "Correct",
    "Find",
    "Fit",
    "List",
    "Measure",
    "Re-run",
    "Run",
    "Show",
    "Simulate",
    "Store",
    "Watch",
    "Write",
]


def sections(text):
    """Lines of each section of a help, by its title."""
    parts = re.split(r"^(\w[^:\n]*):$", text, flags=re.MULTILINE)[1:]
    return dict(zip(parts[::2], (body.splitlines() for body in parts[1::2]), strict=True))


def help_of(capsys, *words):
    return consistency(capsys, *words, "--help")[0]


def test_every_command_has_a_line_in_one_group(capsys):
    groups = sections(help_of(capsys))
    shown = {group: [line.split()[0] for line in groups[group] if line.strip()] for group in GROUPS}
    assert sorted(name for names in shown.values() for name in names) == sorted(COMMANDS)
    assert {"analyse", "compare", "monitor"} <= set(shown["Judge your own estimator"])
    assert shown["Stereo images"] == ["frontend", "characterise"]
    assert all(name in COMMANDS for names in GROUPS.values() for name in names)


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_is_an_imperative_sentence(name):
    command = typer.main.get_command(app).commands[name]
    first = command.help.split(".")[0]
    assert first.split()[0] in VERBS, first
    assert len(first) <= 65, first


@pytest.mark.parametrize("name", PANELLED)
def test_options_of_files_are_in_panels(name, capsys):
    panels = sections(help_of(capsys, name))
    assert [title for title in panels if title in PANELS] == [title for title in PANELS if title in panels]
    assert {"Needed first", "What to read", "How to align"} <= set(panels)
    listed = re.findall(
        r"^  (?:-\w, )?(--[\w-]+)", "\n".join(line for lines in panels.values() for line in lines), re.MULTILINE
    )
    options = [p for p in typer.main.get_command(app).commands[name].params if p.param_type_name == "option"]
    assert sorted(listed) == sorted(["--help", *(option.opts[0] for option in options)])


def test_the_options_that_people_need_first_come_first(capsys):
    panels = sections(help_of(capsys, "analyse"))
    first = re.findall(r"^  (--[\w-]+)", "\n".join(panels["Needed first"]), re.MULTILINE)
    assert first == [f"--{name.replace('_', '-')}" for name in PANELS["Needed first"]]
    assert len(first) == 10
    assert "--overwrite" in "\n".join(panels["What to write"])
    assert "--tolerance" in "\n".join(panels["What to ask"])


def test_a_filter_in_a_file_is_run_from_python(capsys):
    _, err = consistency(capsys, "run", "herath2007-stereo", "--filter", "mine.py:Mine", "--out", "nowhere", status=2)
    assert "cs.run_trials(scenario, [MyFilter()])" in err
    assert "ekf-xyz" not in err


def test_the_project_has_an_address():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert re.fullmatch(r"https://github\.com/[\w-]+/filter-consistency", project["urls"]["Repository"])
