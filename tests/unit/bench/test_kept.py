"""Compiled code on disk: what is damaged or not ours is compiled anew, is never loaded, and fails no run."""

import os
from pathlib import Path

import pytest

from consistency.bench.filters.compiler import jit


def total(n):
    result = 0.0
    for k in range(n):
        result += k
    return result


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """Where kernels of this test are kept."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    jit._say.cache_clear()
    return tmp_path / "cache"


def use():
    """Whether a kernel, as a new process has it, is ready, and how many signatures it then loads from disk."""
    kernel = jit.Kernel(total)
    ready = kernel.is_ready(5)
    assert kernel(5) == kernel(5) == 10.0
    assert kernel.is_ready(5)
    return ready, kernel.loaded


def code_in(cache):
    (path,) = cache.rglob(f"*{jit.SUFFIX}")
    return path


def truncate(path):
    path.write_bytes(path.read_bytes()[:-7])


def empty(path):
    path.write_bytes(b"")


def flip(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def open_to_all(path):
    path.chmod(0o666)


@pytest.mark.parametrize("damage", [truncate, empty, flip, open_to_all])
def test_damaged_code_is_compiled_anew_and_said_once(cache, capsys, damage):
    assert use() == (False, 0)
    damage(code_in(cache))
    assert capsys.readouterr().err == ""
    assert use() == (False, 0)
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert ("somebody else" if damage in (empty, open_to_all) else "compiled again") in said
    assert use() == (True, 1)
    assert capsys.readouterr().err == ""


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="there are no modes on this system")
def test_a_folder_that_others_may_write_is_not_trusted(cache, capsys):
    use()
    folder = code_in(cache).parent
    assert folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o777)
    assert use() == (False, 0)
    said = capsys.readouterr().err
    assert "somebody else may write there" in said
    assert said.count("\n") == 1


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owners on this system")
def test_code_of_another_owner_is_neither_loaded_nor_overwritten(cache, monkeypatch, capsys):
    use()
    before = code_in(cache).read_bytes()
    monkeypatch.setattr(os, "getuid", lambda: code_in(cache).stat().st_uid + 1)
    if code_in(cache).stat().st_uid == 0:  # root is trusted: make the owner somebody else
        for path in (code_in(cache).parent, code_in(cache)):
            os.chown(path, 12345, -1)
    assert use() == (False, 0)
    assert "somebody else may write there" in capsys.readouterr().err
    assert code_in(cache).read_bytes() == before


def test_a_cache_that_cannot_be_written_fails_nothing(cache, capsys):
    cache.write_text("a file where the cache would be", encoding="utf-8")
    assert use() == (False, 0)
    assert capsys.readouterr().err.count("\n") == 1


def test_code_that_cannot_be_kept_serves_its_process(cache, monkeypatch, capsys):
    """A full disk."""

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    assert use() == (False, 0)
    assert not list(cache.rglob(".*")) + list(cache.rglob(f"*{jit.SUFFIX}"))
    assert capsys.readouterr().err.count("No space left on device; compiled code is not kept") == 1


def test_what_was_not_used_for_longest_is_removed_first(tmp_path):
    for age, name in enumerate("abcd"):
        path = tmp_path / f"{name}{jit.SUFFIX}"
        path.write_bytes(bytes(100))
        os.utime(path, (1e9 - age, 1e9 - age))
    unfinished, stale = tmp_path / ".new", tmp_path / ".old"
    for path, time in ((unfinished, 1e9), (stale, 1e9 - 2e5)):
        path.write_bytes(b"")
        os.utime(path, (time, time))
    jit.prune(tmp_path, most=250)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".new", "a.kernel", "b.kernel"]


def test_an_untried_numba_compiles_as_it_does(cache, monkeypatch):
    monkeypatch.setattr(jit.numba, "__version__", "99.1")
    assert not jit.is_supported()
    assert use() == (False, 0)
    assert use() == (True, 1)
