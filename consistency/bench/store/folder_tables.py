"""Tables in output folders, and their digests in the manifest."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from consistency.referee.column_names import COLUMNS
from consistency.referee.errors import InputError
from consistency.referee.system import folders
from consistency.referee.system.folders import NewFolder

if TYPE_CHECKING:
    import pandas as pd

TABLES = (".parquet", ".csv")  # the latter of logs alone


def write_tables(
    folder: Path,
    tables: dict[str, pd.DataFrame],
    manifest: dict[str, Any],
    extra: Callable[[Path], None] | None = None,
    overwrite: bool = False,
    keep_others: bool = False,
) -> None:
    """Tables as Parquet, the manifest, and whatever ``extra`` writes, as :func:`folders.write_folder`."""

    def contents(at: Path) -> None:
        for name, table in tables.items():
            from consistency.bench.store.parquet import write_table

            write_table(at / f"{name}.parquet", name, table)
        if extra is not None:
            extra(at)

    folders.write_folder(folder, manifest, contents, overwrite, keep_others, with_tables)


def with_tables(new: NewFolder, manifest: dict[str, Any]) -> dict[str, Any]:
    """The manifest with what tables there are; of results also their rows and digests. Logs may be edited."""
    tables = sorted(COLUMNS.keys() & {file.stem for file in new.path.iterdir() if file.suffix in TABLES})
    manifest = manifest | {"tables": tables}
    if new.kind == "results":
        with new.writing():
            manifest["contents"] = {name: _content_of(new.path, name) for name in tables}
    return manifest


def _content_of(folder: Path, name: str) -> dict[str, Any]:
    from consistency.bench.store.parquet import require_table

    return {"rows": require_table(folder, name).metadata.num_rows, "sha256": _digest(folder / f"{name}.parquet")}


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def require_unchanged(folder: Path, manifest: dict[str, Any]) -> None:
    """Refuse tables that are not those that were written with the manifest; one of before has nothing to say.

    Raises
    ------
    InputError
        A table was edited, replaced or damaged, or is missing; the manifest names none of this bench.
    """
    written_contents = manifest.get("contents", {})
    if not isinstance(written_contents, dict) or not written_contents.keys() <= COLUMNS.keys():
        raise InputError(f"{folder / 'manifest.json'}: key 'contents' must have tables as keys; write the folder again")
    for name in written_contents:
        path = folder / f"{name}.parquet"
        try:
            content_now = _content_of(folder, name)
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
        if content_now != written_contents[name]:
            raise InputError(
                f"{path}: is not as it was written, but damaged or edited; write the folder again, or, if the change "
                f"is meant, take '{name}' out of the key 'contents' of manifest.json"
            )
