"""The chain of Herath et al. (2007) fig. 3: stages in a row, from image pairs to tracks of u, v, d beside the truth."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
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
)

KEPT, NO_DISPARITY, REJECTED = 0, 1, 2  # flags of an observation
POINT, JUNCTION, MISMATCH, DRIFTED = 0, 1, 2, 3  # labels of an observation, which only the truth tells
GROSS = 2.0  # px from where it should be: a mismatch in d, a drift in u or v
WINDOW, SHARE, STEP = 13.0, 0.1, 1.0  # px; a junction has this share of two depths in its window, STEP px apart
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
        return Tracks(*(getattr(self, each.name)[chosen] for each in fields(self)))

    @property
    def kept(self) -> Tracks:
        """Those that have a disparity and that no filter rejects."""
        return self.take(self.flag == KEPT)


def join_tracks(parts: Sequence[Tracks]) -> Tracks:
    """Tracks of several sequences: each has a number of its own, and so has every track of all of them."""
    sequence = np.concatenate([np.full(len(part), k) for k, part in enumerate(parts)])
    shift = np.cumsum([0] + [int(part.track.max(initial=-1)) + 1 for part in parts])
    track = np.concatenate([part.track + start for part, start in zip(parts, shift, strict=False)])
    rest = {
        each.name: np.concatenate([getattr(part, each.name) for part in parts])
        for each in fields(Tracks)
        if each.name not in ("sequence", "track")
    }
    return Tracks(sequence=sequence, track=track, **rest)


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
        stages = {"selection": selection, "tracking": tracking, "correspondence": correspondence}
        made = {role: stage(role, name, **given.get(role, {})) for role, name in stages.items()}
        return cls(**made, filters=tuple(stage("filter", name, **given.get(name, {})) for name in filters))

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
        return Tracks(*(np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(Tracks)))

    def _require_depths(
        self,
        scene: Scene,
        camera: StereoCamera,
        pose: Array,
    ) -> None:
        points, layer = scene.seen(pose, camera.left.field[::8, ::8].reshape(-1, 3))
        d = camera.ideal(to_camera(pose, points[layer >= 0]))[:, 2]
        low, high = self.correspondence.search
        if not ((d >= low) & (d <= high)).any():
            seen = f"has disparities from {d.min():.1f} to {d.max():.1f} px" if len(d) else "is not in the image"
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
        for name in ("uv", "track", "anchors", "junction", "patch", "d"):
            setattr(self, name, getattr(self, name)[chosen])


def _begin(
    chain: Chain,
    frame: StereoFrame,
    scene: Scene,
    camera: StereoCamera,
) -> _State:
    uv = chain.selection.choose(frame.left)
    anchors, layer = scene.seen(frame.pose, camera.left.rays(uv))
    d = _disparities(chain, frame, uv, camera.real(to_camera(frame.pose, anchors)))
    good = (layer >= 0) & (np.isfinite(d) if chain.stereo_first else True)
    uv = uv[good]
    anchors = anchors[good]
    d = d[good]
    patch = patches(frame.left, uv, np.ones(len(uv)))
    return _State(frame.left, uv, np.arange(len(uv)), anchors, at_junction(scene, camera, frame.pose, uv), patch, d)


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
    now = patches(frame.left, state.uv, np.where(np.isfinite(d * state.d), d / state.d, 1.0))
    unlike = dissimilarity(state.patch, now)
    evidence = PairObservations(frame.left, frame.right, state.uv, d, unlike, chain.correspondence)
    flag = np.where(np.isfinite(d), KEPT, NO_DISPARITY)
    for check in chain.filters:
        flag = np.where((flag == KEPT) & ~check.keep(evidence), REJECTED, flag)
    z = np.column_stack([state.uv, d])
    off = np.abs(z - real)
    label = np.where(off[:, 2] > GROSS, MISMATCH, POINT)
    label = np.where((off[:, :2] > GROSS).any(axis=1), DRIFTED, label)
    label = np.where(state.junction, JUNCTION, label)
    truth = camera.ideal(to_camera(frame.nominal, state.anchors))
    same = np.zeros(len(d), np.int64)
    return Tracks(same, same + number, state.track, z, truth, real, unlike, label, flag)


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
    reach = np.linspace(-WINDOW / 2.0, WINDOW / 2.0, 7)
    grid = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(1, -1, 2)
    rays = camera.left.rays(uv[:, None] + grid)
    points, layer = scene.seen(pose, rays.reshape(-1, 3))
    d = np.where(layer >= 0, camera.f * camera.B / to_camera(pose, points)[:, 0], 0.0).reshape(len(uv), -1)
    d.sort(axis=1)
    few = int(np.ceil(SHARE * d.shape[1]))
    return d[:, -few] - d[:, few - 1] > STEP
