"""The scripts of ``experiments/`` as modules."""

from pathlib import Path

from consistency.bench.runs.reproduce_findings import figure_scripts, sibling

FOLDER = Path(__file__).parents[2] / "experiments"


def experiment(name):
    """A fresh module of a script, by its name without the suffix."""
    return sibling(str(FOLDER / "README.md"), name)


def figures(name):
    """The module of a script in ``experiments/figures``."""
    return figure_scripts()[name]
