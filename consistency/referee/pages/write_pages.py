"""Pages on the verdicts and records of any estimator: what a document of them holds, and documents as files.

Renderers of ``show`` write them. No statistic is computed here that the diagnostics do not already have.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from consistency.referee.errors import InputError
from consistency.referee.extras import missing, require
from consistency.referee.show import FORMATS, rendered
from consistency.referee.system.atomic import write_whole

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from matplotlib.figure import Figure as Drawing

    from consistency.referee.diagnostics.records.record import Record
    from consistency.referee.diagnostics.verdict.verdict import Verdict
    from consistency.referee.document.blocks import Document
    from consistency.referee.system.progress import Advance

REPORT_FILES = ("report.html", "report.pdf", "verdict.json")
MARK = "<!-- written by consistency analyse, which replaces it -->\n"  # the end of a file of a verdict
KINDS = (".png", ".pdf", ".svg")  # of a plot


def require_pages(html: Path | None, pdf: Path | None, overwrite: bool) -> None:
    """Refuse, before any work, files of a report that cannot be written; None leaves one out.

    Raises
    ------
    InputError
        Both are the same, or one exists or cannot be written.
    """
    if html is not None and pdf is not None and html.absolute() == pdf.absolute():
        raise InputError(f"{html}: is named for both HTML and PDF; name two files")
    for path in (html, pdf):
        if path is not None:
            require_writable(path, overwrite)


def write_file_pages(
    records: Sequence[Record], judged: Mapping[str, Verdict], html: Path | None, pdf: Path | None, title: str
) -> None:
    """Report of files of another estimator, as :func:`write_file_reports` writes it; None leaves a file out."""
    from consistency.referee.pages.files_report import compose_files
    from consistency.referee.system.provenance import manifest_of

    write_document(compose_files(records, judged, title, manifest_of(kind="verdict", source=title)), html, pdf)


def write_file_reports(
    records: Sequence[Record],
    judged: Mapping[str, Verdict],
    folder: Path,
    title: str,
    data: str,
    overwrite: bool = False,
) -> list[Path]:
    """``report.html``, ``report.pdf`` and ``verdict.json`` in a folder that appears whole or not at all.

    Without Matplotlib the page has no pictures, and without the packages of [report] there is no PDF.

    Parameters
    ----------
    judged : verdicts by name of the records that are shown
    data : text of the JSON file

    Raises
    ------
    InputError
        The folder exists or cannot be written.
    """
    from consistency.referee.pages.files_report import compose_files
    from consistency.referee.system.folders import write_folder
    from consistency.referee.system.provenance import manifest_of

    manifest = manifest_of(kind="verdict", source=title)
    document = compose_files(records, judged, title, manifest)

    def contents(at: Path) -> None:
        write_document(document, at / "report.html", at / "report.pdf" if not missing("report") else None)
        write_file(at / "verdict.json", data.encode("utf-8"))

    write_folder(folder, manifest, contents, overwrite)
    return [folder / name for name in REPORT_FILES if (folder / name).exists()]


def write_text_file(document: Document, path: Path) -> Path:
    """One file, in the format of its suffix, with a mark by which :func:`is_own_report` knows it.

    Raises
    ------
    InputError
        The file cannot be written.
    """
    write_file(path, f"{rendered(document, path)}{MARK}".encode())
    return path


def require_report(report: Path, overwrite: bool) -> bool:
    """Refuse, before any work, a report that cannot be written; return whether it replaces what is there.

    Raises
    ------
    InputError
        Something other than a report of a verdict is there, without ``overwrite``; or the system refuses.
    """
    from consistency.referee.system.folders import require_free

    replaces = overwrite or is_own_report(report)
    if is_one_file(report):
        require_writable(report, replaces)
    else:
        require_free(report, replaces, "verdict", "--report")
    return replaces


def is_one_file(report: Path) -> bool:
    """Whether a report is one file; a folder has the HTML page and the JSON."""
    return report.suffix.lower() in FORMATS.keys() - {".html", ".json"}


def is_own_report(path: Path) -> bool:
    """Whether a folder or a file was written by ``analyse --report``, so that the next one replaces it."""
    from consistency.referee.system.folders import read_manifest

    try:
        if path.is_dir():
            others = {each.name for each in path.iterdir()} - {"manifest.json", *REPORT_FILES}
            return read_manifest(path).get("kind") == "verdict" and not others
        return path.read_bytes().endswith(MARK.encode())
    except (InputError, OSError):
        return False


def write_document(
    document: Document, html: Path | None, pdf: Path | None, *, advance: Advance = lambda _: None
) -> None:
    """The document in both formats, each file whole or not at all; None leaves one out."""
    from consistency.referee.show import as_html
    from consistency.referee.show.svg import paint

    contents: list[tuple[Path, bytes]] = []
    pictures = paint(document)
    if html is not None:
        contents.append((html, as_html.render(document, pictures).encode("utf-8")))
        advance(1)
    if pdf is not None:
        from consistency.referee.show.pdf import render_pdf

        contents.append((pdf, render_pdf(document, pictures)))
        advance(1)
    for path, content in contents:
        write_file(path, content)


def require_plot(path: Path, overwrite: bool) -> None:
    """Refuse, before any work, a plot that cannot be written.

    Raises
    ------
    InputError
        The kind of file is unknown, the file exists, or it cannot be written.
    """
    if path.suffix.lower() not in KINDS:
        raise InputError(f"--plot {path}: must end in {', '.join(KINDS)}")
    require("a plot", "plot")
    require_writable(path, overwrite)


def plotted(draw: Callable[[], Drawing], path: str | Path | None) -> Drawing:
    """A figure of Matplotlib, which is written to ``path`` as well; needs ``[plot]``.

    Raises
    ------
    InputError
        Matplotlib is not installed, the kind of file is unknown, or it cannot be written.
    """
    require("a plot", "plot")
    from consistency.referee.show.svg import drawn, saved

    figure = drawn(draw)
    if path is not None:
        path = Path(path)
        require_plot(path, overwrite=True)
        write_file(path, saved(figure, path.suffix.lower().removeprefix(".")))
    return figure


def require_writable(path: Path, overwrite: bool) -> None:
    """Refuse, before any work, what cannot be written or must not be replaced."""
    if path.is_dir():
        raise InputError(f"{path}: is a folder; name a file")
    if (path.exists() or path.is_symlink()) and not overwrite:
        raise InputError(f"{path}: exists already; name another file or add --overwrite")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}."):
            pass
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None


def write_file(path: Path, content: bytes) -> None:
    """A file, whole or not at all; raises :class:`InputError` where the system refuses."""
    try:
        write_whole(path, content)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None
