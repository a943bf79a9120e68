"""Blocks and commands of the documents, each with its page and line.

An indented block is commands of a shell. Everything else is fenced and says in its fence what it is; ``text`` is what
a program prints, or a formula.
"""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDERS = (
    "docs",
    "docs/reference",
    "docs/examples",
    "docs/examples/repository",
    "experiments",
    "benchmarks",
    "scenarios",
)
PATHS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(p for f in FOLDERS for p in sorted((ROOT / f).glob("*.md")))]
PAGES = [str(path.relative_to(ROOT)) for path in PATHS]

SHELL = {"indented", "bash", "console", "sh", "shell"}
PROGRAMS = {"bash", "consistency", "git", "make", "pip", "pre-commit", "pytest", "python"}
BLOCK = re.compile(
    r"^(?P<fence>`{3,}|~{3,}|:{3,})(?P<language>[^\n]*)\n(?P<fenced>.*?)^(?P=fence)[ ]*$"
    r"|(?:(?<=\n\n)|\A)(?P<indented>(?:^(?: {4}|\t)[^\n]*\n+)+)",
    re.MULTILINE | re.DOTALL,
)


@dataclass(frozen=True)
class Block:
    page: str
    line: int
    language: str  # what the fence says, or "indented"
    text: str
    before: str  # the paragraph above it
    part: str = ""  # the heading of the second level above it

    def __str__(self):
        return f"{self.page}:{self.line}"


@dataclass(frozen=True)
class Command:
    page: str
    line: int
    text: str  # on one line, without its comment
    inline: bool = False  # in a sentence, which may leave out what is required

    def __str__(self):
        return f"{self.page}:{self.line} {self.text}"

    @property
    def synopsis(self):
        """Options in brackets: what may be said, not what is typed."""
        return " [" in self.text

    @property
    def words(self):
        """Words of a shell, without settings of the environment and without what is piped in."""
        text = re.sub(r"[\[\]]|\.\.\.|…", " ", self.text) if self.synopsis else self.text
        words = shlex.split(text.rpartition(" | ")[2] if not self.synopsis else text, comments=True)
        while words and re.fullmatch(r"[A-Z_]+=.*", words[0]):
            words = words[1:]
        return [word.split("|")[0] for word in words if word != "|"]


def read(page):
    return (ROOT / page).read_text(encoding="utf-8")


def blocks(page, *languages, part=""):
    """Blocks of a page in order, of these languages, below the heading ``part`` of the second level."""
    text, found = read(page), []
    for match in BLOCK.finditer(text):
        before = text[: match.start()]
        language = "indented" if match["fence"] is None else match["language"].strip()
        inside = (
            match["fenced"] if match["indented"] is None else re.sub(r"^(?: {4}|\t)", "", match["indented"], flags=re.M)
        )
        line = before.count("\n") + 1 + (match["fence"] is not None)
        heading = re.findall(r"^## (.*)$", BLOCK.sub("", before), re.MULTILINE)[-1:]
        if (not languages or language in languages) and (not part or heading == [part]):
            above = before.strip().rpartition("\n\n")[2]
            found.append(Block(page, line, language, inside, above, "".join(heading)))
    return found


def typed(block):
    """Commands of a block of a shell, continued lines joined."""
    found = []
    for number, line in enumerate(block.text.splitlines(), block.line):
        open_before = found and found[-1].text.endswith("\\")
        if open_before or (found and re.match(r"\s+\[", line)):
            found[-1] = Command(block.page, found[-1].line, found[-1].text.rstrip("\\").rstrip() + " " + line.strip())
        elif line.strip():
            found.append(Command(block.page, number, line.removeprefix("$ ").strip()))
    return found


def mentioned(page):
    """Commands inside sentences."""
    bare = BLOCK.sub(lambda match: "\n" * match[0].count("\n"), read(page))
    return [
        Command(page, bare[: match.start()].count("\n") + 1, " ".join(match[1].split()), inline=True)
        for match in re.finditer(r"`([^`]+)`", bare)
        if match[1].split()[0] in PROGRAMS and " " in match[1]
    ]


def commands(page):
    """All commands of a page, those of its blocks first."""
    return [command for block in blocks(page) if block.language in SHELL for command in typed(block)] + mentioned(page)


def parsed(words, whole=True):
    """Name and values of a command, as the command line reads them.

    Not ``whole``: what is required may be left out, and a placeholder may stand for a number.

    Raises
    ------
    typer.BadParameter.__base__, KeyError
        There is no such option; a value is of the wrong type; something is missing. There is no such command.
    """
    import typer

    from consistency.commands.app import app

    root = typer.main.get_command(app)
    name, *arguments = words
    command = root.commands[name]
    if not whole:
        for parameter in command.params:
            parameter.required = False
    with root.make_context("consistency", [name]) as top:
        for _ in arguments:
            try:
                with command.make_context(name, list(arguments), parent=top) as context:
                    return name, dict(context.params)
            except typer.BadParameter as error:
                at = next((i for i, word in enumerate(arguments) if word in error.param.opts), -1) + 1
                if whole or not (at and arguments[at].isupper()):
                    raise
                arguments[at] = "1"  # --runs N
        with command.make_context(name, arguments, parent=top) as context:
            return name, dict(context.params)
