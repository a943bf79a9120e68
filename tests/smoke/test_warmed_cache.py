"""A run warms the cache of kernels, also one for an image: another processor, read by every user."""

import pytest
from own_process import consistency

RUN = ("run", "linear-gaussian", "--filter", "kf", "--runs", "1")


@pytest.mark.slow
def test_a_folder_for_an_image(tmp_path, monkeypatch):
    """The commands of docs/long-runs.md: what the first run compiles, the second finds."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))
    monkeypatch.setenv("NUMBA_CPU_NAME", "x86-64-v2")
    monkeypatch.setenv("NUMBA_CPU_FEATURES", "")
    consistency(*RUN, "--out", "out", cwd=tmp_path)
    (kernel,) = (tmp_path / "kernels").rglob("*.kernel")
    for path in (tmp_path / "kernels").rglob("*"):
        path.chmod(path.stat().st_mode | (0o755 if path.is_dir() else 0o644))
    written = kernel.read_bytes(), kernel.stat().st_ino
    assert "compiling" not in consistency(*RUN, "--out", "again", cwd=tmp_path).stderr
    assert list((tmp_path / "kernels").rglob("*.kernel")) == [kernel]
    assert (kernel.read_bytes(), kernel.stat().st_ino) == written
