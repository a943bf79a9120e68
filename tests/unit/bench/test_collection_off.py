"""Garbage is not collected while a kernel compiles, and is as before then."""

import gc

import pytest

from consistency.bench.filters.compiler.jit import without_collection


@pytest.mark.parametrize("enabled", [True, False])
@pytest.mark.parametrize("error", [None, ValueError])
def test_collection_is_as_before(enabled, error):
    was = gc.isenabled()
    (gc.enable if enabled else gc.disable)()
    try:
        try:
            with without_collection():
                assert not gc.isenabled()
                if error is not None:
                    raise error
        except ValueError:
            pass
        assert gc.isenabled() == enabled
    finally:
        (gc.enable if was else gc.disable)()
