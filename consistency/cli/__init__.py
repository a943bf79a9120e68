"""The command line: parses, calls, prints; no logic. Every command imports what it needs when it is called."""

from consistency.cli import challenging, characterising, compiling, sweeping, tuning
from consistency.cli.app import app, main
from consistency.cli.examples import show_examples

__all__ = [
    "challenging",
    "characterising",
    "compiling",
    "main",
    "sweeping",
    "tuning",
]  # importing the modules registers their commands

show_examples(app)
