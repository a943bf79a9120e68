"""From the errors of a chain to the tables of a sensor: growth of the noise of disparity, and local biases."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from consistency.bench.scenario.effects.node_tables import BiasMap, DisparityGrowth, bilinear, hats
from consistency.referee.errors import InputError
from consistency.referee.types import Array, Indices
from consistency.stereo.rendered_images.chain import Tracks

ROUNDS = 30  # of the fit of the growth, which settles in a few
FEWEST = 3  # observations of a track
NAMES = ("bias_u_px", "bias_v_px", "bias_d_px")


@dataclass(frozen=True, eq=False)
class TrackMeans:
    """Positions of n tracks, their mean errors and the scatter about the mean."""

    truth: Array  # (n, 3), mean true u, v, d, px
    mean: Array  # (n, 3), mean error, px
    variance: Array  # (n, 3), about the mean, px^2
    count: Array  # (n,), observations


@dataclass(frozen=True, eq=False)
class Growth:
    """Standard deviation of disparity over disparity, linear between nodes."""

    disparity: Array  # (K,), px
    sd: Array  # (K,), px
    covariance: Array  # (K, K), of ``sd``, px^2
    spread: float  # scatter of the tracks' variances, over that of Gaussian noise of one sd at a disparity

    @property
    def standard_error(self) -> Array:
        """Of ``sd``, (K,), px."""
        return np.sqrt(np.diag(self.covariance))

    def table(self, sigma: float) -> DisparityGrowth:
        """The growth as a scenario has it, over a sensor's own ``sigma`` of disparity in px."""
        ratio = (self.sd / sigma).tolist()
        return DisparityGrowth.model_validate({"disparity_px": self.disparity.tolist(), "ratio": ratio})


@dataclass(frozen=True, eq=False)
class Biases:
    """Mean errors over the image, bilinear between nodes."""

    u: Array  # (K,), px from the middle
    v: Array  # (L,), px
    bias: Array  # (L, K, 3), of u, v and d, px
    standard_error: Array  # (L, K, 3), px
    covariance: Array  # (L K, L K), of one column of ``bias`` per unit variance of a track
    rest: Array  # (3,), sd of the tracks' mean errors about the map, px: what depends on more than the place

    def table(self) -> BiasMap:
        """The map as a scenario has it."""
        matrices = {name: self.bias[..., k].tolist() for k, name in enumerate(NAMES)}
        return BiasMap.model_validate({"u_px": self.u.tolist(), "v_px": self.v.tolist(), **matrices})


def track_means(tracks: Tracks, fewest: int = FEWEST) -> TrackMeans:
    """Means and variances of tracks with at least ``fewest`` observations.

    Raises
    ------
    InputError
        No track is as long.
    """
    _, number = np.unique(tracks.track, return_inverse=True)
    count = np.bincount(number)
    long = count >= fewest
    if not long.any():
        raise InputError(f"tracks: none has {fewest} observations; track through more images")

    errors = _means(tracks.errors, number, count)
    scatter = _means((tracks.errors - errors[number]) ** 2, number, count)
    scatter *= (count / np.maximum(count - 1, 1))[:, None]
    truth = _means(tracks.truth, number, count)
    return TrackMeans(truth[long], errors[long], scatter[long], count[long])


def _means(values: Array, number: Indices, count: Indices) -> Array:
    """Means (n, 3) over tracks of values (M, 3) of the tracks ``number`` (M,)."""
    sums = np.zeros((len(count), values.shape[1]))
    np.add.at(sums, number, values)
    return sums / count[:, None]


def disparity_growth(means: TrackMeans, nodes: Array) -> Growth:
    """Noise of disparity about the means of tracks.

    A variance s^2 of n observations has itself the variance 2 sd^4 / (n - 1) if the noise is Gaussian. The curve is
    fitted to all s^2 with these weights by Fisher scoring; its covariance is multiplied by how much more the s^2
    scatter (``spread``), for noise has tails, and differs from one texture to another.

    Parameters
    ----------
    nodes : (K,), increasing, px

    Raises
    ------
    InputError
        A node has no track near it.
    """
    nodes = _increasing(nodes)
    H = hats(means.truth[:, 2], nodes)
    _require_support(H, [f"disparity {node:g} px" for node in nodes])
    s2 = means.variance[:, 2]
    dof = means.count - 1.0
    theta = np.full(len(nodes), np.sqrt(np.average(s2, weights=dof)))
    floor = 1e-3 * theta[0]
    for _ in range(ROUNDS):
        sd = H @ theta
        weight = 2.0 * dof / sd**2  # information of s^2 on sd
        step = (s2 - sd**2) / (2.0 * sd)
        information = H.T @ (weight[:, None] * H)
        theta = np.maximum(theta + np.linalg.solve(information, H.T @ (weight * step)), floor)
    sd = H @ theta
    information = H.T @ ((2.0 * dof / sd**2)[:, None] * H)
    excess = 0.5 * dof * (s2 / sd**2 - 1.0) ** 2
    spread = max(float(excess.sum() / max(len(s2) - len(nodes), 1)), 1.0)
    return Growth(nodes, theta, spread * np.linalg.inv(information), spread)


def bias_map(means: TrackMeans, u: Array, v: Array) -> Biases:
    """Mean errors of tracks as a table over the image, by least squares, each track counting once.

    Parameters
    ----------
    u, v : (K,) and (L,), nodes, increasing, px from the middle of the image

    Raises
    ------
    InputError
        A node has no track near it, or there are fewer tracks than nodes.
    """
    u = _increasing(u)
    v = _increasing(v)
    H = bilinear(means.truth[:, 0], means.truth[:, 1], u, v)
    _require_support(H, [f"u = {x:g}, v = {y:g} px" for y in v for x in u])
    inverse = np.linalg.inv(H.T @ H)
    bias = inverse @ H.T @ means.mean
    spare = len(H) - H.shape[1]
    if spare < 1:
        raise InputError(f"bias map: {len(H)} tracks for {H.shape[1]} nodes; track more features or give fewer nodes")
    rest = np.sqrt(np.square(means.mean - H @ bias).sum(axis=0) / spare)
    error = np.sqrt(np.diag(inverse))[:, None] * rest
    shape = len(v), len(u), 3
    return Biases(u, v, bias.reshape(shape), error.reshape(shape), inverse, rest)


def _increasing(nodes: Array) -> Array:
    nodes = np.asarray(nodes, float)
    if len(nodes) < 1 or (np.diff(nodes) <= 0).any():
        raise InputError(f"nodes: {nodes.tolist()} do not increase; give them in increasing order")
    return nodes


def _require_support(H: Array, names: list[str]) -> None:
    weak = np.flatnonzero(H.sum(axis=0) < 1.0)
    if len(weak):
        raise InputError(f"calibration: no track near {names[weak[0]]}; give fewer nodes or more tracks")
    if np.linalg.matrix_rank(H) < H.shape[1]:
        raise InputError("calibration: the tracks do not tell all nodes apart; give fewer nodes or more tracks")
