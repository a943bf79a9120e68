"""Why there are no pose errors where the truth is not known."""

from __future__ import annotations

from consistency.bench.pages.report_input import Study
from consistency.referee.document.blocks import Text
from consistency.referee.pages.section import STUDY, Section


def read(study: Study) -> Study | None:
    return None if study.has_truth else study


def show(study: Study) -> tuple[Text, ...]:
    return (Text(note(study), style="note"),)


def note(study: Study) -> str:
    return (
        f"The truth of {study.name} is not known, so there are no pose errors and no NEES to show; the innovations "
        f"below are {'all that can be judged' if study.judged else 'reported and not judged'}."
    )


SECTION = Section(STUDY, read, show)
