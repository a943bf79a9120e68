"""What is known of a sensor, in sentences, and what a terminal shows of it."""

from __future__ import annotations

import numpy as np

from consistency.referee.diagnostics.verdict.parts import Interval
from consistency.referee.diagnostics.words.sentences import p_text
from consistency.referee.document.blocks import Block, Cell, Column, Quantity, Text, table
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
    return f"{share} % of the observations {what} 6 robust sd off, and are no part of sigma."


def _ratio(of: Characterisation) -> list[str]:
    if not of.ratio:
        return []
    texts = ", ".join(f"{name} {interval(r, 3)}" for name, r in zip(NAMES, of.ratio, strict=True))
    return [f"Noise while moving over noise at rest: {texts}."]


def counted(of: Characterisation) -> str:
    left = ", ".join(f"{count} {reason}" for reason, count in of.left_out.items() if count)
    return f"{of.rows} observations of {of.tracks} tracks of {of.source}" + (f"; left out: {left}" if left else "")


def blocks(of: Characterisation) -> tuple[Block, ...]:
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
