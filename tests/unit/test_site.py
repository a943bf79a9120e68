"""The documentation site: its extensions, the check of what was built, and the tutorial."""

import importlib.util
import inspect
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import nbformat
import pytest
from matplotlib.figure import Figure

import consistency
from consistency import diagnostics, testing, vision
from consistency.commands.app import COMMANDS

DOCS = Path(__file__).parents[2] / "docs"


def load(path, monkeypatch=None):
    name = Path(path).stem
    spec = importlib.util.spec_from_file_location(name, DOCS / path)
    module = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(DOCS / "_extensions"))
    try:
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(DOCS / "_extensions"))
    return module


check, tutorial = load("check.py"), load("tutorial.py")
commands, docstrings, figures, outside = (
    load(f"_extensions/{name}.py") for name in ("commands", "docstrings", "figures", "outside")
)


# --- what was built ----------------------------------------------------------------------------------


def site(folder, body, style=""):
    (folder / "index.html").write_text(f'<h1 id="top">Site</h1><link rel="stylesheet" href="a.css">{body}', "utf-8")
    (folder / "other page.html").write_text('<p id="part">text</p><a href="index.html#top">up</a>', "utf-8")
    (folder / "a.css").write_text(style, "utf-8")
    (folder / "a.png").write_bytes(b"")
    return folder


SOUND = (
    '<a href="other%20page.html#part">a</a><a href="#top">b</a><a href="https://example.org/x">c</a>'
    '<img src="a.png"><img src="data:image/png;base64,AA"><a href="mailto:a@example.org">d</a>'
)


def test_a_sound_site_has_no_fault(tmp_path):
    assert check.faults(site(tmp_path, SOUND, "b { background: url('data:image/png;base64,AA') }")) == []


@pytest.mark.parametrize(
    "body, style, fault",
    [
        ('<a href="gone.html">x</a>', "", "index.html: gone.html is not there"),
        ('<a href="other%20page.html#gone">x</a>', "", "index.html: other%20page.html#gone leads to no anchor"),
        ('<a href="#gone">x</a>', "", "index.html: #gone leads to no anchor"),
        ('<img src="gone.png">', "", "index.html: gone.png is not there"),
        ('<img src="a.png" srcset="a.png 1x, gone.png 2x">', "", "index.html: gone.png is not there"),
        ('<script src="https://cdn.example/x.js"></script>', "", "loads https://cdn.example/x.js from the network"),
        ('<script src="//cdn.example/x.js"></script>', "", "loads //cdn.example/x.js from the network"),
        ('<link rel="stylesheet" href="http://a.example/x.css">', "", "loads http://a.example/x.css from the network"),
        ('<img src="https://a.example/x.png">', "", "loads https://a.example/x.png from the network"),
        ('<p style="background: url(https://a.example/x.png)">', "", "loads https://a.example/x.png from the network"),
        ("", "@import 'https://fonts.example/a.css';", "a.css: loads https://fonts.example/a.css from the network"),
        ("", "b { src: url(gone.woff2) }", "a.css: gone.woff2 is not there"),
    ],
)
def test_a_fault_of_the_site_is_named(tmp_path, body, style, fault):
    (found,) = check.faults(site(tmp_path, SOUND + body, style))
    assert fault in found


def test_an_empty_folder_is_no_site(tmp_path):
    (found,) = check.faults(tmp_path)
    assert "make docs" in found


