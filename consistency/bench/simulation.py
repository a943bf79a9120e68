"""The simulated world: paths, truth, controls and observations from a scenario and random generators.

Nothing here imports a filter.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from consistency.bench.scenario import (
    AnnularLandmarks,
    Circle,
    CircularLandmarks,
    Corridor,
    FigureOfEight,
    ListedLandmarks,
    Path_,
    RoundedRectangle,
    Scenario,
    TrueSensor,
    Truth,
    UniformLandmarks,
    UvdSensor,
    Waypoints,
    load_scenario,
    models,
)
from consistency.bench.scenario.effects import (
    Context,
    Effect,
    FieldOfView,
    ListedEffect,
    Noise,
    Observations,
    SearchRange,
)
from consistency.bench.types import Trial
from consistency.referee.errors import InputError
from consistency.referee.types import Array

MOTION_NOISE, OBSERVATION_NOISE = 0, 1  # purposes in the spawn key of the seed
SOME = 50  # steps of the planned path that are searched at a time for a landmark
Changes = dict[str, Any]  # dotted key of the scenario -> value
HALVES = ("truth", "belief")
SHAPES = ("circle", "rounded-rectangle", "figure-of-eight")


def generator(seed: int, run: int, purpose: int) -> np.random.Generator:
    """The random stream of one purpose in one run: independent of every other run and purpose."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(run, purpose)))


def purpose_of(label: str) -> int:
    """Purpose of an effect's random stream: a hash of its label, and 1 for the noise that every sensor has."""
    if label == Noise.label:
        return OBSERVATION_NOISE
    return int.from_bytes(hashlib.sha256(label.encode()).digest()[:8], "big")


def effects_of(sensor: TrueSensor) -> list[Effect]:
    """Field of view, noise, what the scenario lists, search range; a listed effect may stand before the noise."""
    early = [effect for effect in sensor.effects if effect.before_noise]
    late = [effect for effect in sensor.effects if not effect.before_noise]
    search = [SearchRange(*sensor.disparity)] if isinstance(sensor, UvdSensor) else []
    noise = Noise(sensor.sigma, sensor.disparity_growth if isinstance(sensor, UvdSensor) else None)
    return [FieldOfView(), *early, noise, *late, *search]


class EffectChain:
    """Effects applied one after the other, each with the purpose of its random stream, None if it draws nothing.

    What the first effects do is the same in every run if it depends on the path alone and the path is the same:
    :meth:`shared` works it out once.
    """

    def __init__(self, effects: Sequence[Effect]) -> None:
        self._links = [(effect, purpose_of(effect.label) if effect.draws else None) for effect in effects]

    def leading(self) -> int:
        """How many effects come before the first that draws random numbers."""
        return next((i for i, (_, purpose) in enumerate(self._links) if purpose is not None), len(self._links))

    def shared(self, context: Context, number: int) -> Observations:
        """The ideal observations after the first ``number`` effects, which draw no random numbers."""
        return _after(self._links[:number], context.ideal(), context, 0, 0)

    def rest(self, observations: Observations, context: Context, number: int, run: int, seed: int) -> Observations:
        """``observations`` after all effects but the first ``number``, in one run."""
        return _after(self._links[number:], observations, context, run, seed)


def _after(
    links: list[tuple[Effect, int | None]], observations: Observations, context: Context, run: int, seed: int
) -> Observations:
    for effect, purpose in links:
        rng = generator(seed, run, purpose) if purpose is not None else _NoNumbers(effect.label)
        observations = effect.apply(observations, cast(np.random.Generator, rng), context)
        if isinstance(effect, ListedEffect):
            _require_sound(effect.label, observations, context)
    return observations


class _NoNumbers:
    """In the place of a generator for an effect that says it draws nothing."""

    def __init__(self, label: str) -> None:
        self._label = label

    def __getattr__(self, name: str) -> Any:
        raise TypeError(f"the effect '{self._label}' says draws = False and asks for random numbers")


