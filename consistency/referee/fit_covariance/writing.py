"""A fitted model as a folder: noise.toml, motions with covariances, snippets, and a page with pictures."""

from __future__ import annotations

from pathlib import Path

from consistency.referee.extras import is_installed
from consistency.referee.fit_covariance.motions import write_motions
from consistency.referee.fit_covariance.noise_model import NoiseModel
from consistency.referee.fit_covariance.page import page
from consistency.referee.fit_covariance.snippets import snippets
from consistency.referee.fit_covariance.wording import document
from consistency.referee.show import as_html, as_json
from consistency.referee.system.folders import write_folder
from consistency.referee.system.provenance import manifest_of


def write_model(model: NoiseModel, folder: Path, overwrite: bool = False) -> list[Path]:
    """Write the folder, which appears whole or not at all; its files.

    Pictures need ``[plot]``; without it the page has none.

    Raises
    ------
    InputError
        The folder exists or cannot be written.
    """
    texts = snippets(model)
    texts["verdict.json"] = as_json.render(document(model)) + "\n"
    texts["report.html"] = as_html.render(page(model, with_pictures=is_installed("plot")))
    names: list[str] = []

    def contents(at: Path) -> None:
        names.extend(write_motions(model.stretches, at))
        for name, text in texts.items():
            (at / name).write_text(text, encoding="utf-8")

    write_folder(folder, manifest_of(kind="noise", source=model.name), contents, overwrite)
    return [folder / name for name in ("noise.toml", *names, *(each for each in texts if each != "noise.toml"))]
