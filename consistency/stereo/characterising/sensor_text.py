"""What is known of a sensor: in sentences, on a terminal, for programs, and as ``sensor.toml`` with its intervals."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from consistency.bench.scenario import PicturedSensor, toml_text
from consistency.bench.scenario.observations import BiasMap, DisparityGrowth
from consistency.bench.store.recorded_log import sensor_keys
from consistency.referee.diagnostics.number_words import p_text
from consistency.referee.diagnostics.verdict import plain
from consistency.referee.diagnostics.verdict_parts import Interval
from consistency.referee.errors import InputError
from consistency.referee.show.blocks import Block, Cell, Column, Quantity, Table, Text, table
from consistency.referee.system import write_whole, writing
from consistency.stereo.characterising.characterise import NAMES, BiasEstimate, Characterisation, Coordinate

GAUSSIAN = 1e-3  # p-value of normality below which a distribution is called other than Gaussian
HEADS = ("", "noise px", "correlation", "offset share", "1/nu", "kurtosis", "pooled px")


def interval(estimate: Interval, digits: int = 4, factor: float = 1.0) -> str:
    """A value and its interval, ``1.34 (1.31 to 1.36)``."""
    value, low, high = np.multiply(factor, estimate)
    return f"{value:.{digits}g} ({low:.{digits}g} to {high:.{digits}g})"


def sentences(of: Characterisation) -> list[str]:
    """What is noise, what is bias, what is white and what Gaussian, a sentence each."""
    texts = [_noise(c) for c in of.coordinates]
    texts.append(_growth(of))
    if of.bias is not None:
        texts.append(_bias(of.bias))
    what = "are more than"
    if of.bias is None:
        what = "are of tracks that are somewhere more than"
    texts.append(
        f"{interval(of.gross, 2, 100.0)} % of the observations {what} 6 robust sd off, and are not part of sigma."
    )
    if of.ratio:
        ratios = [f"{name} {interval(ratio, 3)}" for name, ratio in zip(NAMES, of.ratio, strict=True)]
        texts.append(f"Noise while moving over noise at rest: {', '.join(ratios)}.")
    texts += of.notes
    texts.append(f"All intervals hold together with probability {100 * (1 - of.level.rate):g} % at least.")
    return texts


def _noise(c: Coordinate) -> str:
    parts = [f"{c.name}: {interval(c.sigma)} px of noise"]
    if c.correlation is not None:
        if c.white:
            parts.append("white")
        else:
            parts.append(f"not white, correlation {interval(c.correlation, 2)} with the step before")
    parts.append(_shape(c))
    if c.offset is not None:
        percent = f"{100 * c.offset.high:.2g}"
        if c.offset.low > 0:
            share = f"{100 * c.offset.value:.2g} % of the variance ({100 * c.offset.low:.2g} to {percent})"
            parts.append(f"each track has an offset of its own, sd {c.offset_px:.3g} px, {share}")
        else:
            parts.append(f"no constant offset of tracks is shown (at most {percent} % of the variance)")
    return "; ".join(parts) + "."


def _shape(c: Coordinate) -> str:
    """Whether a noise is Gaussian, and what it is otherwise."""
    mixture = c.tails.mixture
    if c.tails.weight.low > 0 and mixture is not None:
        core = mixture.core * c.sigma.value
        wide = mixture.wide * c.sigma.value
        percent = 100 * mixture.share
        return f"not Gaussian: as if {100 - percent:.3g} % had sd {core:.3g} px and {percent:.2g} % {wide:.3g} px"
    if c.tails.weight.low > 0:
        nu = 1.0 / c.tails.weight.value
        return f"not Gaussian, with tails of Student's distribution with {nu:.3g} degrees of freedom"
    if c.tails.p_value < GAUSSIAN:
        return f"not Gaussian (skewness {c.tails.skewness:.2g})"
    return "Gaussian"


def _growth(of: Characterisation) -> str:
    growth = of.growth
    if growth is None:
        return "Growth of sigma_d with disparity: not known, the disparities are all alike."
    p = p_text(growth.p_value)
    if not growth.shown:
        ends = f"{growth.nodes[0]:.3g} and {growth.nodes[-1]:.3g} px"
        return f"No growth of sigma_d with disparity is shown between {ends} (p {p})."
    values = [f"{interval(s, 3)} at {d:.3g}" for d, s in zip(growth.nodes, growth.sigma, strict=True)]
    return f"sigma_d depends on the disparity (p {p}), in px: {', '.join(values)}."


def _bias(bias: BiasEstimate) -> str:
    total = len(bias.grid.known)
    known = int(bias.grid.known.sum())
    if known == 0:
        return "No node of the bias map has enough data; the map is not written."
    unknown = ""
    if known < total:
        unknown = f" {total - known} of {total} nodes of the map have too few data and are zero."
    if not bias.shown.any():
        widest = np.nanmedian(bias.half)
        return f"No bias over the image is shown; the median interval of a node is ±{widest:.2g} px.{unknown}"
    shown = []
    hidden = []
    for k, name in enumerate(NAMES):
        if bias.shown[k]:
            values = bias.believed[k, bias.grid.known]
            shown.append(f"{name} {values.min():+.2f} to {values.max():+.2f} px (p {p_text(bias.p_value[k])})")
        else:
            hidden.append(name)
    text = f"A constant bias over the image is shown: {', '.join(shown)}"
    if hidden:
        text += f"; none is shown in {' and '.join(hidden)}"
    return f"{text}.{unknown}"


def counted(of: Characterisation) -> str:
    """Observations and tracks that were used, and what was left out."""
    text = f"{of.rows} observations of {of.tracks} tracks of {of.source}"
    left_out = [f"{count} {reason}" for reason, count in of.left_out.items() if count]
    if left_out:
        text += f"; left out: {', '.join(left_out)}"
    return text


def sensor_blocks(of: Characterisation) -> tuple[Block, ...]:
    """One row a coordinate, then a sentence for each answer."""
    return Text(counted(of)), estimates_table(of, HEADS, 4), *map(Text, sentences(of))


def estimates_table(of: Characterisation, heads: Sequence[str], digits: int, caption: str = "") -> Table:
    """One row a coordinate; ``digits`` of its noise."""
    rows: list[tuple[Cell, ...]] = []
    for c in of.coordinates:
        shares = map(_or_dash, (c.correlation, c.offset, c.tails.weight))
        pooled = Quantity(c.pooled, digits=f".{digits}g")
        rows.append((c.name, interval(c.sigma, digits), *shares, f"{c.tails.excess_kurtosis:.2f}", pooled))
    columns = [Column(heads[0])]
    for head in heads[1:]:
        columns.append(Column(head, number=True))
    return table(tuple(columns), rows, "Estimates of the sensor", caption=caption)


def _or_dash(estimate: Interval | None) -> Cell:
    if estimate is None:
        return Quantity(None)
    return interval(estimate, 2)


def believed_sensor(of: Characterisation) -> PicturedSensor:
    """The sensor as a filter should believe it: noise drawn again, and growth and bias map where they are shown."""
    sigma = [c.sigma.value for c in of.coordinates]
    changes: dict[str, Any] = {"sigma": _rounded(sigma, 5), "disparity_growth": None, "bias": None}
    if of.growth is not None and of.growth.shown:
        ratio = [s.value / sigma[2] for s in of.growth.sigma]
        changes["disparity_growth"] = DisparityGrowth(disparity=_rounded(of.growth.nodes, 5), ratio=_rounded(ratio, 4))
    if of.bias is not None and of.bias.shown.any():
        matrices = {}
        for k in np.flatnonzero(of.bias.shown):
            rounded = of.bias.matrix(int(k)).round(3) + 0.0
            matrices[f"bias_{NAMES[k]}"] = tuple(map(tuple, rounded.tolist()))
        grid = of.bias.grid
        changes["bias"] = BiasMap(u=_rounded(grid.u, 6), v=_rounded(grid.v, 6), **matrices)
    return of.sensor.model_copy(update=changes)


def _rounded(values: Iterable[float], digits: int) -> tuple[float, ...]:
    return tuple(float(f"{value:.{digits}g}") for value in values)


def measured_sensor_toml(of: Characterisation, others: Mapping[str, Any] = MappingProxyType({})) -> str:
    """The text of ``sensor.toml``; ``others`` are tables of the log that stay as they are (motion, start, ...)."""
    comments = ["Measured by 'consistency characterise'.", counted(of) + ".", *sentences(of)]
    if of.bias is not None:
        for k in np.flatnonzero(of.bias.shown):
            comments.append(
                f"Half widths of bias_{NAMES[k]}, px; rows are v, columns are u; nan: not known, taken as zero:"
            )
            for row in of.bias.half[k].reshape(len(of.bias.grid.v), -1):
                comments.append("  " + " ".join(f"±{width:.2g}" for width in row))
    tables = sensor_keys(believed_sensor(of))
    for key, value in others.items():
        if value is not None:
            tables[key] = value
    return "".join(f"# {line}\n" for line in comments) + toml_text(tables)


def as_json(of: Characterisation) -> str:
    """All estimates with their intervals, for programs."""
    out = {
        "source": of.source,
        "observations": of.rows,
        "tracks": of.tracks,
        "left_out": dict(of.left_out),
        "confidence": 1.0 - of.level.rate,
        "sensor": believed_sensor(of).model_dump(mode="json", exclude_none=True),
        "coordinates": {c.name: _coordinate(c) for c in of.coordinates},
        "gross": of.gross._asdict(),
        "notes": list(of.notes),
        "sentences": sentences(of),
        "moving_over_rest": [ratio._asdict() for ratio in of.ratio],
    }
    if of.growth is not None:
        nodes = []
        for disparity, sigma in zip(of.growth.nodes, of.growth.sigma, strict=True):
            nodes.append({"disparity": disparity} | sigma._asdict())
        out["growth"] = {"nodes": nodes, "p_value": of.growth.p_value, "shown": of.growth.shown}
    if of.bias is not None:
        out["bias"] = {
            "u": of.bias.grid.u,
            "v": of.bias.grid.v,
            "known": of.bias.grid.known,
            "rows": of.bias.grid.rows,
            "value": of.bias.value,
            "half_width": of.bias.half,
            "p_value": of.bias.p_value,
            "shown": of.bias.shown,
        }
    return json.dumps(plain(out), indent=2, allow_nan=False)


def _coordinate(c: Coordinate) -> dict[str, Any]:
    return {
        "sigma": c.sigma._asdict(),
        "correlation": c.correlation and c.correlation._asdict(),
        "offset": c.offset and c.offset._asdict(),
        "tail_weight": c.tails.weight._asdict(),
        "skewness": c.tails.skewness,
        "excess_kurtosis": c.tails.excess_kurtosis,
        "normality_p": c.tails.p_value,
        "mixture": c.tails.mixture and c.tails.mixture._asdict(),
        "pooled": c.pooled,
        "about_tracks": c.about_tracks,
        "autocorrelation": c.lags,
    }


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
