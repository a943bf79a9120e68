"""Compiled functions stand at module level: closures cached by two processes can be linked to each other."""

from __future__ import annotations

import importlib
import pkgutil

from numba.core.dispatcher import Dispatcher

import consistency.filters


def test_no_kernel_is_a_closure() -> None:
    found = []
    for module in pkgutil.iter_modules(consistency.filters.__path__):
        names = vars(importlib.import_module(f"consistency.filters.{module.name}"))
        found += [value.py_func.__qualname__ for value in names.values() if isinstance(value, Dispatcher)]
    assert "run_trial" in found
    assert not [name for name in found if "<locals>" in name]
