"""``python -m consistency`` and the command ``consistency``: the command line, in a process that can be ended."""

from typing import Any

from consistency.referee.system.ending import supervised


def main() -> Any:
    """Entry point; what takes time to import is imported where a signal can end it."""
    return supervised(_command)


def _command() -> Any:
    from consistency.referee.cli import main

    return main()


if __name__ == "__main__":
    main()
