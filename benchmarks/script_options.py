"""Options of the scripts of this folder, as a table."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any


def options_of(doc: str | None, given: Sequence[str] | None = None, /, **table: tuple[Any, ...]) -> argparse.Namespace:
    """Values of options that are given by default, help and, where needed, further keys of ``add_argument``.

    A type in place of a default is one without a default, and False is that of a switch.
    """
    formatter = argparse.RawDescriptionHelpFormatter if "\n" in (doc or "") else argparse.HelpFormatter
    parser = argparse.ArgumentParser(description=doc, formatter_class=formatter)
    for name, (default, text, *further) in table.items():
        keys: dict[str, Any] = {"type": type(default), "default": default}
        if default is False:
            keys = {"action": "store_true"}
        elif isinstance(default, type):
            keys = {"type": default}
        parser.add_argument(f"--{name.replace('_', '-')}", help=text, **keys, **(further[0] if further else {}))
    return parser.parse_args(given)
