"""The command line: parses, calls, prints; no logic. ``commands`` has the table of what is loaded when it is called."""

from consistency.commands.app import app, main

__all__ = ["app", "main"]