# --- pages -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "source, page, link, expected",
    [
        (
            "docs/laboratory.md",
            "docs/laboratory.md",
            "[a](../scenarios/README.md#keys)",
            "[a](generated/scenarios.md#keys)",
        ),
        ("docs/laboratory.md", "docs/laboratory.md", "[a](files.md#b)", "[a](files.md#b)"),
        ("docs/laboratory.md", "docs/laboratory.md", "[`x`](../consistency/bench/types.py)", "`x`"),
        ("docs/laboratory.md", "docs/laboratory.md", "[a](https://example.org/b.md)", "[a](https://example.org/b.md)"),
        (
            "scenarios/README.md",
            "docs/generated/scenarios",
            "[a](../docs/reference/sensor.md#b)",
            "[a](../reference/sensor.md#b)",
        ),
        ("scenarios/README.md", "docs/generated/scenarios", "[a](../experiments/README.md)", "[a](experiments.md)"),
        ("CONTRIBUTING.md", "docs/generated/contributing", "[a](LICENSE)", "a"),
        ("README.md", "docs/generated/readme", "![a](docs/images/regime.png)", "![a](../images/regime.png)"),
        ("docs/laboratory.md", "docs/laboratory.md", "[a](../README.md#b)", "[a](generated/readme.md#b)"),
    ],
)
def test_links_lead_to_pages_of_the_site(source, page, link, expected):
    root = DOCS.parent
    assert outside.relinked(f"See {link}.", root / source, root / page) == f"See {expected}."


def test_every_command_has_a_page_with_its_examples(tmp_path, monkeypatch):
    monkeypatch.setattr(commands, "FOLDER", tmp_path)
    commands.write_commands(SimpleNamespace())
    pages = {path.stem: path.read_text("utf-8") for path in (tmp_path / "commands").glob("*.md")}
    index = pages.pop("index")
    assert set(pages) == set(COMMANDS)
    for name, text in pages.items():
        assert f"[{name}]({name}.md)" in index
        assert text.startswith(f"# consistency {name}\n")
        assert "**Options**" in text
        assert "\x08" not in text
        for line in COMMANDS[name].examples:
            assert f"$ consistency {line}\n" in text
    assert "dask or slurm ([docs/long-runs.md](../../long-runs.md))" in pages["run"]
    assert "Run until the verdict is clear, instead of `--runs`." in pages["run"]


# --- reference ---------------------------------------------------------------------------------------


def documented():
    names = set()
    for page in (DOCS / "api").glob("*.md"):
        module = "consistency"
        for kind, name in re.findall(r"^\.\. (\w+):: (\S+)", page.read_text("utf-8"), re.MULTILINE):
            if kind == "currentmodule":
                module = name
            elif kind.startswith("auto") and kind != "automodule":
                names.add(name if name.startswith("consistency.") else f"{module}.{name}")
        for module, members in re.findall(r"automodule:: (\S+)\n   :members: (.*)", page.read_text("utf-8")):
            names |= {f"{module}.{name}" for name in members.split(", ")}
    return names


def test_every_public_name_stands_in_the_reference():
    """Once: those of the package stand there under its name, and nowhere else."""
    gates = [name for name, value in vars(testing).items() if getattr(value, "__module__", "") == testing.__name__]
    public = {f"consistency.{name}" for name in consistency.__all__}
    public |= {f"consistency.testing.{name}" for name in gates if not name.startswith("_")}
    public |= {f"consistency.vision.{name}" for name in vision.__all__}
    at_top = {id(getattr(consistency, name)) for name in consistency.__all__}
    public |= {
        f"consistency.diagnostics.{name}"
        for name in diagnostics.__all__
        if id(getattr(diagnostics, name)) not in at_top
    }
    assert public - documented() == set()


def test_what_a_guide_imports_stands_in_the_reference():
    """Except for the guide to what is inside."""
    missing = {}
    for page in set(DOCS.glob("*.md")) - {DOCS / "extending.md", DOCS / "architecture.md"}:
        for block in re.findall(r"^```python\n(.*?)^```", page.read_text("utf-8"), re.MULTILINE | re.DOTALL):
            for module, names in re.findall(r"^from (consistency\S*) import ([^#\n]*)", block, re.MULTILINE):
                imported = {f"{module}.{name.strip()}" for name in names.split(",")}
                missing |= dict.fromkeys(imported - documented(), page.name)
    assert missing == {}


def described(text, what="function"):
    lines = inspect.cleandoc(text).split("\n")
    docstrings.describe(None, what, "name", None, None, lines)
    return lines


