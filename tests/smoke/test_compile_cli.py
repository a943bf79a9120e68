"""``consistency compile``: after it the filters that it names compile nothing."""

from __future__ import annotations

from pathlib import Path

import pytest
from own_process import consistency

WORLD, RUN = ("kf", "--scenario", "linear-gaussian"), ("run", "linear-gaussian", "--filter", "kf", "--runs", "1")


def test_what_is_compiled_ahead_is_not_compiled_again(tmp_path: Path) -> None:
    consistency("compile", *WORLD, cwd=tmp_path)
    again = consistency("compile", *WORLD, cwd=tmp_path)
    assert again.stdout.startswith("1 kernel of 1 filter in ")
    assert again.stdout.endswith("0 compiled now\n")
    assert "compiling" not in again.stderr
    assert "compiling" not in consistency(*RUN, "--out", "out", cwd=tmp_path).stderr


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("no-filter",), "unknown filter 'no-filter'"),
        (("submap-ekf-uvd",), "has no kernel"),
        (("kf", "--scenario", "herath2007-stereo"), "works on a sensor linear"),
        (("kf", "--cpu", "no-such-cpu"), "LLVM knows no such processor"),
        (("kf", "--into", "file"), "name a folder by --into"),
        (("kf", "--jobs", "0"), "jobs must be at least 1"),
    ],
)
def test_what_cannot_be_compiled_is_one_sentence(tmp_path: Path, arguments: tuple[str, ...], said: str) -> None:
    (tmp_path / "file").touch()
    err = consistency("compile", *arguments, cwd=tmp_path, status=2).stderr
    assert said in err
    assert err.count("\n") == 1


@pytest.mark.slow
def test_a_folder_for_an_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """For another processor, read by everybody; found in the environment that is printed, and in no other."""
    made = consistency("compile", *WORLD, "--into", "kernels", "--cpu", "x86-64-v2", cwd=tmp_path)
    assert made.stderr.startswith("compiling the kernel of kf: about ")
    first, last = made.stdout.splitlines()
    assert first == f"1 kernel of 1 filter in {tmp_path / 'kernels'}, 1 compiled now"
    environment = dict(each.split("=") for each in last.removeprefix("to use them: ").split())
    assert set(environment) == {"NUMBA_CACHE_DIR", "NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES"}
    (kernel,) = (tmp_path / "kernels").rglob("*.kernel")
    assert kernel.stat().st_mode & 0o777 == 0o644
    assert kernel.parent.stat().st_mode & 0o777 == 0o755
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert "compiling" not in consistency(*RUN, "--out", "out", cwd=tmp_path).stderr
    assert list((tmp_path / "kernels").rglob("*.kernel")) == [kernel]
