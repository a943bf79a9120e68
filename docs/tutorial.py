"""Executes the tutorial in an empty folder: `python docs/tutorial.py` stores its outputs, half a minute."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).with_suffix(".ipynb")


def executed() -> Any:
    """The notebook with the outputs of now, without progress and dates."""
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        NotebookClient(notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": folder}}).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        if cell.cell_type == "code":
            cell.outputs = [output for output in cell.outputs if output.get("name") != "stderr"]
    return notebook


def texts(notebook: Any) -> list[str]:
    """What each code cell prints or shows as text; of a picture its presence."""
    return ["".join(shown(output) for output in cell.outputs) for cell in notebook.cells if cell.cell_type == "code"]


def shown(output: Any) -> str:
    """Text of one output."""
    data = output.get("data", {})
    return "<picture>" if "image/png" in data else str(output.get("text") or data.get("text/plain", ""))


if __name__ == "__main__":
    nbformat.write(executed(), NOTEBOOK)
