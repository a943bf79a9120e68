"""Small damages of valid files: what a disk, another program or a person may do to them."""

import io
import json
import shutil
import struct
import tomllib
import zipfile
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import tomli_w

Mutation = Callable[[Path, np.random.Generator], None]

HOSTILE = (
    0, -1, 1, 0.5, -0.0, 1e-320, 1e308, -1e308, 3e30, float("nan"), float("inf"), 2**31, 2**53 + 1, 2**63 - 1, -(2**63),
    10**400, True, False, "", "text", "1e5", "nan", "ekf-uvd", "\x1b[31mred\nnext", "x" * 5000, [], [[]], [1, "a"], {},
    {"a": 1}, None,
)  # fmt: skip


def pick(rng, values):
    return values[int(rng.integers(len(values)))]


# --- of any file -----------------------------------------------------------------------------------


def flip(path, rng):
    content = bytearray(path.read_bytes())
    for _ in range(int(rng.integers(1, 9))):
        content[int(rng.integers(len(content)))] ^= 1 << int(rng.integers(8))
    path.write_bytes(content)


def truncate(path, rng):
    content = path.read_bytes()
    path.write_bytes(content[: int(rng.integers(len(content)))])


def splice(path, rng):
    """A piece of the file at another place, or left out."""
    content = path.read_bytes()
    start, end, to = sorted(int(k) for k in rng.integers(len(content), size=3))
    path.write_bytes(
        content[:start] + content[end:to] + (content[start:end] if rng.random() < 0.5 else b"") + content[to:]
    )


def garbage(path, rng):
    path.write_bytes(rng.bytes(int(rng.integers(1, 3000))))


def empty(path, rng):
    path.write_bytes(b"" if rng.random() < 0.5 else b"\n")


def other_encoding(path, rng):
    text = path.read_bytes().decode("latin-1")
    path.write_bytes(text.encode(pick(rng, ["utf-16", "utf-32", "utf-8-sig", "cp500"]), "replace"))


def nulls(path, rng):
    content, at = path.read_bytes(), int(rng.integers(path.stat().st_size))
    path.write_bytes(content[:at] + b"\0" * int(rng.integers(1, 50)) + content[at:])


def folder(path, rng):
    path.unlink()
    path.mkdir()


def missing(path, rng):
    path.unlink()


def loop(path, rng):
    path.unlink()
    path.symlink_to(path)


def deep(path, rng):
    """Nested 20,000 deep."""
    n = 20_000
    texts = ["[" * n + "]" * n, '{"a":' * n + "1" + "}" * n, "a = " + "[" * n, ".".join("a" * n) + " = 1\n", "- " * n]
    text = pick(rng, texts)
    path.write_text(text, encoding="utf-8")


ANY = {
    function.__name__: function
    for function in (flip, truncate, splice, garbage, empty, other_encoding, nulls, folder, missing, loop, deep)
}


# --- of nested tables ------------------------------------------------------------------------------


def _places(data):
    """(container, key) of everything in nested tables and lists."""
    own = list(data.items()) if isinstance(data, dict) else list(enumerate(data)) if isinstance(data, list) else []
    return [(data, key) for key, _ in own] + [place for _, value in own for place in _places(value)]


def change_tree(data, rng):
    container, key = pick(rng, _places(data))
    kind = int(rng.integers(5))
    if kind == 0:
        del container[key]
    elif kind == 1:
        container[key] = pick(rng, HOSTILE)
    elif kind == 2:
        container[key] = [container[key]]
    elif kind == 3 and isinstance(container, dict):
        container[f"{key}_x"] = container.pop(key)
    elif isinstance(container, list):
        container.append(container[key])
    elif isinstance(container[key], int | float):
        container[key] *= pick(rng, [-1, 1e9, 1e-9, 2])
    else:
        container[key] = pick(rng, HOSTILE)


def json_tree(path, rng):
    data = json.loads(path.read_text(encoding="utf-8"))
    change_tree(data, rng)
    path.write_text(json.dumps(data), encoding="utf-8")


def json_twice(path, rng):
    """A key that is duplicated."""
    data = json.loads(path.read_text(encoding="utf-8"))
    table = data if isinstance(data, dict) else data[0]
    key = pick(rng, list(table))
    text = json.dumps(data)
    path.write_text(text.replace("{", "{" + f"{json.dumps(key)}: {json.dumps(table[key])}, ", 1), encoding="utf-8")


def toml_tree(path, rng):
    data = tomllib.loads(path.read_text(encoding="utf-8"))
    change_tree(data, rng)
    try:
        path.write_text(tomli_w.dumps(data), encoding="utf-8")
    except (TypeError, ValueError):  # None is no TOML
        path.write_text("x = ", encoding="utf-8")