def _require_sound(label: str, observations: Observations, context: Context) -> None:
    """Refuse what a filter cannot be given: a mistake in the effect, not in the scenario."""
    step, z = observations.step, observations.z
    shape = len(step), context.sensor.size
    if z.shape != shape or not np.isfinite(z).all():
        raise ValueError(f"the effect '{label}' must give finite values of shape {shape}")
    if len(step) and (step[0] < 1 or step[-1] > context.steps):
        raise ValueError(f"the effect '{label}' must give steps from 1 to {context.steps}")
    if (np.diff(step * observations.ids + observations.landmark) <= 0).any():
        raise ValueError(f"the effect '{label}' must give each landmark once in a step, in order of step and landmark")
    if context.linear and observations.ids > len(context.landmarks):
        raise InputError(
            f"the effect '{label}' (truth.sensor.effects) observes things that are not landmarks, and a linear sensor "
            "has nothing to be linearised about for them; use the model 'xyz' or 'uvd'"
        )


class World:
    """What all trials of a scenario share, worked out once; any number of threads may ask it for trials."""

    def __init__(self, truth: Truth) -> None:
        self.truth = truth
        self.landmarks = draw_landmarks(truth)
        self.start = start_pose(truth)
        self.planned = planned_controls(truth)
        self.reference = models.dead_reckoning(self.start, self.planned)
        self.linear = truth.sensor.model == "linear"
        # noise on the odometry leaves the path as planned, and a linear world looks from it
        self.undisturbed = not self.linear and truth.motion.noise_on != "motion"
        self._chain = EffectChain(effects_of(truth.sensor))
        self._number = 0
        if self.linear:
            self._number = 1
        elif self.undisturbed:
            self._number = self._chain.leading()
        self._shared = self._chain.shared(self.context(self.reference), self._number) if self._number else None
        if self._shared is not None and self.undisturbed:
            _ = self._shared.z  # now, and not in several threads at once
        self._ends = np.arange(1, truth.steps + 2)

    def context(self, path: Array) -> Context:
        """What an effect may know of a trial along ``path`` (T + 1, 3)."""
        return Context(self.truth.sensor, self.landmarks, path, self.reference)

    def trial(self, run: int, seed: int) -> Trial:
        """Truth, controls and observations of run ``run``, as :func:`simulate`."""
        true_path, controls = self._drive(generator(seed, run, MOTION_NOISE))
        context = self.context(true_path)
        begun = self._shared
        if begun is None:
            begun = context.ideal()
        elif self.linear:
            begun = context.at(begun.step, begun.landmark)
        observations = self._chain.rest(begun, context, self._number, run, seed)
        first = np.searchsorted(observations.step, self._ends)
        return Trial(
            run,
            self.start,
            controls,
            first,
            observations.landmark,
            observations.z,
            observations.ids,
            true_path,
            self.landmarks,
            None if np.array_equal(observations.sources, observations.landmark) else observations.source,
            seed=seed,
        )

    def _drive(self, rng: np.random.Generator) -> tuple[Array, Array]:
        """True poses (T + 1, 3) and the controls (T, 3) that the filter is told."""
        truth, planned = self.truth, self.planned
        noise = np.zeros_like(planned)
        noise[:, 1:] = rng.standard_normal((truth.steps, 2)) * [truth.motion.sigma_v, truth.motion.sigma_omega]
        if self.linear:
            return _drive_linear(self.reference, planned, noise), planned
        if self.undisturbed:
            return self.reference, planned - noise
        return models.dead_reckoning(self.start, planned + noise), planned


def simulate(scenario: Scenario | str | Path, run: int = 0, seed: int = 0) -> Trial:
    """Truth, controls and observations of run ``run`` of a scenario, which may be given by its name or file.

    Returns
    -------
    Trial
        Observations are ordered by step, then by landmark.
    """
    return World(load_scenario(scenario).truth).trial(run, seed)


