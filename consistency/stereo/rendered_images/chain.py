"""From image pairs to tracks of u, v, d beside the truth: the chain of stages of Herath et al. (2007) fig. 3.

Its errors become the tables of a sensor. The stops of a robot before walls are experiment 2 of the chapter.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from consistency.bench.scenario.observations import BiasMap, DisparityGrowth, bilinear, hats
from consistency.referee.errors import InputError
from consistency.referee.types import Array, Indices
from consistency.stereo.rendered_images.scene import (
    Blobs,
    Layer,
    Painted,
    RandomTexture,
    Scene,
    StereoCamera,
    StereoFrame,
    Texture,
    film,
    to_camera,
)
from consistency.stereo.rendered_images.stages import (
    BlockMatching,
    Correspondence,
    FeatureSelection,
    GoodFeatures,
    Klt,
    KltAcross,
    KnownDisparity,
    KnownProjection,
    LeftRightCheck,
    ObservationFilter,
    PairObservations,
    SemiGlobal,
    Spread,
    Tracking,
    TrackResidual,
    dissimilarity,
    patches,
    square,
)

# flags of an observation
KEPT = 0
NO_DISPARITY = 1
REJECTED = 2
# labels of an observation, which only the truth tells
POINT = 0
JUNCTION = 1
MISMATCH = 2
DRIFTED = 3
GROSS = 2.0  # px from where it should be: a mismatch in d, a drift in u or v
WINDOW = 13.0  # px, about a feature; a junction has two depths in it
SHARE = 0.1  # of the window that each of the two depths has
STEP = 1.0  # px between the two depths
EDGE = 3.0  # px from the border at which a track ends
STAGES: dict[str, dict[str, type[Any]]] = {
    "selection": {"shi-tomasi": GoodFeatures, "spread": Spread},
    "tracking": {"klt": Klt, "none": KnownProjection},
    "correspondence": {
        "block-matching": BlockMatching,
        "semi-global": SemiGlobal,
        "klt": KltAcross,
        "none": KnownDisparity,
    },
    "filter": {"left-right": LeftRightCheck, "residual": TrackResidual},
}
ROUNDS = 30  # of the fit of the growth, which settles in a few
FEWEST = 3  # observations of a track
NAMES = ("bias_u_px", "bias_v_px", "bias_d_px")
FINEST, OCTAVES, CONTRAST = 0.1, 4, 12.0  # m, number, grey values: a wall without fine detail


def stage(role: str, name: str, settings: Mapping[str, Any]) -> Any:
    """A stage by its role and name.

    Raises
    ------
    InputError
        There is no such role, stage or setting.
    """
    if role not in STAGES:
        raise InputError(f"chain: no role '{role}'; known: {', '.join(STAGES)}")
    if name not in STAGES[role]:
        raise InputError(f"chain: no {role} '{name}'; known: {', '.join(STAGES[role])}")
    kind = STAGES[role][name]
    known = [each.name for each in fields(kind)]
    if unknown := sorted(set(settings) - set(known)):
        raise InputError(f"chain: {role} '{name}' has no setting '{unknown[0]}'; known: {', '.join(known) or 'none'}")
    return kind(**settings)


@dataclass(frozen=True, eq=False)
class Tracks:
    """M observations of tracked features, frame by frame.

    ``truth`` is what ideal cameras would measure of the feature's point from the nominal pose, ``real`` what the
    cameras as they are would measure from where they were, if nothing but the stages erred.
    """

    sequence: Indices  # (M,), 0 unless several were joined
    frame: Indices  # (M,), 0 is the frame of selection
    track: Indices  # (M,)
    z: Array  # (M, 3): u, v, d in px; d is NaN where there is none
    truth: Array  # (M, 3), px
    real: Array  # (M, 3), px
    dissimilarity: Array  # (M,)
    label: Indices  # (M,): POINT, JUNCTION, MISMATCH or DRIFTED
    flag: Indices  # (M,): KEPT, NO_DISPARITY or REJECTED

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def errors(self) -> Array:
        """Measured minus true, (M, 3) px."""
        return self.z - self.truth

    def take(self, chosen: Array) -> Tracks:
        """The observations for which ``chosen`` (M,) is true."""
        return Tracks(*(values[chosen] for values in vars(self).values()))

    @property
    def kept(self) -> Tracks:
        """Those that have a disparity and that no filter rejects."""
        return self.take(self.flag == KEPT)


def join_tracks(parts: Sequence[Tracks]) -> Tracks:
    """Tracks of several sequences: each has a number of its own, and so has every track of all of them."""
    numbered = []
    tracks = 0
    for k, part in enumerate(parts):
        sequence = np.full(len(part), k)
        numbered.append(replace(part, sequence=sequence, track=part.track + tracks))
        tracks += int(part.track.max(initial=-1)) + 1
    return _concatenated(numbered)


def _concatenated(parts: Sequence[Tracks]) -> Tracks:
    columns = zip(*(vars(part).values() for part in parts), strict=True)
    return Tracks(*map(np.concatenate, columns))


@dataclass(frozen=True)
class Chain:
    """Selection, tracking, stereo correspondence and filters, each of which can be swapped.

    With ``stereo_first`` only features begin a track that have a disparity in the first pair: sec. 4.2 asks for
    features that are good as observations in three dimensions.
    """

    selection: FeatureSelection = field(default_factory=Spread)
    tracking: Tracking = field(default_factory=Klt)
    correspondence: Correspondence = field(default_factory=BlockMatching)
    filters: tuple[ObservationFilter, ...] = ()
    stereo_first: bool = True

    @classmethod
    def of(
        cls,
        selection: str = "spread",
        tracking: str = "klt",
        correspondence: str = "block-matching",
        filters: Sequence[str] = (),
        settings: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> Chain:
        """A chain of named stages (:data:`STAGES`), with ``settings`` by role, or by name for filters."""
        given = settings or {}
        return cls(
            stage("selection", selection, given.get("selection", {})),
            stage("tracking", tracking, given.get("tracking", {})),
            stage("correspondence", correspondence, given.get("correspondence", {})),
            tuple(stage("filter", name, given.get(name, {})) for name in filters),
        )

    def run(
        self,
        frames: Iterable[StereoFrame],
        scene: Scene,
        camera: StereoCamera,
    ) -> Tracks:
        """Tracks of the features of the first frame through all frames.

        Raises
        ------
        InputError
            The search range misses every depth of the scene, or an image is smaller than a stage's window.
        """
        state = None
        parts = []
        for number, frame in enumerate(frames):
            if state is None:
                self._require_depths(scene, camera, frame.pose)
                state = _begin(self, frame, scene, camera)
            else:
                true = camera.left.project(to_camera(frame.pose, state.anchors))
                state.uv, found = self.tracking.follow(state.image, frame.left, state.uv, true)
                state.image = frame.left
                state.keep(found & camera.inside(state.uv, EDGE))
            parts.append(_observed(self, state, number, frame, camera))
        if state is None:
            raise InputError("frames: there is none; give at least one image pair")
        return _concatenated(parts)

    def _require_depths(
        self,
        scene: Scene,
        camera: StereoCamera,
        pose: Array,
    ) -> None:
        rays = camera.left.field[::8, ::8].reshape(-1, 3)
        points, layer = scene.seen(pose, rays)
        d = camera.ideal(to_camera(pose, points[layer >= 0]))[:, 2]
        low, high = self.correspondence.search
        if not ((d >= low) & (d <= high)).any():
            seen = "is not in the image"
            if len(d):
                seen = f"has disparities from {d.min():.1f} to {d.max():.1f} px"
            raise InputError(f"search: {low} to {high} px misses every depth of the scene, which {seen}; widen it")


@dataclass
class _State:
    """The tracks while a chain runs, N of them."""

    image: Array  # the last left image
    uv: Array  # (N, 2)
    track: Indices  # (N,)
    anchors: Array  # (N, 3), points in the world
    junction: Array  # (N,), bool
    patch: Array  # (N, p), of the frame of selection
    d: Array  # (N,), disparity at selection

    def keep(self, chosen: Array) -> None:
        self.uv = self.uv[chosen]
        self.track = self.track[chosen]
        self.anchors = self.anchors[chosen]
        self.junction = self.junction[chosen]
        self.patch = self.patch[chosen]
        self.d = self.d[chosen]


def _begin(
    chain: Chain,
    frame: StereoFrame,
    scene: Scene,
    camera: StereoCamera,
) -> _State:
    uv = chain.selection.choose(frame.left)
    anchors, layer = scene.seen(frame.pose, camera.left.rays(uv))
    d = _disparities(chain, frame, uv, camera.real(to_camera(frame.pose, anchors)))
    good = layer >= 0
    if chain.stereo_first:
        good &= np.isfinite(d)
    uv = uv[good]
    return _State(
        frame.left,
        uv,
        track=np.arange(len(uv)),
        anchors=anchors[good],
        junction=at_junction(scene, camera, frame.pose, uv),
        patch=patches(frame.left, uv, np.ones(len(uv))),
        d=d[good],
    )


def _observed(
    chain: Chain,
    state: _State,
    number: int,
    frame: StereoFrame,
    camera: StereoCamera,
) -> Tracks:
    real = camera.real(to_camera(frame.pose, state.anchors))
    d = _disparities(chain, frame, state.uv, real)
    zoom = np.where(np.isfinite(d * state.d), d / state.d, 1.0)
    unlike = dissimilarity(state.patch, patches(frame.left, state.uv, zoom))
    evidence = PairObservations(frame.left, frame.right, state.uv, d, unlike, chain.correspondence)
    flag = np.full(len(d), KEPT)
    flag[~np.isfinite(d)] = NO_DISPARITY
    for check in chain.filters:
        flag[(flag == KEPT) & ~check.keep(evidence)] = REJECTED
    z = np.column_stack([state.uv, d])
    off = np.abs(z - real)
    label = np.full(len(d), POINT)
    label[off[:, 2] > GROSS] = MISMATCH
    label[(off[:, :2] > GROSS).any(axis=1)] = DRIFTED
    label[state.junction] = JUNCTION
    return Tracks(
        sequence=np.zeros(len(d), np.int64),
        frame=np.full(len(d), number),
        track=state.track,
        z=z,
        truth=camera.ideal(to_camera(frame.nominal, state.anchors)),
        real=real,
        dissimilarity=unlike,
        label=label,
        flag=flag,
    )


def _disparities(
    chain: Chain,
    frame: StereoFrame,
    uv: Array,
    real: Array,
) -> Array:
    if isinstance(chain.correspondence, KnownDisparity):
        return real[:, 2]
    return chain.correspondence.measure(frame.left, frame.right, uv)


def at_junction(
    scene: Scene,
    camera: StereoCamera,
    pose: Array,
    uv: Array,
) -> Array:
    """Whether the window of a feature (N, 2) px shows two depths, so that it is on the edge of a layer, (N,) bool."""
    grid = square(np.linspace(-WINDOW / 2.0, WINDOW / 2.0, 7))
    rays = camera.left.rays(uv[:, None] + grid)
    points, layer = scene.seen(pose, rays.reshape(-1, 3))
    depth = to_camera(pose, points)[:, 0]
    d = np.where(layer >= 0, camera.f * camera.B / depth, 0.0).reshape(len(uv), -1)
    d.sort(axis=1)
    few = int(np.ceil(SHARE * d.shape[1]))
    return d[:, -few] - d[:, few - 1] > STEP


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


@dataclass(frozen=True)
class Stops:
    """Experiment 2: the robot stands before a wall, at one distance after the other.

    At each stop features are selected in one image and tracked through ``images`` more.
    """

    farthest: float = 6.0  # m
    nearest: float = 1.0
    step: float = 0.05
    images: int = 29
    noise: float = 3.0  # sd of a grey value

    @property
    def distances(self) -> Array:
        """Of all stops, (S,), m, the farthest first."""
        count = round((self.farthest - self.nearest) / self.step) + 1
        return np.linspace(self.farthest, self.nearest, count)


def wall_texture(rng: np.random.Generator) -> Texture:
    """Artificial features on a wall that has no fine detail of its own."""
    return Painted(RandomTexture.draw(rng, FINEST, OCTAVES, CONTRAST), Blobs.draw(rng))


def pose_at(x: float) -> Array:
    """Pose (6,) on the world's x axis, looking along it."""
    return np.array([x, 0.0, 0.0, 0.0, 0.0, 0.0])


def stand(
    chain: Chain,
    camera: StereoCamera,
    stops: Stops,
    rng: np.random.Generator,
    workers: int = 1,
    slant: float = 0.0,
) -> Tracks:
    """Experiment 2 with a new wall at each stop; the sequence of an observation is the number of its stop.

    The result does not depend on ``workers``, the number of threads.
    """

    def one(distance: float, own: np.random.Generator) -> Tracks:
        scene = Scene((Layer.facing(distance, wall_texture(own), slant=slant),))
        poses = np.tile(pose_at(0.0), (stops.images + 1, 1))
        return chain.run(film(scene, camera, poses, own, stops.noise), scene, camera)

    with ThreadPoolExecutor(workers) as threads:
        parts = list(threads.map(one, stops.distances, rng.spawn(len(stops.distances))))
    return join_tracks(parts)
