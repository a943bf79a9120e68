"""Every block and command of README and docs, without running it: names, options, targets, files and keys exist.

tests/smoke/test_documents_run.py runs them.
"""

import ast
import difflib
import importlib
import inspect
import io
import re
import runpy
import subprocess
import sys
import tomllib
from contextlib import redirect_stdout
from functools import cache

import pytest
import typer
from document_inputs import NOT_RUN
from documents import PAGES, PROGRAMS, ROOT, SHELL, blocks, commands, parsed, read, typed

import consistency as cs
from consistency.bench.challenging.world_space import space_of
from consistency.bench.filters import filter_names
from consistency.bench.runs.reproduce_findings import experiments
from consistency.bench.scenario import data_folder, scenario_names
from consistency.bench.sweeps.sweep_file import load_sweep, sweep_names
from consistency.bench.types import GUARDS

PYTHON = ("python", "python notebook")
SITE = re.compile(r"\{[\w-]+\}.*")  # directives of the site
OTHERS = {"apt", "c++", "cd", "cmake", "ctest", "dask", "done", "export", "for", "my-filter", "openssl", "python3", "."}
PLACEHOLDER = re.compile(r"[A-Z][A-Z_.:|]*")
ALL = [command for page in PAGES for command in commands(page)]
OURS = [command for command in ALL if command.words[0] == "consistency"]


def of(program):
    found = [command for command in ALL if command.words[0] == program]
    assert found, program
    return found


# --- kinds -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("page", PAGES)
def test_every_block_is_of_a_known_kind(page):
    """A new kind needs a check here; what is only printed is fenced as ``text``."""
    require_known(page)


@pytest.mark.parametrize(
    "text", ["    make it so\n\n    or not\n", "```\nx\n```\n", "```json\n{}\n```\n", "    for (x\n"]
)
def test_another_kind_is_refused(text, tmp_path, monkeypatch):
    monkeypatch.setattr("documents.ROOT", tmp_path)
    (tmp_path / "page.md").write_text(f"# Page\n\n{text}")
    with pytest.raises((AssertionError, subprocess.CalledProcessError)):
        require_known("page.md")


def require_known(page):
    for block in blocks(page):
        if block.language in SHELL:
            programs = {re.sub(r"^([A-Z_]+=\S* )+", "", command.text).split()[0] for command in typed(block)}
            assert programs <= PROGRAMS | OTHERS, f"{block}: neither a command nor fenced: {programs - PROGRAMS}"
            if programs & OTHERS:
                subprocess.run(["bash", "-n"], input=block.text, text=True, check=True)
        else:
            known = {*PYTHON, *READERS, "text"}
            assert block.language in known or SITE.fullmatch(block.language), f"{block}: ```{block.language}"


# --- commands ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", OURS, ids=str)
def test_the_command_line_takes_it(command):
    words = command.words[1:]
    if words == ["--help"]:
        return
    name, values = parsed(words, whole=not (command.inline or command.synopsis))
    names_exist(name, {key: value for key, value in values.items() if value is not None})


def names_exist(name, values):
    """Filters, scenarios, sweeps and findings, unless a placeholder or a file stands for them."""
    filters = [*filter_names(), *(f"{one}+{kind}" for one in filter_names() for kind in GUARDS)]
    named = {"scenario": scenario_names(), "rig": scenario_names(), "filters": filters, "filter_name": filters}
    named |= {"only": findings()} | ({"source": sweep_names()} if name == "sweep" else {})
    if name in ("analyse", "compare", "monitor"):  # their filters are those of a file
        named = {}
    for key in named.keys() & values.keys():
        for one in values[key] if isinstance(values[key], (list, tuple)) else [values[key]]:
            known = one.endswith(".toml") or PLACEHOLDER.fullmatch(one) or one in named[key]
            assert known, f"no such name of {key}: '{one}'; near: {difflib.get_close_matches(one, named[key])}"


@cache
def findings():
    scripts = experiments()
    return [*scripts, *(finding for module in scripts.values() for finding in module.FINDINGS)]


