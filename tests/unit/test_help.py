"""The help: commands in groups with a line each, options of files in panels, those that are needed first at the top."""

import re
import tomllib

import pytest
import typer
from command import consistency, refused
from documents import ROOT

from consistency.commands.app import COMMANDS, GROUPS, PANELS, SELDOM, app
from consistency.referee.readers.options import ERRORS, MODES
from consistency.referee.readers.pipeline.read_files import CONVENTIONS, GUESS

PANELLED = ("analyse", "inspect", "report", "compare", "baseline", "monte-carlo", "fit-covariance", "correct")
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


def options_of(name):
    return [p for p in typer.main.get_command(app).commands[name].params if p.param_type_name == "option"]


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
    panels = sections(consistency(capsys, name, "--help-all")[0])
    assert [title for title in panels if title in PANELS] == [title for title in PANELS if title in panels]
    assert {"Needed first", "What to read", "How to align", "What to write"} <= set(panels)
    listed = re.findall(
        r"^  (?:-\w, )?(--[\w-]+)", "\n".join(line for lines in panels.values() for line in lines), re.MULTILINE
    )
    options = [p for p in options_of(name) if not p.hidden]
    assert sorted(listed) == sorted(["--help", *(option.opts[0] for option in options)])


@pytest.mark.parametrize("name", PANELLED)
def test_every_option_stands_in_one_panel(name):
    places = [option for names in PANELS.values() for option in names]
    assert len(places) == len(set(places))
    assert {option.name for option in options_of(name)} <= set(places)


def test_what_is_in_a_panel_belongs_to_some_command():
    known = {option.name for name in PANELLED for option in options_of(name)} | {"help"}
    assert {option for names in PANELS.values() for option in names} == known
    assert known > SELDOM


def test_options_that_few_need_are_shown_by_help_all(capsys):
    short, whole = help_of(capsys, "analyse"), consistency(capsys, "analyse", "est.csv", "--help-all")[0]
    assert len(short.splitlines()) <= 60
    shown = [set(re.findall(r"^  (--[\w-]+)", text, re.MULTILINE)) for text in (short, whole)]
    seldom = {f"--{name.replace('_', '-')}" for name in SELDOM}
    assert shown[1] - shown[0] == seldom
    assert f"{len(seldom)} more options, rarely needed: consistency analyse --help-all" in short
    assert "rarely needed" not in whole
    assert "--help-all" not in help_of(capsys, "list")


@pytest.mark.parametrize("words, expected", [
    ("analyse --align posyaw", ["posyaw", "posyaw-all"]), ("analyse --error so", ["so2", "so3", "so3-body"]),
    ("run herath2007-s", ["herath2007-selection", "herath2007-stereo"]), ("run x --filter parked", ["parked-ekf-uvd"]),
    ("challenge ukf", ["ukf-uvd", "ukf-xyz"]), ("plan --filter robocentric-ekf-u", ["robocentric-ekf-uvd"]),
])  # fmt: skip
def test_values_complete_in_the_shell(words, expected, monkeypatch, capsys):
    monkeypatch.setenv("_CONSISTENCY_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", f"consistency {words}")
    monkeypatch.setenv("COMP_CWORD", str(len(words.split())))
    with pytest.raises(SystemExit):
        typer.main.get_command(app).main(prog_name="consistency")
    assert set(expected) <= set(capsys.readouterr().out.split())


def test_values_that_complete_are_those_that_are_allowed(tmp_path, capsys):
    assert set(ERRORS) == {*CONVENTIONS, GUESS}
    err = refused(capsys, "analyse", tmp_path / "est.csv", "--truth", "t.csv", "--align", "nowhere")
    assert f"must be one of {', '.join(MODES)}" in err


def test_the_options_that_people_need_first_come_first(capsys):
    panels = sections(help_of(capsys, "analyse"))
    first = re.findall(r"^  (--[\w-]+)", "\n".join(panels["Needed first"]), re.MULTILINE)
    assert first == [f"--{name.replace('_', '-')}" for name in PANELS["Needed first"]][:10]
    assert "--overwrite" in "\n".join(panels["What to write"])
    assert "--detect" in "\n".join(panels["What to ask"])


def test_a_filter_in_a_file_is_run_from_python(capsys):
    _, err = consistency(capsys, "run", "herath2007-stereo", "--filter", "mine.py:Mine", "--out", "nowhere", status=2)
    assert "cs.run_trials(scenario, [MyFilter()])" in err
    assert "ekf-xyz" not in err


def test_the_project_has_an_address():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert re.fullmatch(r"https://github\.com/[\w-]+/filter-consistency", project["urls"]["Repository"])
