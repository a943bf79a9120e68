"""``python -m consistency`` and the command ``consistency``: the command line, in a process that can be ended."""

import gc
from typing import Any

from consistency.referee.system.stopping import supervised


def main() -> Any:
    """Entry point; what takes time to import is imported where a signal can end it."""
    return supervised(_command)


def _command() -> Any:
    gc.set_threshold(50_000, 20, 100)  # most of what is made lives as long as the modules that are imported
    from consistency.commands import main

    return main()


if __name__ == "__main__":
    main()
