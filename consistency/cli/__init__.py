"""The command line: parses, calls, prints; no logic. Every command imports what it needs when it is called."""

from consistency.cli import sweeping
from consistency.cli.app import main

__all__ = ["main", "sweeping"]  # importing sweeping registers its commands
