"""The boundary of files: what parsers raise becomes one sentence, and nothing is sized by what a file claims."""

from __future__ import annotations

import os
import tracemalloc
from pathlib import Path
from typing import Any

import pytest

import consistency as cs
from consistency.referee.parsing import one_line, read_json, read_text, read_toml, reading, require_room


@pytest.mark.parametrize(
    ("raised", "said"),
    [
        (KeyError("a"), r"f\.x: damaged \('a'\)"),
        (RecursionError("deep\nly"), r"f\.x: damaged \(nested too deep\)"),
        (MemoryError(), r"f\.x: damaged \(it would take more memory than there is\)"),
        (OSError(13, "Permission denied"), r"f\.x: cannot be read \(Permission denied\)"),
        (OSError("bad page"), r"f\.x: damaged \(bad page\)"),
        (NotImplementedError(), r"f\.x: damaged \(NotImplementedError\)"),
        (cs.InputError("own words"), "own words"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_what_a_parser_raises_is_one_sentence(raised: Exception, said: str) -> None:
    with pytest.raises(cs.InputError, match=f"^{said}$"), reading("f.x", "damaged"):
        raise raised


def test_ctrl_c_is_no_damage() -> None:
    with pytest.raises(KeyboardInterrupt), reading("f.x"):
        raise KeyboardInterrupt


def test_a_line_is_short_and_printable() -> None:
    assert one_line("a\n\x1b[31mb\tc") == "a [31mb c"
    assert len(one_line("x" * 10_000)) == 160


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.toml")
    with pytest.raises(cs.InputError, match=r"pipe\.toml: is a device, not a file"):
        read_toml(tmp_path / "pipe.toml")


def test_a_folder_and_a_large_file_are_no_text(tmp_path: Path) -> None:
    with pytest.raises(cs.InputError, match="is a folder, not a file"):
        read_text(tmp_path, "no text")
    (tmp_path / "large.json").write_bytes(b" " * 5000)
    with pytest.raises(cs.InputError, match=r"large\.json: has 0 MiB; at most 0 MiB are read"):
        read_text(tmp_path / "large.json", "no text", largest=4999)
    assert len(read_text(tmp_path / "large.json", "no text", largest=5000)) == 5000


@pytest.mark.parametrize(
    "text",
    [".".join(["a"] * 20_000) + " = 1", "[" + " . ".join(['"a"'] * 20_000) + "]", "a = " + "[" * 20_000,
     "a = {" + ".".join(["b"] * 20_000) + " = 1}"],
    ids=["key", "table", "list", "inline"],
)  # fmt: skip
def test_toml_that_is_nested_20000_deep_takes_no_memory(tmp_path: Path, text: str) -> None:
    (tmp_path / "deep.toml").write_text(text, encoding="utf-8")
    cs.load_scenario("herath2007-xyz")  # what is imported does not count
    tracemalloc.start()
    with pytest.raises(
        cs.InputError, match=r"deep\.toml: not valid TOML \((nested too deep|a key of more than 64 parts)\)"
    ):
        cs.load_scenario(tmp_path / "deep.toml")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 20 * 2**20


def test_keys_of_64_parts_and_long_words_are_toml(tmp_path: Path) -> None:
    path = tmp_path / "long.toml"
    path.write_text(".".join("a" * 64) + f' = 1\ns = "{"x" * 100_000} {". " * 1000}"\n', encoding="utf-8")
    assert len(read_toml(path)["s"]) == 102_001


@pytest.mark.parametrize("text", ['{"a": 1, "a": 2}', "[" * 20_000, "\ufeff{}", '{"a": 1' + "0" * 5000 + "}"])
def test_json_with_a_key_twice_or_worse(tmp_path: Path, text: str) -> None:
    (tmp_path / "m.json").write_text(text, encoding="utf-8")
    with pytest.raises(cs.InputError, match=r"m\.json: not valid JSON \("):
        read_json(tmp_path / "m.json")


def test_room_is_in_proportion_to_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(bytes(1000))
    require_room(path, 2**29)
    with pytest.raises(cs.InputError, match=r"0\.5 GiB in memory"):
        require_room(path, 2**29 + 1)


# --- what a scenario may size ------------------------------------------------------------------------


def scenario(tmp_path: Path, old: str, new: str) -> Path:
    text = (cs.scenario.data_folder("scenarios") / "herath2007-xyz.toml").read_text(encoding="utf-8")
    key = next(line for line in text.splitlines() if line.split("=")[0].strip() in (old, f"{old}_s"))
    path = tmp_path / "world.toml"
    path.write_text(text.replace(key, f"{old} = {new}", 1), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("steps", 2**63 - 1, r"key 'truth\.steps': Input should be less than or equal to 1000000"),
        ("steps", "1" + "0" * 400, r"key 'truth\.steps': "),
        ("count", 10**9, r"key 'truth\.landmarks\.count': Input should be less"),
        ("count", 10**6, r".*steps times landmarks must be at most 200000000"),
        ("dt", 1e308, r"key 'truth\.dt': Input should be less than or equal to 10{30} "),
    ],
)
def test_a_number_of_a_scenario_sizes_no_arrays(tmp_path: Path, key: str, value: Any, said: str) -> None:
    with pytest.raises(cs.InputError, match=said):
        cs.load_scenario(scenario(tmp_path, key, value))


def test_a_name_that_no_file_can_have(tmp_path: Path) -> None:
    for name in ("x" * 300, "x" * 300 + ".toml", "a\0.toml"):
        with pytest.raises(cs.InputError):
            cs.load_scenario(str(tmp_path / name))
