"""The command line: parses, calls, prints; no logic. Every command imports what it needs when it is called."""

from consistency.cli import challenging, sweeping
from consistency.cli.app import main

__all__ = ["challenging", "main", "sweeping"]  # importing the two modules registers their commands