@pytest.mark.parametrize("words", ["run herath2007-sterio --filter ekf-uvd --out o", "reproduce --only fig99",
    "run herath2007-stereo --filter ekf-uvdd --out o", "run herath2007-stereo --filter ekf-uvd --out o --runs many",
    "run herath2007-stereo --filter ekf-uvd --out o --run 5", "analise results", "sweep regimes --out o",
    "run herath2007-stereo --filter ekf-uvd --out o --runs N",
    "run herath2007-stereo --filter ekf-uvd", "tune herath2007-stereo --filter ekf"])  # fmt: skip
def test_the_command_line_does_not_take(words):
    """Negative control."""
    with pytest.raises((typer.BadParameter.__base__, AssertionError, KeyError)):
        names_exist(*parsed(words.split(), whole=True))


@pytest.mark.parametrize("command", of("make"), ids=str)
def test_make_has_the_target(command):
    makefile = (ROOT / "Makefile").read_text()
    targets, variables = re.findall(r"^([\w-]+):", makefile, re.MULTILINE), re.findall(r"\$\((\w+)\)", makefile)
    for word in command.words[1:]:
        name, set_to, _ = word.partition("=")
        assert name in (variables if set_to else targets)


@pytest.mark.parametrize("command", of("pip"), ids=str)
def test_pip_installs_what_there_is(command):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    *_, what = command.words
    what, _, address = what.partition(" @ ")
    name, _, extras = what.partition("[")
    if address:
        assert (name, address) == (project["name"], f"git+{project['urls']['Repository']}")
    else:
        assert name == "."  # the project is on no index
    assert set(extras.rstrip("]").split(",")) - {""} <= set(project["optional-dependencies"])


@pytest.mark.parametrize("command", [c for c in ALL if c.words[0] in ("bash", "pre-commit", "pytest")], ids=str)
def test_other_tools_find_their_files(command):
    program, *words = command.words
    if program == "pre-commit":
        assert (words, (ROOT / ".pre-commit-config.yaml").exists()) == (["install"], True)
    assert all((ROOT / word).exists() for word in words if "/" in word)


@pytest.mark.parametrize("command", of("python"), ids=str)
def test_the_script_is_there_and_knows_the_options(command, monkeypatch):
    _, script, *words = command.words
    if script == "-m":
        importlib.import_module(words[0])
        return
    if any(f"Save as `{script}`" in block.before for block in blocks(command.page, "python")):
        return
    assert any((folder / script).is_file() for folder in (ROOT, (ROOT / command.page).parent))
    options = [word for word in words if word.startswith("--")]
    if options:
        monkeypatch.setattr(sys, "argv", [script, "--help"])
        with redirect_stdout(io.StringIO()) as out, pytest.raises(SystemExit) as end:
            runpy.run_path(str(ROOT / script), run_name="__main__")
        assert not end.value.code
        assert set(options) <= set(re.findall(r"--[\w-]+", out.getvalue()))


# --- code --------------------------------------------------------------------------------------------------

EXCERPTS = {"docs/extending.md"}  # held against the code itself by test_extending.py


def code(block):
    """Its text; an entry of a dictionary is shown with its indentation."""
    return f"{{{block.text}}}" if block.text.startswith(" ") else block.text


@pytest.mark.parametrize("block", [b for page in PAGES for b in blocks(page, *PYTHON)], ids=str)
def test_code_compiles_and_its_names_exist(block):
    names_of_the_package(ast.parse(code(block)), block.page not in EXCERPTS)


def names_of_the_package(tree, imports=True):
    """What is imported of the package, ``cs.NAME``, and the keywords of what is called are there."""
    known = {"cs": cs}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "consistency" and imports:
            module = importlib.import_module(node.module or "")
            for alias in node.names:
                known[alias.asname or alias.name] = getattr(module, alias.name)
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "cs":
            getattr(cs, node.attr)
        if isinstance(node, ast.Call):
            called = node.func
            function = known.get(called.id) if isinstance(called, ast.Name) else None
            if isinstance(called, ast.Attribute) and isinstance(called.value, ast.Name):
                function = getattr(known.get(called.value.id), called.attr, None)
            keywords = [keyword.arg for keyword in node.keywords if keyword.arg]
            if function is not None and keywords:
                parameters = inspect.signature(function).parameters
                if not any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
                    assert set(keywords) <= set(parameters), ast.unparse(node)


