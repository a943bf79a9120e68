"""The command line: parses, calls, prints; no logic. Every command imports what it needs when it is called."""

from consistency.cli import challenging, characterising, sweeping, tuning
from consistency.cli.app import main

__all__ = [
    "challenging",
    "characterising",
    "main",
    "sweeping",
    "tuning",
]  # importing the modules registers their commands
