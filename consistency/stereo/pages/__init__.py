"""Sections and documents of reports on images and stereo sensors."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from consistency.stereo.characterising.characterise import Characterisation


def write_sensor_reports(
    of: Characterisation,
    folder: Path,
    data: str,
    overwrite: bool = False,
) -> list[Path]:
    """``report.html``, ``report.pdf`` and ``characterisation.json`` in a folder that appears whole or not at all.

    Parameters
    ----------
    data : text of the JSON file

    Raises
    ------
    InputError
        The folder exists or cannot be written.
    """
    from consistency.referee.pages.write_pages import write_document, write_file
    from consistency.referee.system.folders import write_folder
    from consistency.referee.system.provenance import manifest_of
    from consistency.stereo.pages.characterisation import compose_sensor

    manifest = manifest_of(kind="characterisation", source=of.source)
    document = compose_sensor(of, manifest)

    def contents(at: Path) -> None:
        write_document(document, at / "report.html", at / "report.pdf")
        write_file(at / "characterisation.json", data.encode("utf-8"))

    write_folder(folder, manifest, contents, overwrite)
    return [folder / name for name in ("report.html", "report.pdf", "characterisation.json")]
