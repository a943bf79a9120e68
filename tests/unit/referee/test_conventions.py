"""docs/conventions.md: the example of each library, with the options that are right and those that are not."""

from __future__ import annotations

import json
import re
import runpy
import secrets
from pathlib import Path

import pytest
from command import consistency
from documents import blocks, read

PAGE = read("docs/conventions.md")
SECTIONS = dict(part.split("\n", 1) for part in PAGE.split("\n## ")[1:])
NEEDED = {"GTSAM Pose2": "gtsam", "GTSAM Pose3": "gtsam", "Stone Soup": "stonesoup"}
FAULTS = {"overconfident", "conservative", "biased", "heavy-tailed", "inconsistent"}
WRONG = "Wrong, and seen:"
RATE = ("--false-alarm", "1e-5")


def commands(text: str) -> list[list[str]]:
    return [line.split()[1:] for line in text.splitlines() if line.startswith("    consistency analyse est")]


def run_example(name: str, at: Path, monkeypatch: pytest.MonkeyPatch, *changes: tuple[str, str]) -> None:
    """The code of a section, with random numbers of its own."""
    if name in NEEDED:
        pytest.importorskip(NEEDED[name], reason=f"{NEEDED[name]} is not installed")
    (code,) = blocks("docs/conventions.md", "python", part=name)
    text = code.text
    for old, new in (("default_rng(6021)", f"default_rng({secrets.randbits(60)})"), *changes):
        assert old in text
        text = text.replace(old, new)
    (at / "make.py").write_text(text)
    monkeypatch.chdir(at)
    runpy.run_path("make.py")


def statuses(command: list[str], capsys: pytest.CaptureFixture[str]) -> set[str]:
    options = ["--time-offset", "0"] if command[1] == "est" else []  # without a look at the clocks, which takes seconds
    out, _ = consistency(capsys, *command, "--json", *RATE, *options)
    return {verdict["status"] for verdict in json.loads(out).values()}


@pytest.mark.parametrize("name", SECTIONS)
def test_what_is_declared_is_right_and_its_neighbour_is_seen(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """False-alarm rate 1e-5 for each verdict, three or fewer an example."""
    run_example(name, tmp_path, monkeypatch)
    right, *wrong = SECTIONS[name].split(WRONG)
    assert commands(right)
    for command in commands(right):
        assert not statuses(command, capsys) & FAULTS, command
    for command in commands("".join(wrong)):
        assert statuses(command, capsys) & FAULTS, command
    assert wrong or name == "Stone Soup"


def test_the_names_of_stone_soup_are_in_the_order_of_its_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The mix-up is seen; the truth keeps its names."""
    truth = ("truth.append(key | dict(zip(NAMES,", 'truth.append(key | dict(zip(["x", "vx", "y", "vy"],')
    names = 'NAMES = ["x", "y", "vx", "vy"]'
    assert names in SECTIONS["Stone Soup"]
    run_example("Stone Soup", tmp_path, monkeypatch, ('NAMES = ["x", "vx", "y", "vy"]', names), truth)
    assert statuses(commands(SECTIONS["Stone Soup"])[0], capsys) & FAULTS


def test_the_notebook_says_what_the_command_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run_example("GTSAM Pose3", tmp_path, monkeypatch)
    out, _ = consistency(capsys, *commands(SECTIONS["GTSAM Pose3"])[0], "--json")
    said = {verdict["status"] for verdict in json.loads(out).values()}
    (code,) = blocks("docs/conventions.md", "python notebook", part="GTSAM Pose3")
    (tmp_path / "look.py").write_text(code.text)
    runpy.run_path("look.py")
    assert {capsys.readouterr().out.strip()} == said


def test_the_table_declares_what_the_examples_do() -> None:
    rows = [line for line in PAGE.splitlines() if line.startswith("| [")]
    assert [re.search(r"\]\(#([^)]*)\)", row).group(1) for row in rows] == [  # type: ignore[union-attr]
        name.lower().replace(" ", "-") for name in SECTIONS
    ]
    for row, section in zip(rows, SECTIONS.values(), strict=True):
        declared = row.split("|")[3]
        options = " ".join(commands(section.split(WRONG)[0])[0][1:]).split(" --truth ")[1].split(" ", 1)[1:]
        assert (options[0] if options else "nothing") in declared
