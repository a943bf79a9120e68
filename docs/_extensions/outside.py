"""Pages that stand beside the code are pages of the site, and links to them lead there.

A link to any other file outside docs/ keeps its text alone: the site has no page for it.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

from sphinx.application import Sphinx

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
FOLDER = DOCS / "generated"
PAGES = {
    "README.md": "generated/readme",
    "CHANGELOG.md": "generated/changelog",
    "CONTRIBUTING.md": "generated/contributing",
    "benchmarks/README.md": "generated/benchmarks",
    "experiments/README.md": "generated/experiments",
    "scenarios/README.md": "generated/scenarios",
}
LINK = re.compile(r"\[([^\]]*)\]\(([^)\s#:]+)(#[^)\s]*)?\)")


def relinked(text: str, source: Path, page: Path) -> str:
    """The text of ``source``, shown as ``page`` of the site: links lead to other pages of it."""

    def link(match: re.Match[str]) -> str:
        words, target, anchor = match[1], (source.parent / match[2]).resolve(), match[3] or ""
        if str(target.relative_to(ROOT)) in PAGES:
            target = DOCS / (PAGES[str(target.relative_to(ROOT))] + ".md")
        elif not target.is_relative_to(DOCS):
            return words
        return f"[{words}]({os.path.relpath(target, page.parent)}{anchor})"

    return LINK.sub(link, text)


def copy_pages(app: Sphinx) -> None:
    """Write the pages that are not in docs/."""
    FOLDER.mkdir(exist_ok=True)
    for name, page in PAGES.items():
        if page.startswith("generated/"):
            write_changed(DOCS / f"{page}.md", relinked((ROOT / name).read_text("utf-8"), ROOT / name, DOCS / page))


def write_changed(path: Path, text: str) -> None:
    """Leave a file alone that has the text already, so that Sphinx does not read it again."""
    if not path.exists() or path.read_text("utf-8") != text:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, "utf-8")


def relink(app: Sphinx, name: str, content: list[str]) -> None:
    """Links of the pages in docs/ that leave the folder."""
    path = DOCS / f"{name}.md"
    if path.exists() and FOLDER not in path.parents:
        content[0] = relinked(content[0], path, path)


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("builder-inited", copy_pages)
    app.connect("source-read", relink)
    return {"parallel_read_safe": True}
