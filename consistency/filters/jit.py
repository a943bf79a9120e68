"""How kernels are compiled: nogil, IEEE division, and a cache that no edited source can outlive."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

inner: Callable[[Any], Any] = numba.njit(nogil=True, error_model="numpy")


def _digest() -> str:
    """Numba checks only the file of the cached entry; the key must cover all that it calls."""
    package = Path(__file__).parents[1]
    digest = hashlib.sha256(numba.__version__.encode())
    for path in sorted([*package.glob("models/*.py"), *package.glob("filters/*.py")]):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _cache_folder() -> Path:
    base = os.environ.get("NUMBA_CACHE_DIR")
    if not base:
        base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "filter-consistency" / _digest()


CACHE = _cache_folder()


def kernel(function: Any) -> Any:
    """Decorator of a whole-trial entry: compiled on first use, kept on disk for later processes."""
    config: Any = numba.config
    before, config.CACHE_DIR = config.CACHE_DIR, str(CACHE)
    try:
        return numba.njit(nogil=True, error_model="numpy", cache=True)(function)
    except RuntimeError:  # no folder can be written: compile in every process
        return numba.njit(nogil=True, error_model="numpy")(function)
    finally:
        config.CACHE_DIR = before


def is_compiled(entry: Any) -> bool:
    """Whether the entry is compiled already, in this process or on disk."""
    return bool(entry.signatures) or any(CACHE.rglob(f"*.{entry.py_func.__name__}-*.nbi"))
