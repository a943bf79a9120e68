"""``sensor.toml`` with its intervals in comments, and the same for programs."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import tomli_w

from consistency.bench.scenario import PicturedSensor
from consistency.bench.scenario.effects.node_tables import BiasMap, DisparityGrowth
from consistency.referee.diagnostics.verdict.as_dictionary import plain
from consistency.referee.errors import InputError
from consistency.referee.system.atomic import write_whole
from consistency.referee.system.folders import writing
from consistency.referee.types import Array
from consistency.stereo.characterising.characterise import NAMES, Characterisation
from consistency.stereo.characterising.wording import counted, interval, sentences


def believed(of: Characterisation) -> PicturedSensor:
    """The sensor as a filter should believe it: noise drawn anew, and growth and bias map where they are shown."""
    changes: dict[str, Any] = {"sigma": tuple(_rounded(c.sigma.value, 5) for c in of.coordinates)}
    changes["disparity_growth"] = changes["bias"] = None
    if of.growth is not None and of.growth.shown:
        ratio = [_rounded(s.value / of.coordinates[2].sigma.value, 4) for s in of.growth.sigma]
        nodes = [_rounded(d, 5) for d in of.growth.nodes]
        changes["disparity_growth"] = DisparityGrowth(disparity=tuple(nodes), ratio=tuple(ratio))
    if of.bias is not None and of.bias.shown.any():
        matrices = {f"bias_{NAMES[k]}": _matrix(of.bias.matrix(int(k))) for k in np.flatnonzero(of.bias.shown)}
        u, v = (tuple(_rounded(x, 6) for x in nodes) for nodes in (of.bias.grid.u, of.bias.grid.v))
        changes["bias"] = BiasMap(u=u, v=v, **matrices)
    return of.sensor.model_copy(update=changes)


def sensor_text(of: Characterisation, others: Mapping[str, Any] = MappingProxyType({})) -> str:
    """The text of ``sensor.toml``; ``others`` are tables of the log that stay as they are (motion, start, ...)."""
    sensor = believed(of)
    lines = [f"# {line}" for line in ("Measured by 'consistency characterise'.", counted(of) + ".", *sentences(of))]
    lines += [f'model = "{sensor.model}"', _pair("sigma_px", sensor.sigma)]
    lines += [
        f"# sigma_{c.name} {interval(c.sigma)}; with offsets and bias in it {c.pooled:.4g}" for c in of.coordinates
    ]
    lines += [f"f_px = {sensor.f!r}", f"B_m = {sensor.B!r}"]
    for key in ("disparity", "image", "principal_point"):
        if (value := getattr(sensor, key)) is not None:
            lines.append(_pair(f"{key}_px", value))
    lines += _growth_lines(of, sensor) + _bias_lines(of, sensor)
    tables = {"mount": {key: list(value) for key, value in sensor.mount.model_dump().items()}, **others}
    return "\n".join(lines) + "\n\n" + tomli_w.dumps({key: value for key, value in tables.items() if value is not None})


def _growth_lines(of: Characterisation, sensor: PicturedSensor) -> list[str]:
    if sensor.disparity_growth is None or of.growth is None:
        return []
    lines = ["", "[disparity_growth]", "# sigma of d is sigma[2] times the ratio, linear between the nodes; px:"]
    lines += [f"# {interval(s)} at {d:.4g}" for d, s in zip(of.growth.nodes, of.growth.sigma, strict=True)]
    growth = sensor.disparity_growth
    return [*lines, _pair("disparity_px", growth.disparity), _pair("ratio", growth.ratio)]


def _bias_lines(of: Characterisation, sensor: PicturedSensor) -> list[str]:
    if sensor.bias is None or of.bias is None:
        return []
    bias, lines = of.bias, ["", "[bias]", "# measured is ideal + bias + noise; rows are v, columns are u"]
    unknown = np.flatnonzero(~bias.grid.known)
    if len(unknown):
        columns = len(bias.grid.u)
        places = ", ".join(f"({bias.grid.u[i % columns]:.4g}, {bias.grid.v[i // columns]:.4g})" for i in unknown)
        lines.append(f"# zero because nothing is known there, at (u, v): {places}")
    lines += [_pair("u_px", sensor.bias.u), _pair("v_px", sensor.bias.v)]
    for k, name in enumerate(NAMES):
        matrix = getattr(sensor.bias, f"bias_{name}")
        if not matrix:  # left out
            lines.append(f"# none is shown in {name} (p {bias.p_value[k]:.2g})")
            continue
        half = bias.half[k].reshape(len(bias.grid.v), -1)
        lines.append(f"bias_{name}_px = [")
        for row, widths in zip(matrix, half, strict=True):
            halves = ", ".join("unknown" if np.isnan(w) else f"±{w:.2g}" for w in widths)
            lines.append(f"  [{', '.join(map(repr, row))}],  # {halves}")
        lines.append("]")
    return lines


def as_json(of: Characterisation) -> str:
    """All estimates with their intervals, for programs."""
    out = {
        "source": of.source, "observations": of.rows, "tracks": of.tracks, "left_out": dict(of.left_out),
        "confidence": 1.0 - of.level.rate, "sensor": believed(of).model_dump(mode="json", exclude_none=True),
        "coordinates": {c.name: _coordinate(c) for c in of.coordinates},
        "gross": of.gross._asdict(), "notes": list(of.notes), "sentences": sentences(of),
        "moving_over_rest": [r._asdict() for r in of.ratio],
    }  # fmt: skip
    if of.growth is not None:
        nodes = [{"disparity": d} | s._asdict() for d, s in zip(of.growth.nodes, of.growth.sigma, strict=True)]
        out["growth"] = {"nodes": nodes, "p_value": of.growth.p_value, "shown": of.growth.shown}
    if of.bias is not None:
        grid = of.bias.grid
        out["bias"] = {"u": grid.u, "v": grid.v, "known": grid.known, "rows": grid.rows, "value": of.bias.value,
                       "half_width": of.bias.half, "p_value": of.bias.p_value, "shown": of.bias.shown}  # fmt: skip
    return json.dumps(plain(out), indent=2, allow_nan=False)


def _coordinate(c: Any) -> dict[str, Any]:
    estimates = {key: (e := getattr(c, key)) and e._asdict() for key in ("sigma", "correlation", "offset")}
    shape = {"tail_weight": c.tails.weight._asdict(), "skewness": c.tails.skewness,
             "excess_kurtosis": c.tails.excess_kurtosis, "normality_p": c.tails.p_value,
             "mixture": None if c.tails.mixture is None else vars(c.tails.mixture)}  # fmt: skip
    return estimates | shape | {"pooled": c.pooled, "about_tracks": c.about_tracks, "autocorrelation": c.lags}


def require_free_file(path: Path, overwrite: bool) -> None:
    """Refuse, before any work, a file that exists or cannot be written.

    Raises
    ------
    InputError
        Says why.
    """
    if path.is_dir():
        raise InputError(f"--out {path}: is a folder; name a file such as sensor.toml")
    if path.suffix != ".toml":
        raise InputError(f"--out {path}: must end in .toml")
    if path.exists() and not overwrite:
        raise InputError(f"--out {path}: exists already; name another file or add --overwrite")
    with writing(path), tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}."):
        pass


def write_sensor(path: Path, text: str) -> None:
    """Write the file whole or not at all."""
    with writing(path):
        write_whole(path, text.encode("utf-8"))


def _pair(key: str, values: Any) -> str:
    return f"{key} = [{', '.join(repr(value) for value in values)}]"


def _rounded(value: float, digits: int) -> float:
    return float(f"{value:.{digits}g}")


def _matrix(values: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(round(float(x), 3) + 0.0 for x in row) for row in values)
