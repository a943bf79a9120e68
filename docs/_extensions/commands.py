"""A page for each command, from Typer's own generator of documents."""

from __future__ import annotations

import re
import subprocess
import sys

from outside import FOLDER, write_changed
from sphinx.application import Sphinx

GENERATOR = [sys.executable, "-m", "typer", "consistency.commands", "utils", "docs", "--name", "consistency"]
OPTION = re.compile(r"(?<![`\w\-\[])--[a-z][a-z-]*")  # in a sentence, where two hyphens would become a dash
EXAMPLES = re.compile(r"\x08?\n?Examples:\n((?:  .*\n)+)")
INDEX = """# Command line

`consistency COMMAND --help` says on a terminal what stands here.

{listing}

```{{toctree}}
:hidden:

{names}
```

## Exit status

| status | meaning |
| --- | --- |
| 0 | done |
| 1 | the verdict asked for failed (`--fail-on`, `reproduce`) |
| 2 | unusable input; one line says what to mend |
| 130 | stopped by Ctrl-C |
| 128 + n | stopped by signal n |
"""


def write_commands(app: Sphinx) -> None:
    """Write generated/commands/: index.md, and NAME.md for each command."""
    text = subprocess.run(GENERATOR, capture_output=True, text=True, check=True).stdout
    _, *parts = re.split(r"^## `consistency (\S+)`\n", text, flags=re.MULTILINE)
    pages = dict(zip(parts[::2], parts[1::2], strict=True))
    listing = []
    for name, body in pages.items():
        body = re.sub(r"^\* .*", lambda line: OPTION.sub(r"`\g<0>`", line[0]), body, flags=re.MULTILINE)
        body = re.sub(r"\bdocs/([\w/-]+\.md)", r"[\g<0>](../../\1)", body)
        body = EXAMPLES.sub(lambda found: f"**Examples**:\n\n```console\n{plain(found[1])}```\n", body)
        write_changed(FOLDER / "commands" / f"{name}.md", f"# consistency {name}\n{body}")
        listing.append(f"- [{name}]({name}.md): {body.strip().splitlines()[0]}")
    index = INDEX.format(listing="\n".join(listing), names="\n".join(pages))
    write_changed(FOLDER / "commands" / "index.md", index)


def plain(block: str) -> str:
    """The lines of an indented block, with the prompt of a console."""
    return "".join(f"$ {line.strip()}\n" for line in block.splitlines())


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("builder-inited", write_commands)
    return {"parallel_read_safe": True}
