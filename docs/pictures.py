"""Draws pictures of README.md and of the case studies by scripts of the gallery: `python docs/pictures.py`."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS / "_extensions"))

from figures import plain_look, save  # noqa: E402 - in the folder above

PICTURES = ("gtsam_imu", "case_studies", "nine_centimetres", "regime", "own_file", "ellipses")

if __name__ == "__main__":
    for name in PICTURES:
        plain_look()
        figure = runpy.run_path(str(DOCS / "gallery" / f"plot_{name}.py"))["figure"]
        save(figure, DOCS / "images" / f"{name.replace('_', '-')}.png")
