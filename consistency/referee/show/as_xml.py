"""What was judged, in the XML of JUnit: a case for each verdict, its sentence the message of a failure."""

from __future__ import annotations

import re
from xml.sax.saxutils import escape, quoteattr

from consistency.referee.diagnostics.number_words import with_subject
from consistency.referee.show.blocks import Document, Reason

FORBIDDEN = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")  # XML 1.0, section 2.2


def render(document: Document) -> str:
    """One suite, named as the document."""
    cases = list(document.reasons)
    failed = sum(not case.has_passed for case in cases)
    counts = f'tests="{len(cases)}" failures="{failed}" errors="0" skipped="0"'
    inside = "\n".join(_case(case, document.title) for case in cases)
    if document.command:
        command = f'<property name="command" value={_attribute(document.command)}/>'
        inside = f"<properties>{command}</properties>\n{inside}"
    return (
        '<?xml version="1.0" encoding="utf-8"?>\n'
        f"<testsuites {counts}>\n<testsuite name={_attribute(document.title)} {counts}>\n{inside}\n</testsuite>\n"
        "</testsuites>\n"
    )


def _case(case: Reason, title: str) -> str:
    head = f"<testcase classname={_attribute(case.group or title)} name={_attribute(case.name)}>"
    lines = [with_subject(case.name, case.sentence), *(f"- {other}" for other in case.others)]
    text = escape(_allowed("\n".join(lines)))
    if case.has_passed:
        return f"{head}\n<system-out>{text}</system-out>\n</testcase>"
    return f"{head}\n<failure message={_attribute(case.sentence)}>{text}</failure>\n</testcase>"


def _attribute(text: str) -> str:
    return quoteattr(_allowed(text))


def _allowed(text: str) -> str:
    return FORBIDDEN.sub("\ufffd", text)
