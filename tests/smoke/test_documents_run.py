"""Every command and piece of code of README and docs, run in the order of its page, on small inputs and few runs.

A page has an empty folder with the files that tests/helpers/document_inputs.py makes for it. What cannot be run stands
there in ``NOT_RUN``; tests/unit/test_documents.py parses that, too, and commands that a sentence mentions.
"""

import io
import re
import shlex
import sys
from itertools import groupby
from pathlib import Path

import document_inputs as inputs
import forks
import numpy as np
import pytest
import scene
from documents import PAGES, SHELL, Command, blocks, typed
from own_process import COMPILING, IMPORTS

from consistency.commands import main

pytestmark = pytest.mark.slow

OF_THE_CHECKOUT = {
    "apt",
    "cd",
    ".",
    "python3",
    "bash",
    "git",
    "make",
    "pip",
    "pre-commit",
}  # they install, test or measure all of it
SMALLER_CODE = {
    "runs=50": "runs=4", "runs=20000": "runs=20", "trials=100": "trials=6",
    "[[707.09, 0, 601.89], [0, 707.09, 183.11], [0, 0, 1]]": str(scene.K.tolist()),
    "0.537": str(scene.BASELINE), "(1226, 370)": str(scene.SIZE),
}  # fmt: skip
ONE_CELL = """
summary = "One cell"
base = "herath2007-stereo"
filters = ["ekf-uvd"]
[rule]
max_runs = 12
[grid]
range = [3.0]
"""
STAND_INS = {"A": "ekf-uvd", "B": "ukf-uvd"}  # of placeholders that are no files
PRINTED = {  # page: first words of a printed block whose first line has the form of one that the page's commands print
    "docs/laboratory.md": "filter ",
    "docs/tuning.md": "oc-ekf-xyz on",
}


def smaller(words):
    """What is appended to a command, so that it takes seconds; of an option the last one counts."""
    name = words[1]
    if name == "run" and "--log" not in words:
        return "--jobs 1 --max-runs 8" if "--until-decided" in words else "--jobs 1 --runs 20"
    if name == "analyse" and "LOG/motions.tum" in words:
        return "--relative 0.5s"  # of 12 images
    if name == "plan" and "--filter" in words:
        return "--pilot-runs 20"
    if name == "tune" and "--log" not in words:
        return "--jobs 1 --runs 5"
    if name == "sweep":
        return "--jobs 1 --filter ekf-uvd"  # of one cell
    return {
        "run": "--jobs 1", "tune": "--jobs 1", "simulate": "--runs 4", "challenge": "--minutes 0.1 --jobs 1",
        "characterise": "--overwrite", "reproduce": "--runs 4",
    }.get(name, "")  # fmt: skip


def run_command(command, capsys, monkeypatch):
    """What it prints; its exit status must be 0, or 1 after --fail-on."""
    words = [STAND_INS.get(word, word) for word in [*command.words, *smaller(command.words).split()]]
    for option, place in (("--board", "BOARDS"), ("--at-rest", "RESTING")):
        words = [place if word == "IMAGES" and option in words else word for word in words]
    if words[1] == "sweep" and "--out" in words:
        Path("one.toml").write_text(ONE_CELL)
        words[2] = "one.toml"
    if " | " in command.text:
        monkeypatch.setattr(sys, "stdin", io.StringIO(Path("innovations.csv").read_text()))
    with pytest.raises(SystemExit) as end:
        main(words[1:])
    said = capsys.readouterr()
    allowed = {0, 1} if "--fail-on" in words else {0}
    assert (end.value.code or 0) in allowed, f"{command}\n{shlex.join(words)}\n{said.out}\n{said.err}"
    return said.out


def run_process(*words):
    """A script, or pytest, in a fork."""
    what = "module('pytest'" if words[0] == "pytest" else "path(sys.argv[0]"
    code = "import os, runpy; sys.path[0] = os.path.dirname(os.path.abspath(sys.argv[0]))"
    done = forks.done(
        IMPORTS, f"{code}; runpy.run_{what}, run_name='__main__')", *words, cwd=Path.cwd(), timeout=COMPILING
    )
    assert done.returncode == 0, done.stdout + done.stderr


def run_code(block, names):
    """A script, or tests where it defines some."""
    text = block.text
    for old, new in SMALLER_CODE.items():
        text = text.replace(old, new)
    if "def test_" in text:
        dof = re.search(r"dof=(\d+)", text)
        prelude = inputs.TESTED.format(axes=dof[1] if dof else 3)
        Path("test_block.py").write_text(prelude + text)
        run_process("pytest", "-q", "-p", "no:cacheprovider", "test_block.py")
        return
    if saved := re.search(r"Save as `([^`]*)`", block.before):
        Path(saved[1]).write_text(text)
    exec(compile(text, str(block), "exec"), names)


def parts(page):
    """The page, but for parts with inputs of their own."""
    found = [(f"{page} {block.part}", block) for block in blocks(page)]
    named = [(name if name in inputs.PREPARE else page, block) for name, block in found]
    return [(key, [b for _, b in group]) for key, group in groupby(sorted(named, key=lambda p: p[0]), lambda p: p[0])]


def runs(block):
    if block.language in SHELL:
        return any(runs_command(command) for command in typed(block))
    return block.language.startswith("python") and not inputs.not_run(block.page, block.text)


def runs_command(command):
    left_out = command.synopsis or command.words[0] in OF_THE_CHECKOUT
    return not left_out and not inputs.not_run(command.page, command.text)


ALL = [(name, found) for page in PAGES for name, found in parts(page) if any(map(runs, found))]


@pytest.mark.parametrize("name, found", ALL, ids=[name for name, _ in ALL])
def test_it_runs(name, found, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(inputs, "RNG", np.random.default_rng(20070))  # the same in whatever order pages are run
    for prepare in inputs.PREPARE.get(name, []):
        prepare(tmp_path)
    page, printed = found[0].page, ""
    names = {"__name__": "__main__", **inputs.names_of(page, tmp_path)}
    for block in filter(runs, found):
        if block.language not in SHELL:
            run_code(block, names)
            continue
        for command in filter(runs_command, typed(block)):
            if command.words[0] == "consistency":
                printed += run_command(command, capsys, monkeypatch)
            else:
                words = command.words
                assert words[0] in ("python", "pytest"), command
                run_process(*words[words[0] == "python" :])
    if page in PRINTED:
        (shown,) = (block for block in found if block.language == "text" and block.text.startswith(PRINTED[page]))
        assert form(shown.text.splitlines()[0]) in map(form, printed.splitlines())


def form(line):
    """A line without its digits."""
    return re.sub(r"[\d.]+", "#", line).split()


@pytest.mark.parametrize("text", ["consistency analyse nowhere", "consistency list --jsn"])
def test_a_command_that_does_not_work_is_seen(text, capsys, monkeypatch):
    with pytest.raises(AssertionError):
        run_command(Command("page.md", 1, text), capsys, monkeypatch)
