"""Where the numbers of a page come from."""

from __future__ import annotations

from typing import Any

from consistency.referee.document.wording import number


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