@pytest.mark.parametrize("text", ["cs.load_scenarios('a')", "from consistency.testing import assert_consistency",
    "from consistency.nothing import a", "cs.run_trials(s, f, rums=3)",
    "from consistency.bench.challenging.challenge import Plan\nPlan(minute=1)"])  # fmt: skip
def test_names_that_do_not_exist_are_seen(text):
    with pytest.raises((AttributeError, ImportError, AssertionError)):
        names_of_the_package(ast.parse(text))


# --- files -------------------------------------------------------------------------------------------------

NEW_EFFECT = 'kind = "bias"'  # of docs/extending.md, where test_extending.py adds it


def reads_toml(block, folder):
    content = tomllib.loads(block.text)
    path = folder / "mine.toml"
    if "grid" in content:
        path.write_text(block.text)
        assert load_sweep(path).cells
    elif set(content) <= {"truth", "belief"}:
        scenario = (data_folder("scenarios") / "herath2007-stereo.toml").read_text(encoding="utf-8")
        path.write_text(f"{scenario}\n{block.text}", encoding="utf-8")
        if block.page == "docs/extending.md" and NEW_EFFECT in block.text:
            with pytest.raises(cs.InputError, match="'bias' is not one of"):
                cs.load_scenario(path)
        else:
            assert cs.load_scenario(path).hash != cs.load_scenario("herath2007-stereo").hash
    elif not any(isinstance(value, dict) for value in content.values()):  # bounds of the worlds of a challenge
        path.write_text(block.text)
        assert space_of(cs.load_scenario("herath2007-stereo"), [str(path)]).dimensions
    else:
        raise AssertionError(f"{block}: no reader takes the tables {set(content)}")


def reads_workflow(block, folder):
    pytest.importorskip("yaml", reason="PyYAML (the extra vision) is not installed")
    from action import require_uses

    require_uses(block.text)


READERS = {"toml": reads_toml, "yaml": reads_workflow}


@pytest.mark.parametrize("block", [b for page in PAGES for b in blocks(page, *READERS)], ids=str)
def test_a_file_is_read_by_its_reader(block, tmp_path):
    READERS[block.language](block, tmp_path)


# --- the collector -----------------------------------------------------------------------------------------

PAGE = """\
# A page

    consistency list      # all

```python notebook
    indented = 1
```

Text with `make test` and
    no block, then

    consistency run S --filter F \\
        --out DIR
    CSV=1 consistency tune S [--by a|b] [--runs 5]
                        [--json]

## Part

```text
    consistency nothing
```

    source | consistency monitor - --json
"""


def test_the_collector_sees_every_block(tmp_path, monkeypatch):
    monkeypatch.setattr("documents.ROOT", tmp_path)
    (tmp_path / "page.md").write_text(PAGE)
    assert [(block.line, block.language) for block in blocks("page.md")] == [
        (3, "indented"), (6, "python notebook"), (12, "indented"), (20, "text"), (23, "indented"),
    ]  # fmt: skip
    assert [block.language for block in blocks("page.md", part="Part")] == ["text", "indented"]
    assert [(command.line, command.words) for command in commands("page.md")] == [
        (3, ["consistency", "list"]),
        (12, ["consistency", "run", "S", "--filter", "F", "--out", "DIR"]),
        (14, ["consistency", "tune", "S", "--by", "a", "--runs", "5", "--json"]),
        (23, ["consistency", "monitor", "-", "--json"]),
        (9, ["make", "test"]),
    ]


def test_nothing_that_looks_like_a_command_is_missed():
    """Every line that begins with the name of the tool, in a block or not, is among the commands."""
    for page in PAGES:
        lines = re.findall(r"^\s*(?:\$ )?(consistency [a-z]+ .*)$", read(page), re.MULTILINE)
        seen = " ".join(command.text for command in commands(page))
        missed = [line for line in lines if line.split("#")[0].split("[")[0].rstrip("\\ ") not in seen]
        assert not missed


# --- what is not run ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("page, begin, why", NOT_RUN)
def test_what_is_not_run_is_still_in_the_documents(page, begin, why):
    found = [command.text for command in commands(page)] + [block.text for block in blocks(page, *PYTHON)]
    assert any(text.startswith(begin) for text in found)
    assert all((ROOT / path).exists() for path in re.findall(r"tests/\S+\.py", why))