def draw_landmarks(truth: Truth) -> Array:
    """True landmark positions of the scenario's world in m, shape (N, 3); the same in every run."""
    layout = truth.landmarks
    if isinstance(layout, ListedLandmarks):
        return np.array(layout.points)
    if isinstance(layout, CircularLandmarks):
        angle = 2.0 * np.pi * np.arange(layout.count) / layout.count
        return _around(layout.centre, np.full(layout.count, layout.radius), angle)
    if isinstance(layout, AnnularLandmarks):
        rng, (near, far) = np.random.default_rng(layout.seed), np.array(layout.rings).T
        radius = rng.uniform(near, far, size=(layout.count, len(near))).T.ravel()
        return _around(layout.centre, radius, rng.uniform(0.0, 2.0 * np.pi, size=len(radius)))
    low, high = np.array([layout.x, layout.y, layout.z]).T
    return np.random.default_rng(layout.seed).uniform(low, high, size=(layout.count, 3))


def _around(centre: tuple[float, float], radius: Array, angle: Array) -> Array:
    """Points (N, 3) at height 0 at some distances (N,) in some directions (N,) from a centre."""
    points = centre + radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.column_stack([points, np.zeros(len(points))])


def require_landmarks_in_view(scenario: Scenario) -> World:
    """The scenario's world; raises :class:`InputError` if no landmark comes into view on the planned path."""
    truth, sensor = scenario.truth, scenario.truth.sensor
    world = World(truth)
    for k in range(0, truth.steps, SOME):
        here = slice(k, k + SOME + 1)
        context = Context(sensor, world.landmarks, world.reference[here], world.reference[here])
        observations = EffectChain([FieldOfView()]).shared(context, 1)
        # effects that are listed may bring any disparity into the search range
        if isinstance(sensor, UvdSensor) and not sensor.effects:
            low, high = sensor.disparity
            slack = 6.0 * sensor.sigma[2]
            observations = observations.keep(
                (observations.z[:, 2] > low - slack) & (observations.z[:, 2] < high + slack)
            )
        if len(observations):
            return world
    raise InputError(
        f"scenario '{scenario.name}': no landmark comes into view in {truth.steps} steps; "
        "check truth.sensor (range, image, f, disparity, mount), truth.landmarks and truth.path"
    )


def _drive_linear(reference: Array, planned: Array, noise: Array) -> Array:
    """Eq. 18 to first order about the reference: error <- F error + G noise, exactly linear."""
    heading, (dt, v, _), (_, v_noise, omega_noise) = reference[:-1, 2], planned.T, noise.T
    turned = np.cumsum(dt * omega_noise)
    pose_before = np.concatenate([[0.0], turned[:-1]])
    along = dt * v_noise
    path = reference.copy()
    for axis, slope, share in zip(
        (0, 1), models.unicycle_jacobian(heading, dt, v), (np.cos(heading), np.sin(heading)), strict=True
    ):
        path[1:, axis] += np.cumsum(np.column_stack([slope * pose_before, along * share]))[1::2]
    path[1:, 2] += turned
    return path


class Piece(NamedTuple):
    """A part of a path that is driven with constant velocities."""

    duration: float  # s
    v: float  # m/s
    omega: float  # rad/s


def planned_controls(truth: Truth) -> Array:
    """Velocities along the scenario's path, shape (steps, 3): dt (s), v (m/s), omega (rad/s).

    A step holds the mean of v and omega over it, so that every turn is made in full.
    """
    duration, v, omega = np.array(_pieces(truth.path)).T
    ends = np.concatenate([[0.0], np.cumsum(duration)])
    travelled = np.concatenate([[0.0], np.cumsum(duration * v)])
    turned = np.concatenate([[0.0], np.cumsum(duration * omega)])
    time = truth.dt * np.arange(truth.steps + 1)
    laps, phase = np.divmod(time, ends[-1])
    distance = laps * travelled[-1] + np.interp(phase, ends, travelled)
    angle = laps * turned[-1] + np.interp(phase, ends, turned)
    dt = np.full(truth.steps, truth.dt)
    return np.column_stack([dt, np.diff(distance) / truth.dt, np.diff(angle) / truth.dt])