def test_a_parameter_keeps_its_shape_in_the_description():
    lines = described(
        """Title.

        Parameters
        ----------
        errors, P : (runs, n), truth minus estimate; (runs, n, n),
            in squared units

        Returns
        -------
        What there is: all of it

        Raises
        ------
        ValueError
            A : B. See docs/files.md.

        >>> 1
        1
        """
    )
    at = lines.index("errors, P")
    assert lines[at + 1 : at + 3] == ["    (runs, n), truth minus estimate; (runs, n, n),", "    in squared units"]
    assert ": What there is: all of it" in lines
    assert "    A : B. See :doc:`docs/files.md </files>`." in lines
    assert lines[lines.index(">>> 1") - 2] == "Examples"


def test_the_comment_of_a_field_is_its_description():
    from sphinx.pycode import parser

    pattern, connected = parser.comment_re, []
    try:
        docstrings.setup(SimpleNamespace(connect=lambda event, call, priority: connected.append(call.__name__)))
        read = parser.Parser("class A:\n    x: int  # (n,), of all: m\n")
        read.parse()
        assert read.comments == {("A", "x"): "(n,), of all: m"}
    finally:
        parser.comment_re = pattern
    assert connected == ["describe", "hide", "show"]


def test_the_sentence_of_a_field_is_not_taken_apart():
    for what, between in (("attribute", []), ("property", []), ("function", ["a: b"])):
        lines = ["a: b"]
        docstrings.hide(None, what, "x", None, None, lines)
        assert lines == between
        docstrings.show(None, what, "x", None, None, lines)
        assert lines == ["a: b"]


# --- figures -----------------------------------------------------------------------------------------


def test_a_figure_is_saved_once(tmp_path):
    found = {"figure": Figure()}
    block_vars = {"example_globals": found, "image_path_iterator": iter([tmp_path / "a.png"])}
    text = figures.figure_scraper(None, block_vars, {"src_dir": str(tmp_path)})
    assert "a.png" in text
    assert (tmp_path / "a.png").stat().st_size > 0
    assert figures.figure_scraper(None, block_vars, {"src_dir": str(tmp_path)}) == ""


@pytest.mark.parametrize("script", sorted((DOCS / "gallery").glob("plot_*.py")), ids=lambda path: path.stem)
def test_a_script_stands_by_itself_and_leaves_a_figure(script):
    """Title, what it shows, public imports alone; the site runs them all."""
    text = script.read_text("utf-8")
    assert re.match(r'"""\n(.+)\n=+\n\n[^"]+\n"""\n', text)
    assert re.search(r"^figure(, .*)? = ", text, re.MULTILINE)
    modules = re.findall(r"^(?:from|import) (consistency\S*)", text, re.MULTILINE)
    public = {
        "consistency",
        "consistency.diagnostics",
        "consistency.sweeps",
        "consistency.vision",
    }
    assert set(modules) <= public


def test_pictures_of_the_readme_are_figures_of_the_gallery():
    shown = set(re.findall(r"\(docs/images/([\w-]+)\.png\)", (DOCS.parent / "README.md").read_text("utf-8")))
    drawn = {name.replace("_", "-") for name in load("pictures.py").PICTURES}
    assert shown <= drawn
    assert drawn <= {path.stem.removeprefix("plot_").replace("_", "-") for path in (DOCS / "gallery").glob("plot_*.py")}


# --- tutorial ----------------------------------------------------------------------------------------


def test_the_tutorial_is_stored_as_it_was_executed():
    cells = [cell for cell in nbformat.read(tutorial.NOTEBOOK, as_version=4).cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert {output.output_type for cell in cells for output in cell.outputs} <= {
        "stream",
        "display_data",
        "execute_result",
    }
    assert {output.get("name", "stdout") for cell in cells for output in cell.outputs} == {"stdout"}


@pytest.mark.slow
def test_the_tutorial_says_what_it_is_stored_with():
    stored = nbformat.read(tutorial.NOTEBOOK, as_version=4)
    assert tutorial.texts(tutorial.executed()) == tutorial.texts(stored)
