"""What ``make`` installs for a target, and what it says where that cannot be done."""

import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def checkout(tmp_path):
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, tmp_path)
    return tmp_path


def make(folder, *words):
    return subprocess.run(["make", *words], cwd=folder, capture_output=True, text=True)


def extras(folder, target):
    return re.findall(r'-e "\.\[(.*)\]"', make(folder, "-n", target).stdout)


@pytest.mark.parametrize("target, what", [("reproduce", "bench,report"), ("test", "dev"), (".venv/.done", "dev")])
def test_a_target_installs_what_it_needs(checkout, target, what):
    assert extras(checkout, target) == [what]


def test_the_tests_environment_has_what_reproduce_needs_and_not_the_reverse(checkout):
    python = checkout / "python"  # makes an environment of nothing
    made = f"mkdir -p .venv/bin && ln -sf {shutil.which('true')} .venv/bin/python"
    python.write_text(f'#!/bin/sh\n[ "$1" = -c ] || {{ {made}; }}\n')
    python.chmod(0o755)
    assert make(checkout, ".venv/.lab", f"PYTHON={python}").returncode == 0
    assert extras(checkout, "reproduce") == []
    assert extras(checkout, "test") == ["dev"]
    (checkout / ".venv/.lab").unlink()
    assert make(checkout, ".venv/.done", f"PYTHON={python}").returncode == 0
    assert extras(checkout, "reproduce") == []
    assert extras(checkout, "test") == []


def test_a_python_without_venv_is_told_in_one_line(checkout):
    done = make(checkout, "reproduce", "PYTHON=false")
    assert done.returncode == 2
    assert "false cannot make a virtual environment" in done.stderr.splitlines()[0]
    assert "apt install python3-venv" in done.stderr.splitlines()[0]
    assert "-m venv" not in done.stdout
    assert not (checkout / ".venv").exists()


def test_what_the_first_commands_of_the_readme_write_is_ignored_by_git():
    """The files of the example, the report, and what its pages name."""
    ignored = (ROOT / ".gitignore").read_text("utf-8").splitlines()
    assert {"/estimates.csv", "/truth.csv", "/look/"} <= set(ignored)


def project():
    return tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]


def test_the_conda_recipe_has_what_the_project_has():
    """Version, entry point, Python and the packages of the core, each with its floor."""
    text = (ROOT / "docs/packaging/conda/meta.yaml").read_text("utf-8")
    listed = set(re.findall(r"^    - (\S+) (>=\S+)$", text.partition("  run:\n")[2], re.MULTILINE))
    needed = {re.fullmatch(r"([\w-]+)(>=\S+)", each).groups() for each in project()["dependencies"]}
    assert listed == needed | {("python", project()["requires-python"])}
    assert f'version = "{project()["version"]}"' in text
    for name, target in project()["scripts"].items():
        assert f"    - {name} = {target}\n" in text
    assert project()["urls"]["Repository"] in text
    assert "noarch: python" in text


def test_the_container_ends_with_a_test_of_the_shipped_example():
    """Its commands exist: the paths below the checkout, the extras, and the words of the program."""
    text = (ROOT / "docs/packaging/Containerfile").read_text("utf-8")
    for path in re.findall(r"/src/(docs/\S+)", text):
        assert (ROOT / path).exists(), path
    extras = re.search(r"/src\[(.*?)\]", text)[1].split(",")
    assert set(extras) <= set(project()["optional-dependencies"])
    *_, last = (step for step in text.split("\nRUN ") if step.strip())
    assert "consistency analyse estimates.csv --truth truth.csv" in last
    assert "--fail-on inconsistent" in last