def start_pose(truth: Truth) -> Array:
    """Pose at step 0, shape (3,)."""
    return np.array([*truth.path.start, truth.path.heading])


def planned_path(truth: Truth) -> Array:
    """Poses 0..steps of the path without any noise, shape (steps + 1, 3)."""
    return models.dead_reckoning(start_pose(truth), planned_controls(truth))


def lap_length(path: Path_) -> float:
    """Length in m of the path until it is back at its start; turns on the spot have none."""
    return sum(piece.duration * piece.v for piece in _pieces(path))


def _pieces(path: Path_) -> list[Piece]:
    """One cycle of the path, all counter-clockwise."""
    v = path.speed
    match path:
        case Circle():
            return [_arc(v, path.radius, 2 * np.pi)]
        case FigureOfEight():
            return [_arc(v, path.radius, 2 * np.pi), _arc(v, path.radius, -2 * np.pi)]
        case RoundedRectangle():
            corner = _arc(v, path.corner_radius, np.pi / 2)
            long = (path.length - 2 * path.corner_radius) / v
            wide = (path.width - 2 * path.corner_radius) / v
            half = [Piece(long / 2, v, 0.0), corner, Piece(wide, v, 0.0), corner, Piece(long / 2, v, 0.0)]
            return [piece for piece in half * 2 if piece.duration > 0]
        case Corridor():
            straight, turn = Piece(path.length / v, v, 0.0), _arc(v, path.turn_radius, np.pi)
            return [straight, turn, straight, turn]
        case Waypoints():
            return _legs(path)


def _arc(v: float, radius: float, angle: float) -> Piece:
    duration = abs(angle) * radius / v
    return Piece(duration, v, angle / duration)


def _legs(path: Waypoints) -> list[Piece]:
    """Turn on the spot towards each point, drive there; at the end back to the start and its heading."""
    pieces: list[Piece] = []
    position, heading = np.array(path.start), path.heading

    def turn_to(target: float) -> None:
        angle = (target - heading + np.pi) % (2 * np.pi) - np.pi
        if abs(angle) > 1e-12:
            pieces.append(Piece(abs(angle) / path.turn_rate, 0.0, np.sign(angle) * path.turn_rate))

    for point in [*path.points, path.start]:
        dx, dy = np.array(point) - position
        length = float(np.hypot(dx, dy))
        if length == 0.0:
            continue
        target = float(np.arctan2(dy, dx))
        turn_to(target)
        pieces.append(Piece(length / path.speed, path.speed, 0.0))
        position, heading = np.array(point), target
    turn_to(path.heading)
    return pieces


class Course(NamedTuple):
    """A path, and the box of landmarks about it."""

    path: Path_
    x: tuple[float, float]  # m
    y: tuple[float, float]  # m
    landmarks: float  # number of them that are as dense as before


def course_of(truth: Truth, shape: str, lap: float = 1.0) -> Course:
    """A path of one of :data:`SHAPES` about the same centre, its lap ``lap`` times as long.

    Raises
    ------
    ValueError
        The landmarks are not spread evenly over a box, or there is no such shape.
    """
    landmarks = truth.landmarks
    if not isinstance(landmarks, UniformLandmarks):
        raise ValueError("needs truth.landmarks.layout = 'uniform', whose box follows the path")
    if shape not in SHAPES:
        raise ValueError(f"a path of shape '{shape}' has no laps; use {', '.join(SHAPES)}")
    path, box = _path(shape, truth, lap), np.array([landmarks.x, landmarks.y])
    margin = box - _extent(truth)
    x, y = np.round(_extent(truth.model_copy(update={"path": path})) + margin.mean(axis=0), 1).tolist()
    area = float((x[1] - x[0]) * (y[1] - y[0]) / np.prod(box[:, 1] - box[:, 0]))
    return Course(path, (x[0], x[1]), (y[0], y[1]), landmarks.count * area)


