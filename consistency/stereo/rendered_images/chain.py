"""The chain of Herath et al. (2007) fig. 3: stages in a row, from image pairs to tracks of u, v, d beside the truth."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.types import Array, Indices
from consistency.stereo.rendered_images.camera import StereoCamera
from consistency.stereo.rendered_images.render import StereoFrame
from consistency.stereo.rendered_images.scene import Scene, to_camera
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


def stage(role: str, name: str, **settings: Any) -> Any:
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
            stage("selection", selection, **given.get("selection", {})),
            stage("tracking", tracking, **given.get("tracking", {})),
            stage("correspondence", correspondence, **given.get("correspondence", {})),
            tuple(stage("filter", name, **given.get(name, {})) for name in filters),
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
                _follow(self, state, frame, camera)
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


def _follow(
    chain: Chain,
    state: _State,
    frame: StereoFrame,
    camera: StereoCamera,
) -> None:
    true = camera.left.project(to_camera(frame.pose, state.anchors))
    state.uv, found = chain.tracking.follow(state.image, frame.left, state.uv, true)
    state.image = frame.left
    state.keep(found & camera.inside(state.uv, EDGE))


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
