"""Checks the built site: `python docs/check.py docs/_build/html` names what is dead or loaded from the network."""

from __future__ import annotations

import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

IN_CSS = re.compile(r"url\(\s*['\"]?([^'\")]+)|@import\s+['\"]([^'\"]+)")


class Page(HTMLParser):
    """Ids of a page, its links, and what it loads."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.links: list[str] = []
        self.loads: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        given = {name: value for name, value in attributes if value}
        self.ids.add(given.get("id", ""))
        if tag == "a":
            self.links += [given["href"]] if "href" in given else []
            return
        self.loads += [given[name] for name in ("src", "href", "poster", "data") if name in given]
        self.loads += [source.split()[0] for source in given.get("srcset", "").split(",") if source.strip()]
        self.loads += in_css(given.get("style", ""))


def in_css(text: str) -> list[str]:
    """What a style sheet loads; data that it brings along is no file."""
    return [one or other for one, other in IN_CSS.findall(text)]


def faults(site: Path) -> list[str]:
    """Dead links, anchors and files, and whatever is loaded from the network; a line each."""
    pages = {
        path: Page(path.read_text("utf-8")) for path in sorted(site.rglob("*.html")) if "_static" not in path.parts
    }
    if site / "index.html" not in pages:
        return [f"{site}: has no index.html; build it first: make docs"]
    sheets = {path: in_css(path.read_text("utf-8")) for path in sorted(site.rglob("*.css"))}
    found = []
    for path, page in pages.items():
        found += [fault(site, path, target, pages) for target in page.links if not is_remote(target)]
        found += [loading(site, path, target) for target in page.loads]
    for path, loads in sheets.items():
        found += [loading(site, path, target) for target in loads]
    return sorted({line for line in found if line})


def is_remote(target: str) -> bool:
    """Whether a link leaves the site, by design."""
    return urlsplit(target).scheme in ("http", "https", "mailto")


def loading(site: Path, path: Path, target: str) -> str:
    """What is wrong with a picture, a script, a style or a font."""
    if target.startswith(("data:", "#")):
        return ""
    if is_remote(target) or target.startswith("//"):
        return f"{path.relative_to(site)}: loads {target} from the network"
    return fault(site, path, target, {})


def fault(site: Path, path: Path, target: str, pages: dict[Path, Page]) -> str:
    """What is wrong with a link to a file of the site, and to an anchor in it."""
    parts = urlsplit(target)
    found = (path.parent / unquote(parts.path)).resolve() if parts.path else path
    if not found.is_file():
        return f"{path.relative_to(site)}: {target} is not there"
    if found in pages and parts.fragment and unquote(parts.fragment) not in pages[found].ids:
        return f"{path.relative_to(site)}: {target} leads to no anchor"
    return ""


def main() -> None:
    found = faults(Path(sys.argv[1]).resolve())
    print("\n".join(found) or "every link and file of the site is there, and nothing is loaded from the network")
    raise SystemExit(bool(found))


if __name__ == "__main__":
    main()
