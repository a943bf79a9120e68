"""Public packages by their short names: ``consistency.diagnostics`` is ``consistency.referee.diagnostics``.

The module is one and the same object under both names, and so are those below it.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

DOORS = {
    **{name: f"referee.{name}" for name in ("diagnostics", "errors")},
    **{
        name: f"bench.{name}"
        for name in (
            "challenging", "filters", "protocols", "runs", "scenario", "simulation", "store", "sweeps", "tuning",
            "types",
        )
    },
    "imaging": "stereo.rendered_images",
    "vision": "stereo.visual_odometry",
    "diagnostics.shared_errors": "referee.diagnostics.imperfect_truth.shared_errors",
    "diagnostics.skipping": "referee.diagnostics.records.skipping",
    "scenario.tables": "bench.scenario.tables.toml_tables",
    "reporting": "bench.pages",  # this and what is below it: of sections of reports written before there were roots
    "reporting.drawing": "referee.document.drawing",
    "reporting.model": "bench.pages.report_input",
    "reporting.section": "referee.pages.section",
}  # fmt: skip


class Doors(MetaPathFinder, Loader):
    """Finds ``consistency.NAME`` and what is below it in its root."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        top, _, rest = fullname.partition(".")
        room = rest.partition(".")[0]
        return ModuleSpec(fullname, self) if top == "consistency" and room in DOORS else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        name, below = spec.name.partition(".")[2], ""
        while name not in DOORS:
            name, _, last = name.rpartition(".")
            below = f".{last}{below}"
        module = import_module(f"consistency.{DOORS[name]}{below}")
        spec.loader_state = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        assert module.__spec__ is not None
        module.__spec__ = module.__spec__.loader_state  # its own, which the import of the short name has replaced


def open_doors() -> None:
    """Make the short names importable."""
    if not any(isinstance(finder, Doors) for finder in sys.meta_path):
        sys.meta_path.insert(0, Doors())
