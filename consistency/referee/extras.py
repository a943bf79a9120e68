"""Optional packages: which of an extra are missing here, and the one sentence that says how to install them.

What an extra brings stands in pyproject.toml alone; it is read from the metadata of the installed package, which takes
some 25 ms, so that nothing asks for it unless an extra is needed.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from consistency.referee.errors import InputError

DISTRIBUTION = "filter-consistency"
IMPORT_NAMES = {"opencv-python-headless": "cv2", "pyyaml": "yaml", "tomli-w": "tomli_w"}  # where they differ
PYTHON_OF_BENCH = (3, 11)  # needed by its SciPy, while the core keeps to an older one
COLLECTIONS = {"all", "dev", "docs"}  # extras that collect others, and that no sentence should name
REQUIREMENT = re.compile(r"(?P<package>[\w.-]+)(>=(?P<floor>[\d.]+))?; extra == ['\"](?P<extra>[\w-]+)['\"]")


class MissingPackageError(InputError, ImportError):
    """An optional package is not installed: says which, and how to install it."""


class Requirement(NamedTuple):
    """A package of an extra, and the oldest version that will do."""

    package: str
    floor: str

    @property
    def module(self) -> str:
        return IMPORT_NAMES.get(self.package, self.package)

    @property
    def is_found(self) -> bool:
        return find_spec(self.module) is not None

    @property
    def is_met(self) -> bool:
        if not self.is_found:
            return False
        from importlib.metadata import version

        return _numbers(version(self.package)) >= _numbers(self.floor)

    @property
    def text(self) -> str:
        """The package, with its floor where an older one is installed."""
        return f"{self.package}>={self.floor}" if self.is_found and self.floor else self.package


def requirements(*extras: str) -> list[Requirement]:
    """Return what extras bring, one extra after the other; nothing where this package is not installed."""
    if not extras:
        return []
    from importlib.metadata import PackageNotFoundError, requires

    try:
        lines = requires(DISTRIBUTION) or []
    except PackageNotFoundError:
        return []
    brought: dict[str, list[Requirement]] = {extra: [] for extra in extras}
    for line in lines:
        match = REQUIREMENT.fullmatch(line)
        if match is not None and match["extra"] in brought:
            brought[match["extra"]].append(Requirement(match["package"], match["floor"] or ""))
    return list(dict.fromkeys(chain.from_iterable(brought.values())))


def missing(*extras: str) -> list[str]:
    """Return the requirements of extras that are not met here."""
    return [requirement.text for requirement in requirements(*extras) if not requirement.is_met]


@cache
def is_installed(extra: str) -> bool:
    """Return whether all packages of an extra are found, of whatever version."""
    return all(requirement.is_found for requirement in requirements(extra))


def require(what: str, *extras: str) -> None:
    """Refuse ``what``, before any work, where packages of the extras are missing.

    Raises
    ------
    MissingPackageError
        Names the packages and how to install them.
    """
    if missing(*extras):
        raise MissingPackageError(f"{what} needs {remedy(*extras)}")


def remedy(*extras: str, package: str = "") -> str:
    """Say what is missing of extras, and how to install it: ``numba, joblib: pip install numba joblib``.

    Parameters
    ----------
    package : the one that could not be loaded, to be named even if it is there
    """
    from shlex import join

    needed = requirements(*extras)
    here = sys.version_info[:2]
    if here < PYTHON_OF_BENCH and set(requirements("bench")) <= set(needed):
        least, this = (".".join(map(str, version)) for version in (PYTHON_OF_BENCH, here))
        return f"Python {least} or later; this is {this}"
    lacking = missing(*extras) or [package or ",".join(extras)]
    return f"{', '.join(lacking)}: pip install {join(_from_origin(extras) or lacking)}"


def explained(error: ModuleNotFoundError, what: str) -> MissingPackageError | None:
    """Return the sentence of :func:`require` for an import that failed; None if no extra lacks the module."""
    from importlib.metadata import PackageNotFoundError, metadata

    module = (error.name or "").partition(".")[0]
    try:
        extras = metadata(DISTRIBUTION).get_all("Provides-Extra") or []
    except PackageNotFoundError:
        return None
    for extra in extras:
        lacking = [each for each in requirements(extra) if not each.is_met]
        if extra not in COLLECTIONS and any(each.module == module for each in lacking):
            return MissingPackageError(f"{what} needs {remedy(extra)}")
    return None


@contextmanager
def explained_import(what: str) -> Iterator[None]:
    """Say which extra ``what`` needs, where a package of it cannot be imported."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise explained(error, what) or error from None


def _numbers(version: str) -> list[int]:
    """Return the numbers that a version begins with: 1, 16 and 0 of ``1.16.0rc1``."""
    release = re.match(r"\d+(\.\d+)*", version)
    return [] if release is None else [int(number) for number in release[0].split(".")]


def _from_origin(extras: tuple[str, ...]) -> list[str]:
    """Return arguments of pip for this package with extras, from where it was installed, as PEP 610 has it.

    There are none if that is not known: the package is on no index, so that its name alone would not do.
    """
    import json
    from importlib.metadata import PackageNotFoundError, distribution
    from urllib.parse import urlsplit
    from urllib.request import url2pathname

    try:
        record = json.loads(distribution(DISTRIBUTION).read_text("direct_url.json") or "{}")
    except PackageNotFoundError:
        return []
    url, added = record.get("url", ""), f"[{','.join(extras)}]"
    if url.startswith("file:"):
        path = Path(url2pathname(urlsplit(url).path))
        is_there = path.is_file() or (path / "pyproject.toml").is_file()  # not so in a bare repository
        if not is_there:
            return []
        arguments = [f"{path}{added}"]
        return ["-e", *arguments] if record.get("dir_info", {}).get("editable", False) else arguments
    if vcs := record.get("vcs_info"):
        url = f"{vcs['vcs']}+{url}@{vcs.get('requested_revision') or vcs['commit_id']}"
    return [f"{DISTRIBUTION}{added} @ {url}"] if url else []
