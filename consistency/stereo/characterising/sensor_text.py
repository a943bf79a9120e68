"""What is known of a sensor: in sentences, on a terminal, for programs, and as ``sensor.toml`` with its intervals."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from consistency.bench.scenario import PicturedSensor, toml_text
from consistency.bench.scenario.effects.node_tables import BiasMap, DisparityGrowth
from consistency.bench.store.recorded_log import sensor_keys
from consistency.referee.diagnostics.verdict.as_dictionary import plain
from consistency.referee.diagnostics.verdict.parts import Interval
from consistency.referee.diagnostics.words.numbers import p_text
from consistency.referee.document.blocks import Block, Cell, Column, Quantity, Text, table
from consistency.referee.errors import InputError
from consistency.referee.system.atomic import write_whole
from consistency.referee.system.folders import writing
from consistency.referee.types import Array
from consistency.stereo.characterising.characterise import NAMES, Characterisation, Coordinate

GAUSSIAN = 1e-3  # p-value of normality below which a distribution is called other than Gaussian
HEADS = ("noise px", "correlation", "offset share", "1/nu", "kurtosis", "pooled px")


def interval(estimate: Interval, digits: int = 4, factor: float = 1.0) -> str:
    """A value and its interval, ``1.34 (1.31 to 1.36)``."""
    value, low, high = (f"{factor * x:.{digits}g}" for x in (estimate.value, estimate.low, estimate.high))
    return f"{value} ({low} to {high})"


def sentences(of: Characterisation) -> list[str]:
    """What is noise, what is bias, what is white and what Gaussian, a sentence each."""
    return [
        *(_noise(c) for c in of.coordinates),
        _growth(of),
        *_bias(of),
        _gross(of),
        *_ratio(of),
        *of.notes,
        f"All intervals hold together with probability {100 * (1 - of.level.rate):g} % at least.",
    ]


def _noise(c: Coordinate) -> str:
    parts = [f"{c.name}: {interval(c.sigma)} px of noise"]
    if c.correlation is not None:
        how = "white" if c.white else f"not white, correlation {interval(c.correlation, 2)} with the step before"
        parts.append(how)
    heavy = c.tails.weight.low > 0
    if heavy:
        nu = 1.0 / c.tails.weight.value
        parts.append(f"not Gaussian, with tails of Student's distribution with {nu:.3g} degrees of freedom")
        if (mixed := c.tails.mixture) is not None:
            core, wide = (value * c.sigma.value for value in (mixed.core, mixed.wide))
            percent = 100 * mixed.share
            mixture = f"{100 - percent:.3g} % had sd {core:.3g} px and {percent:.2g} % {wide:.3g} px"
            parts[-1] = f"not Gaussian: as if {mixture}"
    else:
        parts.append("Gaussian" if c.tails.p_value >= GAUSSIAN else f"not Gaussian (skewness {c.tails.skewness:.2g})")
    if c.offset is not None:
        shown = c.offset.low > 0
        share = f"{100 * c.offset.value:.2g} % of the variance ({100 * c.offset.low:.2g} to {100 * c.offset.high:.2g})"
        none = f"no constant offset of tracks is shown (at most {100 * c.offset.high:.2g} % of the variance)"
        parts.append(f"each track has an offset of its own, sd {c.offset_px:.3g} px, {share}" if shown else none)
    return "; ".join(parts) + "."


def _growth(of: Characterisation) -> str:
    growth = of.growth
    if growth is None:
        return "Growth of sigma_d with disparity: not known, the disparities are all alike."
    ends = f"{growth.nodes[0]:.3g} and {growth.nodes[-1]:.3g} px"
    if not growth.shown:
        return f"No growth of sigma_d with disparity is shown between {ends} (p {p_text(growth.p_value)})."
    values = ", ".join(f"{interval(s, 3)} at {d:.3g}" for d, s in zip(growth.nodes, growth.sigma, strict=True))
    return f"sigma_d depends on the disparity (p {p_text(growth.p_value)}), in px: {values}."


def _bias(of: Characterisation) -> list[str]:
    bias = of.bias
    if bias is None:
        return []
    if not bias.grid.known.any():
        return ["No node of the bias map has enough data; the map is not written."]
    known, total = int(bias.grid.known.sum()), len(bias.grid.known)
    unknown = f" {total - known} of {total} nodes of the map have too few data and are zero." if known < total else ""
    if not bias.shown.any():
        widest = float(np.nanmedian(bias.half))
        return [f"No bias over the image is shown; the median interval of a node is ±{widest:.2g} px.{unknown}"]
    texts = []
    for k in np.flatnonzero(bias.shown):
        values = bias.believed[k, bias.grid.known]
        texts.append(f"{NAMES[k]} {values.min():+.2f} to {values.max():+.2f} px (p {p_text(bias.p_value[k])})")
    hidden = [NAMES[k] for k in np.flatnonzero(~bias.shown)]
    without = f"; none is shown in {' and '.join(hidden)}" if hidden else ""
    return [f"A constant bias over the image is shown: {', '.join(texts)}{without}.{unknown}"]


def _gross(of: Characterisation) -> str:
    share = interval(of.gross, 2, 100.0)
    what = "are more than" if of.bias is not None else "are of tracks that are somewhere more than"
    return f"{share} % of the observations {what} 6 robust sd off, and are not part of sigma."


def _ratio(of: Characterisation) -> list[str]:
    if not of.ratio:
        return []
    texts = ", ".join(f"{name} {interval(r, 3)}" for name, r in zip(NAMES, of.ratio, strict=True))
    return [f"Noise while moving over noise at rest: {texts}."]


def counted(of: Characterisation) -> str:
    left = ", ".join(f"{count} {reason}" for reason, count in of.left_out.items() if count)
    return f"{of.rows} observations of {of.tracks} tracks of {of.source}" + (f"; left out: {left}" if left else "")


def sensor_blocks(of: Characterisation) -> tuple[Block, ...]:
    """One row a coordinate, then a sentence for each answer."""
    rows: list[tuple[Cell, ...]] = [
        (
            c.name, interval(c.sigma), _or_dash(c.correlation), _or_dash(c.offset), _or_dash(c.tails.weight),
            f"{c.tails.excess_kurtosis:.2f}", Quantity(c.pooled, digits=".4g"),
        )
        for c in of.coordinates
    ]  # fmt: skip
    columns = (Column(""), *(Column(head, number=True) for head in HEADS))
    return Text(counted(of)), table(columns, rows, "Estimates of the sensor"), *map(Text, sentences(of))


def _or_dash(estimate: Interval | None) -> Cell:
    return Quantity(None) if estimate is None else interval(estimate, 2)


def believed_sensor(of: Characterisation) -> PicturedSensor:
    """The sensor as a filter should believe it: noise drawn again, and growth and bias map where they are shown."""
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


def measured_sensor_toml(of: Characterisation, others: Mapping[str, Any] = MappingProxyType({})) -> str:
    """The text of ``sensor.toml``; ``others`` are tables of the log that stay as they are (motion, start, ...)."""
    sentence = "Measured by 'consistency characterise'."
    comments = [sentence, counted(of) + ".", *sentences(of), *_half_widths(of)]
    tables = {key: table for key, table in others.items() if table is not None}
    return "".join(f"# {line}\n" for line in comments) + toml_text(sensor_keys(believed_sensor(of)) | tables)


def _half_widths(of: Characterisation) -> list[str]:
    """Half widths of the intervals at the nodes of the bias map, a line for each row of the image."""
    if of.bias is None:
        return []
    lines = []
    for k in np.flatnonzero(of.bias.shown):
        lines.append(f"Half widths of bias_{NAMES[k]}, px; rows are v, columns are u; nan: not known, taken as zero:")
        rows = of.bias.half[k].reshape(len(of.bias.grid.v), -1)
        lines += ["  " + " ".join(f"±{width:.2g}" for width in row) for row in rows]
    return lines


def as_json(of: Characterisation) -> str:
    """All estimates with their intervals, for programs."""
    out = {
        "source": of.source, "observations": of.rows, "tracks": of.tracks, "left_out": dict(of.left_out),
        "confidence": 1.0 - of.level.rate, "sensor": believed_sensor(of).model_dump(mode="json", exclude_none=True),
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
    with writing(path):
        write_whole(path, text.encode("utf-8"))


def _rounded(value: float, digits: int) -> float:
    return float(f"{value:.{digits}g}")


def _matrix(values: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(round(float(x), 3) + 0.0 for x in row) for row in values)
