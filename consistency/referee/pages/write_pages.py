"""Pages on the verdicts and records of any estimator: what a document of them holds, and documents as files.

Renderers of ``show`` write them. No statistic is computed here that the diagnostics do not already have.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from consistency.referee.diagnostics.number_words import plural, with_subject
from consistency.referee.diagnostics.record import Record
from consistency.referee.diagnostics.verdict import Verdict
from consistency.referee.errors import InputError
from consistency.referee.extras import missing, require
from consistency.referee.pages import verdicts
from consistency.referee.pages.ratio_figures import bound_figures, by_axis, ratio_by_group_figure
from consistency.referee.pages.record_figures import OVER_SIGMA, record_figures
from consistency.referee.pages.verdicts import Estimator, Judged, time_axis_of
from consistency.referee.show import FORMATS, as_html, rendered
from consistency.referee.show.blocks import Block, Chapter, Details, Document, Facts, Text, badges, number
from consistency.referee.system import (
    Advance,
    command_line,
    manifest_of,
    read_manifest,
    require_free,
    write_folder,
    write_whole,
)
from consistency.referee.verdicts.tables import region_tables

if TYPE_CHECKING:
    from collections.abc import Callable

    from matplotlib.figure import Figure as Drawing

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
    write_file(path, f"{rendered(replace(document, command=command_line()), path)}{MARK}".encode())
    return path


def require_report(report: Path, overwrite: bool) -> bool:
    """Refuse, before any work, a report that cannot be written; return whether it replaces what is there.

    Raises
    ------
    InputError
        Something other than a report of a verdict is there, without ``overwrite``; the name is of a page or of JSON,
        which a folder has; or the system refuses.
    """
    if report.suffix.lower() in (".html", ".pdf", ".json") and not report.is_dir():
        raise InputError(
            f"{report}: a report is a folder, which has the page, the PDF and the JSON, or FILE.xml, FILE.md"
        )
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
    from consistency.referee.show.figures import paint

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
    from consistency.referee.show.figures import drawn, saved

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


def compose_files(
    records: Sequence[Record], judged: Mapping[str, Verdict], title: str, manifest: Mapping[str, Any]
) -> Document:
    """The document that HTML and PDF show; a chapter for each of the records that has a verdict."""
    named = {record.name: record for record in records}
    tracks = tuple(Estimator(v.filter, i, f"0-{i}", v, v.failures) for i, v in enumerate(judged.values()))
    runs, steps = max(v.runs for v in judged.values()), max(v.steps for v in judged.values())
    clock = time_axis_of(np.full(steps, np.nan))
    study = Judged(title, "", runs, 0, clock, np.arange(1, steps + 1), tracks, until_decided=False)
    several = len(judged) > 1
    chapters = []
    for i, (name, verdict) in enumerate(judged.items()):
        sentence = [Text(with_subject(name, _ended(verdict.reasons[0])))] * several
        pictures = *bound_figures(verdict), *ratio_by_group_figure(verdict), *record_figures(named[name], verdict)
        at_once = [figure for figure in pictures if figure.title != OVER_SIGMA]
        unfolded = [Details(figure.title, (figure,)) for figure in pictures if figure.title == OVER_SIGMA]
        shown: tuple[Block, ...] = *sentence, *at_once, *unfolded
        chapters.append(Chapter(f"estimator-{i}", name, name, shown, _counts(named[name], verdict)))
    blocks = (
        *verdicts.judgement(study), *verdicts.bounds_tables(study), *region_tables(judged),
        *verdicts.diagnosis(study), *by_axis(study),
        Text(verdicts.method((study,)), "How a verdict comes about.", "note"),
    )  # fmt: skip
    notes = list(dict.fromkeys(note for name in judged for note in named[name].origin.notes))
    read = tuple(Text(note_sentence(note)) for note in notes)
    chapters += [
        Chapter("verdicts", "Verdict in figures", "Figures", blocks),
        Chapter("provenance", "What was read", "Files", (*read, Facts(facts(dict(manifest))))),
    ]
    words = badges([(name, verdict.status) for name, verdict in judged.items()])
    return Document(f"Estimator consistency: {title}", answer(judged), tuple(chapters), badges=words)


def answer(judged: Mapping[str, Verdict]) -> str:
    """The sentence of each verdict."""
    return " ".join(with_subject(name, _ended(verdict.reasons[0])) for name, verdict in judged.items())


def note_sentence(note: str) -> str:
    """A note as a sentence; a path, or the name of an estimator, at its beginning stays as it is."""
    first = note.split(maxsplit=1)[0]
    if "/" in first or first.endswith(":"):
        return _ended(note)
    return _ended(note[:1].upper() + note[1:])


def _ended(sentence: str) -> str:
    return sentence if sentence.endswith((".", "?")) else f"{sentence}."


def _counts(record: Record, verdict: Verdict) -> str:
    clock = time_axis_of(record.runs.t)
    length = plural(verdict.steps, "step" if record.origin.window is None else "window")
    size = f"{plural(verdict.runs, verdict.unit)} of {record.origin.window if record.runs.independent else length}"
    return f"{size}, {np.ptp(clock.values):.4g} s" if clock.word == "s" and len(record.runs.t) > 1 else size


def facts(manifest: dict[str, Any]) -> tuple[tuple[str, str], ...]:
    """What a manifest says of its run."""
    versions = manifest.get("versions") or {}
    wall, screening = manifest.get("wall_time_s"), manifest.get("screening")
    rows = {
        "Date": manifest.get("date"),
        "Seed": manifest.get("seed"),
        "Runs": manifest.get("runs"),
        "Scenario hash": manifest.get("scenario_hash"),
        "Screened": screening and "{broken} of {judged} observations leave the common motion".format_map(screening),
        "Command": manifest.get("command"),
        "Git commit": manifest.get("git_commit"),
        "Wall time": None if wall is None else f"{number(float(wall), '.1f')} s",
        "Versions": ", ".join(f"{name} {version}" for name, version in versions.items()) or None,
    }
    if manifest.get("complete") is False:
        rows["Complete"] = "no: the run was interrupted; the numbers are of the finished runs"
    return tuple((name, str(value)) for name, value in rows.items() if value is not None)