def toml_line_twice(path, rng):
    lines = path.read_text(encoding="utf-8").splitlines()
    keys = [line for line in lines if "=" in line and not line.startswith("#")]
    line = pick(rng, keys)
    lines.insert(lines.index(line), line)
    path.write_text("\n".join(lines), encoding="utf-8")


# --- of text in lines ------------------------------------------------------------------------------


def _lines(path):
    return path.read_text(encoding="utf-8").splitlines()


def line_gone(path, rng):
    lines = _lines(path)
    del lines[int(rng.integers(len(lines)))]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def line_twice(path, rng):
    lines = _lines(path)
    at = int(rng.integers(len(lines)))
    path.write_text("\n".join([*lines[:at], lines[at], *lines[at:]]) + "\n", encoding="utf-8")


def lines_swapped(path, rng):
    lines = _lines(path)
    at, to = (int(k) for k in rng.integers(len(lines), size=2))
    lines[at], lines[to] = lines[to], lines[at]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def field(path, rng):
    """One field changed, left out or duplicated."""
    lines = _lines(path)
    at = int(rng.integers(len(lines)))
    separator = "," if "," in lines[at] else " "
    fields = lines[at].split(separator)
    k = int(rng.integers(len(fields)))
    new = pick(rng, [*map(str, HOSTILE), fields[k] + separator + fields[k], '"', "1e99999", "0x10", "1_0", "９"])
    fields[k : k + 1] = [] if rng.random() < 0.1 else [new]
    lines[at] = separator.join(fields)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


TEXT = {f.__name__: f for f in (line_gone, line_twice, lines_swapped, field)}


# --- of archives -----------------------------------------------------------------------------------


def arrays(path, rng):
    """One array of another type, shape or value, left out or under another name."""
    with np.load(path) as archive:
        data = dict(archive)
    key = pick(rng, sorted(data))
    value = np.atleast_1d(data[key])
    kind = int(rng.integers(9))
    if kind == 0:
        del data[key]
    elif kind == 1:
        data[f"{key}2"] = data.pop(key)
    elif kind == 2:
        data[key] = data[key].astype(pick(rng, ["c16", "U8", "S4", "?", "f2", "i1", "u8", "M8[s]"]))
    elif kind == 3:
        data[key] = value[: len(value) - 1]
    elif kind == 4:
        data[key] = value[..., None]
    elif kind == 5:
        data[key] = np.array(pick(rng, [0.0, -1.0, 1e308, np.nan, np.inf, 2.5, 1e18, 1 + 1j]))
    elif kind == 6:
        data[key] = np.array({"a": 1}, dtype=object)
    elif value.dtype.kind in "fiu":
        flat = value.astype(float).ravel()
        flat[int(rng.integers(flat.size))] = pick(rng, [np.nan, np.inf, -np.inf, 1e308, -1e308, -1.0, 0.0, 1e29])
        data[key] = flat.reshape(np.shape(data[key]))
    np.savez(path, **data)


