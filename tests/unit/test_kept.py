"""Compiled code on disk: what is damaged is compiled anew, is never loaded, and fails no run."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from consistency.filters.kernel import jit, kept


def total(n: int) -> float:
    result = 0.0
    for k in range(n):
        result += k
    return result


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Where kernels of this test are kept."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    jit._cache_folder.cache_clear()
    yield tmp_path / "cache"
    jit._cache_folder.cache_clear()


def use() -> tuple[bool, int]:
    """Whether a kernel, as a new process has it, is ready, and how many signatures it then loads from disk."""
    kernel = jit.Kernel(total)
    ready = kernel.is_ready(5)
    assert kernel(5) == kernel(5) == 10.0
    assert kernel.is_ready(5)
    return ready, kernel.loaded


def file_of(cache: Path, suffix: str) -> Path:
    (path,) = cache.rglob(f"*{suffix}")
    return path


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-7])


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def empty(path: Path) -> None:
    path.write_bytes(b"")


def make_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


@pytest.mark.parametrize(
    ("suffix", "damage"),
    [(".nbi", truncate), (".nbi", empty), (".nbc", flip), (".nbc", make_folder), (kept.MARK, flip),
     (".nbc", Path.unlink)],
    ids=["index cut", "index empty", "code flipped", "code a folder", "list flipped", "code gone"],
)  # fmt: skip
def test_damaged_code_is_compiled_anew_and_said_once(
    cache: Path, capsys: pytest.CaptureFixture[str], suffix: str, damage: Callable[[Path], None]
) -> None:
    assert use() == (False, 0)
    damage(file_of(cache, suffix))
    assert capsys.readouterr().err == ""
    assert use() == (False, 0)
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "compiled anew" in said
    assert use() == (True, 1)
    assert capsys.readouterr().err == ""


def test_code_that_was_never_finished_is_not_loaded(cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A process that was killed while it wrote leaves no list."""
    use()
    file_of(cache, kept.MARK).unlink()
    truncate(file_of(cache, ".nbc"))
    assert use() == (False, 0)
    assert use() == (True, 1)
    assert capsys.readouterr().err == ""


def test_a_cache_that_cannot_be_written_fails_nothing(cache: Path) -> None:
    cache.write_text("a file where the cache would be", encoding="utf-8")
    assert use() == (False, 0)


def test_damage_that_cannot_be_removed_fails_nothing(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use()
    flip(file_of(cache, ".nbc"))
    monkeypatch.setattr(jit, "clear", lambda folder: False)
    assert use() == (False, 0)
    assert not kept.is_whole(file_of(cache, kept.MARK).parent)


def test_code_that_cannot_be_kept_serves_its_process(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A full disk."""

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("numba.core.caching.IndexDataCacheFile._save_data", full)
    assert use() == (False, 0)
    assert not list(cache.rglob(kept.MARK))
