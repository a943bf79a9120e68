"""The boundary of files: whatever one holds, it is read, or refused in one sentence."""

from __future__ import annotations

import json
import re
import traceback
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from consistency.referee.errors import InputError

LARGEST = 32 * 2**20  # bytes of TOML, JSON and YAML, which take up to 30 times as much memory
UNFOLDED = 2**29  # bytes that an archive or a table may always take in memory
FOLDED = 100  # how many times as large as its file, beyond that; numbers of a sensor hardly compress
HUGE = 1e30  # m, s or px; what is measured is smaller, and a NEES of such numbers is finite, and so is its square
MOST_DOF = 2.0**31  # degrees of freedom in a step, whose sums then are exact
LARGEST_NUMBER = HUGE**2  # that a filter may say, or a NEES be; sums of squares of such numbers are finite
WHOLE = 2**53  # beyond it a floating-point number counts no more
DEEPEST = 64  # parts of a dotted key
_PART = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""  # its possessive quantifiers need Python 3.11
UNPRINTABLE = {"Cc", "Cs", "Zl", "Zp"}  # categories of Unicode: control, surrogate, ends of lines and paragraphs
PROGRAMMING = (NameError, TypeError, AttributeError, IndexError)  # of others what a file holds may be the cause
PACKAGE = Path(__file__).parents[1]
TURNING = {"LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI"}  # what follows is shown in another order
_SHOWN = 160  # characters of a parser's own words


@contextmanager
def reading(path: Path | str, refusal: str = "cannot be read, damaged or cut short") -> Iterator[None]:
    """Whatever a parser raises of the file ``path``, as one sentence that names it.

    Parsers of formats that others define raise almost anything of a damaged or hostile file, so that the list of what
    is caught is not closed. Programming errors that a line of this package raises pass. Only calls of parsers belong
    inside.

    Raises
    ------
    InputError
        In place of any exception of a library, and of any but :data:`PROGRAMMING` errors of this package.
    """
    try:
        yield
    except InputError:
        raise
    except OSError as error:
        what = f"cannot be read ({error.strerror})" if error.strerror else f"{refusal} ({one_line(error)})"
        raise InputError(f"{path}: {what}") from None
    except RecursionError:
        raise InputError(f"{path}: {refusal} (nested too deep)") from None
    except MemoryError:
        raise InputError(f"{path}: {refusal} (it would take more memory than there is)") from None
    except Exception as error:
        if isinstance(error, PROGRAMMING) and _is_ours(error):
            raise
        raise InputError(f"{path}: {refusal} ({_said(error)})") from None


def _is_ours(error: Exception) -> bool:
    """Whether a line of this package raised it, not one of a library."""
    frames = list(traceback.walk_tb(error.__traceback__))
    return Path(frames[-1][0].f_code.co_filename).is_relative_to(PACKAGE)


def _said(error: Any) -> str:
    """What a parser says; pydantic's first complaint, with its key."""
    if type(error).__name__ != "ValidationError" or not hasattr(error, "errors"):
        return one_line(error) or type(error).__name__
    first = error.errors(include_input=False, include_url=False)[0]
    return f"key '{one_line('.'.join(map(str, first['loc'])))}': {one_line(first['msg'])}"


def one_line(value: object, longest: int = _SHOWN) -> str:
    """Text on one line, without control characters, cut short."""
    text = "".join(char if char.isprintable() else " " for char in str(value)[: 4 * longest])
    text = " ".join(text.split())
    return text if len(text) <= longest else f"{text[: longest - 1]}…"


def require_name(name: str, where: str) -> str:
    """A name of something, as it is, which can be printed: on one line, in its order, and to a terminal.

    Raises
    ------
    InputError
        It has a line break or another control character, also one that turns the direction of text (U+202E).
    """
    if any("\udc80" <= char <= "\udcff" for char in name):  # bytes that the locale does not know
        locale = "set PYTHONUTF8=1 or a UTF-8 locale such as LC_ALL=C.UTF-8"
        raise InputError(f"{where}: the name {one_line(ascii(name), 60)} is not text in this locale; {locale}")
    if any(unicodedata.category(char) in UNPRINTABLE or unicodedata.bidirectional(char) in TURNING for char in name):
        raise InputError(f"{where}: the name {one_line(ascii(name), 60)} has a control character; rename it")
    return name


def is_file(path: Path) -> bool:
    """Whether a file is there; False of a name that no file can have."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def is_folder(path: Path) -> bool:
    """Whether a folder is there; False of a name that no folder can have."""
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False


def read_text(path: Path, refusal: str, largest: int = LARGEST) -> str:
    """All of a text file.

    Raises
    ------
    InputError
        It is missing, no file (a pipe would be waited for), no text, or larger than ``largest`` bytes.
    """
    with reading(path, refusal):
        size = path.stat().st_size
        if not path.is_file():
            raise InputError(f"{path}: is {'a folder' if path.is_dir() else 'a device'}, not a file")
        if size > largest:
            raise InputError(f"{path}: has {size / 2**20:.0f} MiB; at most {largest / 2**20:.0f} MiB are read")
        return path.read_text(encoding="utf-8")


def read_toml(path: Path) -> dict[str, Any]:
    """A TOML file as nested tables; raises :class:`InputError`."""
    text = read_text(path, "not valid TOML")
    with reading(path, "not valid TOML"):
        import tomllib  # type: ignore[import-not-found, unused-ignore]  # which Python 3.10 lacks

        deep = rf"(?<![\w-]){_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{{DEEPEST}}}"
        if re.search(deep, text):  # the parser would take memory by the square of their number
            raise InputError(f"{path}: not valid TOML (a key of more than {DEEPEST} parts)")
        tables: dict[str, Any] = tomllib.loads(text)
        return tables


def read_json(path: Path) -> Any:
    """What a JSON file holds, with every key given once; raises :class:`InputError`."""
    text = read_text(path, "not valid JSON")
    with reading(path, "not valid JSON"):
        return json.loads(text, object_pairs_hook=keys_once)


def keys_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON; a key that is given twice is refused."""
    table = dict(pairs)
    if len(table) < len(pairs):
        names = [key for key, _ in pairs]
        twice = next(key for key in names if names.count(key) > 1)
        raise ValueError(f"key '{twice}' is given twice")
    return table


def require_room(path: Path, unfolded: int) -> None:
    """Refuse a file whose content, ``unfolded`` bytes in memory, is out of all proportion to its size.

    Raises
    ------
    InputError
        It would take more than 0.5 GiB, and more than a hundred times the size of the file.
    """
    size = path.stat().st_size
    if unfolded > max(UNFOLDED, FOLDED * size):
        raise InputError(
            f"{path}: would take {unfolded / 2**30:.3g} GiB in memory, from a file of {size / 2**20:.2g} MiB; more "
            f"than {FOLDED} times the size of the file is taken for damage"
        )
