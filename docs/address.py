"""Write the repository's address of pyproject.toml into the documents that name it: `python docs/address.py`."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
DOCUMENTS = (
    "README.md",
    "docs/gates.md",
    "docs/packaging/conda/meta.yaml",
    "docs/examples/repository/README.md",
    "docs/examples/repository/.github/workflows/consistency.yml",
)
REPOSITORY = re.compile(r"[\w.-]+/filter-consistency(?=$|[\s`/\x22])", re.MULTILINE)  # OWNER/NAME, as in an address


def repository() -> str:
    """OWNER/NAME of [project.urls]."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    (found,) = re.findall(r'^Repository = "https://github\.com/([^"]+)"$', text, re.MULTILINE)
    return str(found)


def addressed(text: str, name: str) -> str:
    """The text with ``name`` wherever it names the repository."""
    return REPOSITORY.sub(name, text)


if __name__ == "__main__":
    for document in DOCUMENTS:
        path = ROOT / document
        path.write_text(addressed(path.read_text(encoding="utf-8"), repository()), encoding="utf-8")
