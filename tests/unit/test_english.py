"""Turns of phrase that readers stumbled over do not come back, in the text that users and readers meet.

Pages without their code and quotations; docstrings, help and messages of the package. A phrase is a whole one: its
right uses ("there is no truth") are left out by its pattern.
"""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = ["*.md", "docs/*.md", "docs/reference/*.md", "docs/api/*.md", "docs/examples/**/*.md", "experiments/*.md"]
PAGES += ["benchmarks/*.md", "scenarios/*.md"]
MODULES = ["consistency/**/*.py", "docs/gallery/*.py", "docs/examples/**/*.py", "experiments/*.py"]
PHRASES = {  # pattern: what to write
    r"\bin service\b": "deployed",
    r"\banew\b": "again",
    r"(?<!few )\b(goes|go|went) on\b(?! to\b)": "continues",  # few go on: a world of the rates
    r"\bthere twice\b": "duplicated",
    r"\botherwise than\b": "disagree in more than",
    r"(?<!here )\b(is|are) no (?!(longer|more|less|better|worse|smaller|larger|greater|such)\b)[a-z]+": "is not a",
    r"\b[Cc]hance (to|that)\b": "probability of",
    r"\bGaussian has them\b": "than the Gaussian allows",
    r"\bas of (a|an|the|those|what|one|old|some)\b": "such as that of",
    r"\b[Tt]ake off\b": "remove",
    r"\bthrough filters\b": "run filters on",
    r"\bonce a trial\b|\bone question a script\b|\bto and fro\b|\bElse what\b": "a whole sentence",
    r"\b(so )?seldom\b": "rarely",
    r"\bA catch\b": "For example",
    r"\bhas the room for\b": "says where everything is",
    r"\b[Ff]or want of\b": "because there is no",
    r"\bwho is blamed\b": "failure attribution",
    r"\ball the same,": "nevertheless",
    r"\bin one go\b|\bof one go\b": "uninterrupted",
    r"^(All of it|What came of it|The same|Owns nothing[^.]*)\.$": "a sentence with a verb",
    r"\bstands? there\b": "is there",
    r"\bthat stand as\b": "treated as",
    r"\b1 less the\b": "1 - ",
    r"\bas it must be\b": "",
    r"\bnone is\b[^.]*\bof these\b": "none of these is",
    r"\bby the way of\b|\bin the way of\b": "by",
    r"\bFor programs\b": "Print the result as JSON",
    r"\bwith the sentence that\b": "which says that",
}


def pages(root=ROOT):
    """Text of each page without code, quotations and links' addresses."""
    found = {}
    for path in sorted({path for pattern in PAGES for path in root.glob(pattern)}):
        text = re.sub(r"^(```|~~~).*?^\1", "", path.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
        text = re.sub(
            r"`[^`]*`|\"[^\"]*\"|'[^'\n]{12,}'|\]\([^)]*\)|^ {4}.*$|<!--.*?-->", " ", text, flags=re.MULTILINE
        )
        found[str(path.relative_to(root))] = " ".join(text.split())
    return found


def strings(root=ROOT):
    """Docstrings, help and messages of each module: all texts in it that are sentences or parts of some."""
    found = {}
    for path in sorted({path for pattern in MODULES for path in root.glob(pattern)}):
        nodes = ast.walk(ast.parse(path.read_text("utf-8")))
        texts = [node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)]
        clean = (re.sub(r"``[^`]*``|`[^`]*`|\"[^\"]*\"", " ", text) for text in texts if " " in text)
        found[str(path.relative_to(root))] = [" ".join(text.split()) for text in clean]
    return found


def counted(root=ROOT):
    """Where each phrase stands, with some words around it."""
    texts = [(name, text) for name, text in pages(root).items() if name != "CHANGELOG.md"]
    texts += [(name, text) for name, each in strings(root).items() for text in each]
    return {
        phrase: [
            f"{name}: ...{text[max(0, m.start() - 40) : m.end() + 30]}..."
            for name, text in texts
            for m in re.finditer(phrase, text)
        ]
        for phrase in PHRASES
    }


@pytest.mark.parametrize("phrase", PHRASES)
def test_a_turn_of_phrase_does_not_come_back(phrase, found):
    assert found[phrase] == [], f"write: {PHRASES[phrase]}"


@pytest.fixture(scope="module")
def found():
    return counted()
