"""Damaged files through every reader: one sentence and exit status 2, or what the file holds."""

import io
import subprocess
import sys

import numpy as np
import pyarrow.parquet as pq
import pytest
from fuzz import cases, fuzz, in_pages, outcome
from hostile_work import TARGETS, write_all
from mutations import bomb, copied, long_run

import consistency as cs
from consistency.bench.store.parquet import read_parquet


def test_a_few_hundred_damaged_files():
    statuses, wrong = fuzz(300, seed=3)
    assert wrong == []
    assert min(statuses[0], statuses[2]) > 20


def test_the_fuzzer_sees_what_is_wrong(tmp_path):
    """Negative control: a traceback, a warning, a sentence that is none, memory, and nothing wrong."""

    def warn(_):
        np.log(np.zeros(1))

    def fall(_):
        raise KeyError("complete")

    def say(text):
        def read(_):
            raise cs.InputError(text)

        return read

    assert "divide by zero" in outcome(warn, tmp_path)[3]
    assert "KeyError" in outcome(fall, tmp_path)[3]
    assert "memory" in outcome(say("a.npz: takes more memory than there is"), tmp_path)[3]
    assert outcome(say("a.npz: damaged"), tmp_path)[::3] == (2, "")
    assert outcome(lambda _: None, tmp_path)[::3] == (0, "")


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    folder = tmp_path_factory.mktemp("valid")
    write_all(folder)
    return folder


@pytest.mark.parametrize(
    "name, file, damage",
    [("archive", "est.npz", bomb), ("table", "est.parquet", long_run)],
    ids=["npz", "Parquet"],
)
def test_a_small_file_that_unfolds_to_gigabytes_is_not_read(valid, tmp_path, name, file, damage):
    target = next(target for target in TARGETS if target.name == name and file in target.files)
    folder = copied(valid / name, tmp_path / "copy")
    damage(folder / file, np.random.default_rng(0))
    status, _, said, wrong = outcome(target.read, folder)
    assert (status, wrong) == (2, "")
    assert "GiB in memory" in said


def test_a_flipped_bit_of_our_tables_is_never_read_as_another_number(valid, tmp_path):
    """Our pages have checksums; 400 pairs of bits anywhere, which a fresh seed draws.

    One bit in the head of each page takes its checksum away. Alone it changes nothing, but then a second one in that
    page is not seen.
    """
    source = valid / "results" / "truth.parquet"
    content, path, right = source.read_bytes(), tmp_path / "truth.parquet", read_parquet(source.parent, "truth")

    def is_right(*bits):
        damaged = bytearray(content)
        for bit in bits:
            damaged[bit // 8] ^= 1 << (bit % 8)
        path.write_bytes(damaged)
        return read_parquet(tmp_path, "truth").equals(right)

    def unharmed(bit):
        try:
            return is_right(bit)
        except cs.InputError:
            return False

    refused = 0
    for pair in np.random.default_rng().integers(8 * len(content), size=(400, 2)):
        try:
            assert is_right(*pair) or any(map(unharmed, pair)), pair
        except cs.InputError:
            refused += 1
    assert refused > 200


FLIPS = """
import sys
from pathlib import Path
import numpy as np
import consistency as cs
from consistency.bench.store.parquet import read_batches

path, rng, refused = Path("estimates.parquet"), np.random.default_rng(), 0
content = path.read_bytes()
end = len(content) - 8
begin = end - int.from_bytes(content[-8:-4], "little")
for at in rng.integers(begin, end, size=1500):
    damaged = bytearray(content)
    damaged[at] ^= 1 << int(rng.integers(8))
    path.write_bytes(damaged)
    try:
        list(read_batches(Path(), "estimates", ["run"], "two"))
    except cs.InputError:
        refused += 1
sys.exit(0 if refused > 300 else 1)
"""


def test_no_bit_of_a_footer_ends_the_process(valid, tmp_path):
    """One bit of 180 did where pyarrow was asked for its statistics: 1500 miss all of them once in 4,000 times.

    That is the chance to overlook the fault; there is none to find it where it is not.
    """
    copied(valid / "results", tmp_path / "copy")
    done = subprocess.run([sys.executable, "-c", FLIPS], cwd=tmp_path / "copy", capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_file_of_other_numbers_is_told_from_damage(valid):
    """Without checksums nobody can see that a page was changed; a changed footer can be seen."""
    content = (valid / "table" / "est.parquet").read_bytes()
    column = pq.read_metadata(io.BytesIO(content)).row_group(0).column(3)
    for at, is_page in ((column.data_page_offset + column.total_compressed_size - 1, True), (len(content) - 20, False)):
        damaged = bytearray(content)
        damaged[at] ^= 1
        assert in_pages(content, bytes(damaged)) is is_page
    assert not in_pages(content, content[:-1])


def test_each_file_is_damaged_within_6000_cases():
    targets = [(target.name, file) for target in TARGETS for file in target.files]
    drawn = {(TARGETS[k].name, file) for k, file, _, _ in cases(6000, seed=0)}
    assert drawn == set(targets)