def packed(path, rng):
    """The same arrays, packed in another way."""
    with np.load(path) as archive:
        data = dict(archive)
    method = pick(rng, [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
    with zipfile.ZipFile(path, "w", method) as file:
        for key, value in data.items():
            content = io.BytesIO()
            np.save(content, value)
            file.writestr(f"{key}.npy", content.getvalue())


def locked(path, rng):
    """A flag of the archive changed: encrypted, or packed by a method that is unknown."""
    content = bytearray(path.read_bytes())
    offset, value = pick(rng, [(8, 1), (10, 9), (10, 14), (10, 99), (8, 64)])
    at = content.rfind(b"PK\x01\x02")
    content[at + offset] |= value
    first = content.find(b"PK\x03\x04")
    content[first + offset - 2] |= value
    path.write_bytes(content)


def claimed(path, rng):
    """An array whose head claims a size that is not there."""
    shape = pick(rng, [(2**40,), (2**20, 2**20), (10**9, 3), (-1, 3), (2**62, 2**62)])
    head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    array = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head.encode() + b"\0" * 24
    with zipfile.ZipFile(path) as old:
        members = {name: old.read(name) for name in old.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in (members | {pick(rng, sorted(members)): array}).items():
            file.writestr(name, content)


def bomb(path, rng):
    """Zeros of 0.6 GiB in 0.6 MiB."""
    with zipfile.ZipFile(path) as old:
        names = old.namelist()
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file, file.open(names[0], "w") as member:
        head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({5 * 2**24},), }}".ljust(117) + "\n"
        member.write(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head.encode())
        for _ in range(40):
            member.write(bytes(2**24))


ARCHIVE = {f.__name__: f for f in (arrays, packed, locked, claimed)}


# --- of Parquet ------------------------------------------------------------------------------------


def _kept(table, path):
    pq.write_table(table, path, write_page_checksum=True)


def row_gone(path, rng):
    table = pd.read_parquet(path)
    table.drop(index=int(rng.integers(len(table)))).to_parquet(path, index=False)


def row_twice(path, rng):
    table = pd.read_parquet(path)
    row = int(rng.integers(len(table)))
    table.iloc[[*range(row + 1), *range(row, len(table))]].to_parquet(path, index=False)


def rows_swapped(path, rng):
    table = pd.read_parquet(path)
    order = np.arange(len(table))
    at = rng.choice(len(table), 2, replace=False)
    order[at] = order[at[::-1]]
    table.iloc[order].to_parquet(path, index=False)


def cut_short(path, rng):
    table = pd.read_parquet(path)
    table.iloc[: int(rng.integers(len(table)))].to_parquet(path, index=False)


def cell(path, rng):
    table = pd.read_parquet(path).astype(object)
    row, column = int(rng.integers(len(table))), int(rng.integers(table.shape[1]))
    scalars = [value for value in HOSTILE if not isinstance(value, list | dict)]
    table.iloc[row, column] = pick(rng, scalars)
    columns = {}
    for name in table:
        values = table[name].tolist()
        try:
            columns[str(name)] = pa.array(values)
        except (pa.ArrowException, OverflowError):
            columns[str(name)] = pa.array([str(value) for value in values])
    _kept(pa.table(columns), path)


def column(path, rng):
    """A column of another type, left out, renamed or duplicated."""
    table = pq.read_table(path)
    k = int(rng.integers(table.num_columns))
    name, values = table.column_names[k], table.column(k)
    kind = int(rng.integers(9))
    plain = values.to_pylist()
    rows = range(len(plain))
    others = [
        lambda: pa.array([str(value) for value in plain]),
        lambda: pa.array([bool(value) for value in plain]),
        lambda: pa.array([[1.0, 2.0] for _ in rows]),
        lambda: pa.array([Decimal(1) for _ in rows]),
        lambda: pa.array([1 for _ in rows], pa.timestamp("ns")),
        lambda: pa.nulls(len(plain)),
        lambda: pa.array([b"\xff\xfe" for _ in rows], pa.binary()),
        lambda: values.combine_chunks().dictionary_encode(),
        lambda: pa.array([{"a": 1} for _ in rows]),
        lambda: pa.array([2**64 - 1 for _ in rows], pa.uint64()),
    ]
    if kind == 0:
        table = table.remove_column(k)
    elif kind == 1:
        table = table.rename_columns([f"{n}2" if i == k else n for i, n in enumerate(table.column_names)])
    elif kind == 2:
        table = table.append_column(name, values)
    else:
        table = table.set_column(k, name, pick(rng, others)())
    _kept(table, path)


def notes(path, rng):
    """Odd metadata of other programs."""
    table = pq.read_table(path)
    name = table.column_names[-1]
    text = pick(rng, [
        b"{", b"[]", b"{}", b'{"index_columns": ["none"], "columns": [], "column_indexes": []}',
        b'{"index_columns": [{"kind": "range", "name": null, "start": 0, "stop": 9999999999999, "step": 1}]}',
        json.dumps({"index_columns": [name], "columns": [], "column_indexes": [], "pandas_version": "2"}).encode(),
        b'{"index_columns": 5, "columns": 7}', b"\xff\xfe", b'{"a":' * 20000,
    ])  # fmt: skip
    _kept(table.replace_schema_metadata({pick(rng, [b"pandas", b"ARROW:schema"]): text}), path)


def long_run(path, rng):
    """Ten million rows in a small file."""
    table = pq.read_table(path).slice(0, 1)
    columns = {name: pa.repeat(table.column(name)[0], 10**6) for name in table.column_names}
    big = pa.table(columns)
    with pq.ParquetWriter(path, big.schema, compression="zstd") as writer:
        for _ in range(10):
            writer.write_table(big)


ROWS = {f.__name__: f for f in (row_gone, row_twice, rows_swapped, cut_short)}
COLUMNS = {f.__name__: f for f in (cell, column, notes)}


def copied(source, target):
    """A copy of a file or folder to be damaged."""
    if target.exists() or target.is_symlink():
        shutil.rmtree(target)
    return Path(shutil.copytree(source, target, symlinks=True))
