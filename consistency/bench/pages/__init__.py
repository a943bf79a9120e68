"""Pages on results of the bench and on maps of worlds.

``results_report`` reads a folder and lets every section of ``sections`` make its blocks: text, tables and figures, each
of which is described once.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from consistency.referee.pages.write_pages import require_pages, require_writable, write_document

if TYPE_CHECKING:
    from consistency.bench.sweeps.regime_map import Regime

__all__ = ["write_regime_reports", "write_reports"]


def write_reports(folder: Path, html: Path | None, pdf: Path | None, overwrite: bool) -> list[Path]:
    """Report of a folder of ``consistency run`` or ``reproduce``, each file whole or not at all.

    Parameters
    ----------
    folder : output folder
    html, pdf : files to write; None leaves that one out
    overwrite : replace files that exist

    Returns
    -------
    The files written

    Raises
    ------
    InputError
        The folder cannot be read, or a file exists or cannot be written.
    """
    from consistency.referee.system import read_manifest

    manifest = read_manifest(Path(folder))
    require_pages(html, pdf, overwrite)
    from consistency.bench.pages.results_report import build_report, compose, folders_of
    from consistency.referee.system import progress

    parts = len(folders_of(Path(folder), manifest)) + sum(path is not None for path in (html, pdf))
    with progress("report", parts, "parts", brief=True) as advance:
        write_document(compose(build_report(Path(folder), advance)), html, pdf, advance=advance)
    return [path for path in (html, pdf) if path is not None]


def write_regime_reports(regime: Regime, folder: Path) -> list[Path]:
    """``report.html`` and ``report.pdf`` of a map in the folder of its sweep; those of before are replaced.

    Raises
    ------
    InputError
        A file cannot be written.
    """
    targets = [folder / "report.html", folder / "report.pdf"]
    for path in targets:
        require_writable(path, overwrite=True)
    from consistency.bench.pages.sweep_report import compose_regime

    write_document(compose_regime(regime), *targets)
    return targets
