"""The shape of the package: for each root its rooms, modules and lines, and what it imports of the other roots.

python docs/house.py            # prints the table
python docs/house.py --write    # replaces the one in docs/architecture.md, whose lines are in thousands
"""

from __future__ import annotations

import ast
import sys
from collections import Counter
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "consistency"
PAGE = Path(__file__).with_name("architecture.md")
BEGIN, END = "<!-- house: begin -->\n", "<!-- house: end -->\n"
ROOTS = ("referee", "bench", "stereo")


def imported(path: Path) -> Counter[str]:
    """Import statements of a module by the root of the package that they name."""
    found: Counter[str] = Counter()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        found.update(parts[1] for name in names if (parts := name.split("."))[0] == "consistency" and len(parts) > 1)
    return found


def table(exact: bool) -> str:
    """Rows of Markdown; lines in thousands unless they are wanted ``exact``, so that few changes change the page."""
    rows = ["| root | rooms | modules | lines | imports of the other roots |", "| --- | --- | --- | --- | --- |"]
    for root in ROOTS:
        modules = sorted((PACKAGE / root).rglob("*.py"))
        rooms = sorted(
            {path.relative_to(PACKAGE / root).parts[0].removesuffix(".py") for path in modules} - {"__init__"}
        )
        lines = sum(path.read_text(encoding="utf-8").count("\n") for path in modules)
        others = sum((imported(path) for path in modules), Counter[str]())
        of_others = ", ".join(
            f"{other}{f' {others[other]}' if exact else ''}" for other in ROOTS if other != root and others[other]
        )
        size = f"{lines}" if exact else f"{lines / 1000:.0f} k"
        rows.append(f"| `{root}` | {', '.join(rooms)} | {len(modules)} | {size} | {of_others or 'none'} |")
    return "\n".join(rows) + "\n"


def main() -> None:
    """Print, or write."""
    if "--write" in sys.argv[1:]:
        head, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
        PAGE.write_text(head + BEGIN + "\n" + table(exact=False) + "\n" + END + rest.split(END)[1], encoding="utf-8")
    else:
        print(table(exact=True), end="")


if __name__ == "__main__":
    main()