def in_both(key: str, value: Any) -> Changes:
    """A key of truth and belief alike."""
    return {f"{half}.{key}": value for half in HALVES}


def baseline_changes(base: Scenario, baseline: float) -> Changes:
    """Another baseline (m); the largest disparity of the search grows with it, so that the nearest depth stays."""
    if base.truth.sensor.rig is None:
        raise ValueError(f"a sensor '{base.truth.sensor.model}' has no baseline")
    ratio = baseline / base.truth.sensor.rig[1]
    changes = in_both("sensor.B", baseline)
    for half in HALVES:
        disparity = getattr(getattr(base, half).sensor, "disparity", None)
        if disparity is not None:
            changes[f"{half}.sensor.disparity"] = (disparity[0], disparity[1] * ratio)
    return changes


def odometry_changes(base: Scenario, factor: float) -> Changes:
    """Noise of the odometry times a factor."""
    changes: Changes = {}
    for half in HALVES:
        motion = getattr(base, half).motion
        changes[f"{half}.motion.sigma_v"] = factor * motion.sigma_v
        changes[f"{half}.motion.sigma_omega"] = factor * motion.sigma_omega
    return changes


def range_changes(base: Scenario, far: float) -> Changes:
    """The longest range of the sensor, m."""
    return {"truth.sensor.range": (base.truth.sensor.range[0], far)}


def tilt_changes(base: Scenario, tilt: float) -> Changes:
    """A camera turned to a tilt (deg, positive looks down)."""
    roll, _, heading = _stereo_camera(base).mount.rotation
    return in_both("sensor.mount.rotation", (roll, float(np.deg2rad(tilt)), heading))


def height_changes(base: Scenario, height: float) -> Changes:
    """A camera moved to a height (m)."""
    x, y, _ = _stereo_camera(base).mount.position
    return in_both("sensor.mount.position", (x, y, height))


def _stereo_camera(base: Scenario) -> UvdSensor:
    sensor = base.truth.sensor
    if not isinstance(sensor, UvdSensor):
        raise ValueError(f"a sensor '{sensor.model}' has no tilt or height")
    return sensor


def _path(shape: str, truth: Truth, lap: float) -> Path_:
    """A path of another shape about the centre of the base, ``lap`` times as long, with sides of 8 to 5."""
    length, (x, y) = lap * lap_length(truth.path), np.round(_extent(truth).mean(axis=1), 1)
    speed = truth.path.speed
    if shape == "circle":
        radius = round(length / (2 * np.pi), 2)
        return Circle(shape="circle", radius=radius, start=(x + radius, y), heading=np.pi / 2, speed=speed)
    if shape == "figure-of-eight":
        radius = round(length / (4 * np.pi), 2)
        return FigureOfEight(shape="figure-of-eight", radius=radius, start=(x, y), heading=0.0, speed=speed)
    corner = round(length / 25, 2)
    long, wide = (round((length + (8 - 2 * np.pi) * corner) * side / 26, 2) for side in (8, 5))
    return RoundedRectangle(
        shape="rounded-rectangle", length=long, width=wide, corner_radius=corner, start=(x, y - wide / 2), heading=0.0,
        speed=speed,
    )  # fmt: skip


def _extent(truth: Truth) -> Array:
    """Smallest and largest x and y of one lap of the path, (2, 2)."""
    steps = int(np.ceil(lap_length(truth.path) / truth.path.speed / truth.dt))
    path = planned_path(truth.model_copy(update={"steps": steps}))
    return np.column_stack([path[:, :2].min(axis=0), path[:, :2].max(axis=0)])
