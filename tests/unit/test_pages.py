"""The README and the pages of the documentation: how long they are, and that what they print is printed."""

import re
import runpy
import subprocess
import sys

import pytest
from documents import ROOT, blocks

from consistency.commands import main

DOCS = ROOT / "docs"
PAGES = [*DOCS.glob("*.md"), DOCS / "tutorial.ipynb"]  # that a reader is led to; docs/reference is looked up
ALL = [*DOCS.glob("*.md"), *DOCS.glob("reference/*.md")]
EXAMPLE = DOCS / "examples/repository"


def test_the_readme_is_short():
    assert (ROOT / "README.md").read_text("utf-8").count("\n") <= 110


def test_pages_are_few_and_short():
    assert len(PAGES) <= 25
    for page in DOCS.glob("*.md"):
        text = page.read_text("utf-8")
        assert text.count("\n") <= 250, page
        assert len(text.split()) <= 3000, page
    written = [
        re.sub(r"<!-- (\w+): begin -->.*<!-- \1: end -->", "", p.read_text("utf-8"), flags=re.DOTALL) for p in ALL
    ]
    assert sum(len(text.split()) for text in written) <= 70_000  # beside the tables that benchmarks write


@pytest.mark.parametrize("fix", ["0.3", "0.2"], ids=["as it is", "trusts its fixes too much"])
def test_the_readme_prints_what_is_printed(fix, tmp_path, monkeypatch, capsys):
    (tmp_path / "cart").mkdir()
    for name in ("simulate.py", "cart/__init__.py", "cart/world.py", "cart/ekf.py"):
        text = (EXAMPLE / name).read_text("utf-8")
        (tmp_path / name).write_text(re.sub(r"^SIGMA_FIX = 0\.3", f"SIGMA_FIX = {fix}", text, flags=re.MULTILINE))
    monkeypatch.chdir(tmp_path)
    subprocess.run([sys.executable, "simulate.py"], check=True)
    with pytest.raises(SystemExit):
        main(["analyse", "estimates.csv", "--truth", "truth.csv"])
    printed = " ".join(capsys.readouterr().out.split())
    shown = [block.text.strip().removesuffix("...").strip() for block in blocks("README.md", "text")]
    assert shown[0 if fix == "0.3" else 1] in printed


def test_the_commands_of_the_readme_are_those_that_ci_runs():
    done = subprocess.run([sys.executable, ROOT / ".ci/readme"], capture_output=True, text=True, check=True)
    _, first, second = (block for block in blocks("README.md", "indented") if block.part == "First verdict")
    typed = (first.text + second.text).replace(
        "https://github.com/OWNER/filter-consistency", f"file://{ROOT} filter-consistency"
    )
    assert done.stdout.split("\n") == [line for line in typed.split("\n") if line] + [""]


def test_documents_have_the_address_of_the_project():
    """Set in pyproject.toml; `python docs/address.py` writes it into them."""
    address = runpy.run_path(str(DOCS / "address.py"))
    for document in address["DOCUMENTS"]:
        text = (ROOT / document).read_text("utf-8")
        assert address["addressed"](text, address["repository"]()) == text, document
    assert f"git clone https://github.com/{address['repository']()}\n" in (ROOT / "README.md").read_text("utf-8")
    moved = address["addressed"]("git clone https://github.com/OWNER/filter-consistency\n", "us/filter-consistency")
    assert moved == "git clone https://github.com/us/filter-consistency\n"
