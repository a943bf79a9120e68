"""Docstrings and comments of the project as autodoc and napoleon expect them.

- ``name : (runs, n), what it is`` describes a parameter; napoleon would take it for the name of a type.
- A doctest below the last section is an example.
- A page that is named becomes a link to it.
- The comment behind a field is its description, without the colon of ``#:``. A colon in it is one of a sentence;
  napoleon would take what is before it for a type.
"""

from __future__ import annotations

import re
from typing import Any

from sphinx.application import Sphinx
from sphinx.pycode import parser

NAMES = ("Parameters", "Other Parameters", "Attributes")
RESULTS = ("Returns", "Yields")
PAGE = re.compile(r"\bdocs/([\w/-]+)\.md")
FIELDS = ("attribute", "data", "property")
RULE = re.compile(r"-{3,}\s*$")


def describe(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Put the description of a parameter below its name; a result needs no name."""
    section, lines_out = "", []
    for i, line in enumerate(lines):
        if i + 1 < len(lines) and RULE.match(lines[i + 1]):
            section = line.strip()
        elif line.startswith(">>> ") and section:
            section, lines_out = "", [*lines_out, "Examples", "--------"]
        entry = re.match(r"(\S.*?) : (.*)", line)
        if section in NAMES and entry:
            lines_out += [entry[1], f"    {entry[2]}"]
        elif section in RESULTS and line.strip() and line.strip() not in RESULTS and not RULE.match(line):
            lines_out += [line if line.startswith(" ") else f": {line}"]
        else:
            lines_out.append(line)
    lines[:] = [PAGE.sub(r":doc:`\g<0> </\1>`", line) for line in lines_out]


def hide(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Keep the sentence of a field from napoleon, which comes next."""
    if what in FIELDS:
        hidden[name], lines[:] = list(lines), []


def show(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Bring it back."""
    if what in FIELDS:
        lines[:] = hidden.pop(name)


hidden: dict[str, list[str]] = {}


def setup(app: Sphinx) -> dict[str, bool]:
    parser.comment_re = re.compile(r"^\s*#:? ?(.*)\r?\n?$")
    app.connect("autodoc-process-docstring", describe, priority=400)
    app.connect("autodoc-process-docstring", hide, priority=401)
    app.connect("autodoc-process-docstring", show, priority=600)
    return {"parallel_read_safe": True}
