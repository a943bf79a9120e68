"""Damaged files through every reader: one sentence and exit status 2, or what the file holds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fuzz import fuzz, outcome
from hostile import TARGETS, write_all
from mutations import bomb, copied, long_run

import consistency as cs


def test_a_few_hundred_damaged_files() -> None:
    statuses, wrong = fuzz(300, seed=3)
    assert wrong == []
    assert min(statuses[0], statuses[2]) > 20


def test_the_fuzzer_sees_what_is_wrong(tmp_path: Path) -> None:
    """Negative control: a traceback, a warning, a sentence that is none, memory, and nothing wrong."""

    def warn(_: Path) -> None:
        np.log(np.zeros(1))

    def fall(_: Path) -> None:
        raise KeyError("complete")

    def say(text: str) -> object:
        def read(_: Path) -> None:
            raise cs.InputError(text)

        return read

    assert "divide by zero" in outcome(warn, tmp_path)[3]
    assert "KeyError" in outcome(fall, tmp_path)[3]
    assert "memory" in outcome(say("a.npz: takes more memory than there is"), tmp_path)[3]
    assert outcome(say("a.npz: damaged"), tmp_path)[::3] == (2, "")
    assert outcome(lambda _: None, tmp_path)[::3] == (0, "")


@pytest.fixture(scope="module")
def valid(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("valid")
    write_all(folder)
    return folder


@pytest.mark.parametrize(
    ("name", "file", "damage"),
    [("archive", "est.npz", bomb), ("table", "est.parquet", long_run)],
    ids=["npz", "Parquet"],
)
def test_a_small_file_that_unfolds_to_gigabytes_is_not_read(
    valid: Path, tmp_path: Path, name: str, file: str, damage
) -> None:
    target = next(target for target in TARGETS if target.name == name and file in target.files)
    folder = copied(valid / name, tmp_path / "copy")
    damage(folder / file, np.random.default_rng(0))
    status, _, said, wrong = outcome(target.read, folder)
    assert (status, wrong) == (2, "")
    assert "GiB in memory" in said
