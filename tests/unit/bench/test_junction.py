"""Occlusion junctions: where they are seen, and that they are on the two edges and on no rigid point."""

import numpy as np
import pytest

import consistency as cs
from consistency.bench.scenario.effects import Context, Crossings
from consistency.bench.simulation import World
from consistency.referee.geometry import rotation

EFFECT = {"kind": "junction", "count": 12, "seed": 5, "behind_m": [1.0, 3.0], "edge_m": 2.0, "far_share": 0.5}
STEPS = 250


def world_of(**changes):
    scenario = cs.load_scenario("herath2007-stereo").variant(
        "with", truth__steps=STEPS, truth__sensor__effects=[EFFECT], **changes
    )
    world = World(scenario.truth)
    return world, scenario.truth.sensor.effects[0], world.context(world.reference)


def seen_from(pose, edges, j, sensor):
    """(u, v, d) of one crossing from one pose, and the point in the world that has that disparity; None where unseen.

    The plane of the camera and the far edge cuts the near one: a linear system for each.
    """
    mount, c, s = sensor.mount, np.cos(pose[2]), np.sin(pose[2])
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    camera = R @ np.array(mount.position) + [pose[0], pose[1], 0.0]
    axes = R @ rotation(*mount.rotation)
    far, along = edges.far[j], np.array([*edges.along[j], 0.0])
    normal = np.cross(far - camera, along)
    near = edges.near[j] - [0.0, 0.0, (normal @ (edges.near[j] - camera)) / normal[2]]
    # camera + r (near - camera) = far + s along
    (r, place), *_ = np.linalg.lstsq(np.column_stack([near - camera, -along]), far - camera, rcond=None)
    x, y, z = axes.T @ (near - camera)
    f, B = sensor.rig
    if x <= 0.0 or r <= 1.0 or abs(place) > 1.0 or abs(near[2] - edges.near[j][2]) > 1.0:
        return None
    u, v, d = -f * y / x, -f * z / x, f * B / x
    distance = np.linalg.norm(near - camera)
    if not (-160 <= u < 160 and -120 <= v < 120 and sensor.range[0] <= distance <= sensor.range[1]):
        return None
    at_far = bool(edges.by_far[j])
    return np.array([u, v, d / r if at_far else d]), camera + r * (near - camera) if at_far else near


@pytest.mark.parametrize("tilt", [False, True])
def test_a_crossing_is_where_a_ray_meets_both_edges(tilted, tilt):
    world, effect, context = world_of(**({"truth__sensor__mount": tilted} if tilt else {}))
    edges, sensor = effect.drawn(context), context.sensor
    observed = effect.apply(context.at(np.zeros(0, int), np.zeros(0, int)), np.random.default_rng(0), context)
    table = {(k, label - 120): z for k, label, z in zip(observed.step, observed.landmark, observed.z, strict=True)}
    points = {}
    for k in range(1, STEPS + 1):
        for j in range(12):
            expected = seen_from(world.reference[k], edges, j, sensor)
            assert (expected is not None) == ((k, j) in table), (k, j)
            if expected is not None:
                assert np.allclose(table[k, j], expected[0], rtol=0, atol=1e-8)
                points.setdefault(j, []).append(expected[1])
    assert len(points) == 12  # each can be seen from a step of the path
    assert 0 < edges.by_far.sum() < 12
    slides = [np.linalg.norm(np.ptp(seen, axis=0)) for seen in points.values() if len(seen) > 10]
    assert len(slides) > 3
    assert np.median(slides) > 0.1  # m, along its edge; a rigid point would not move
    for j, seen in points.items():
        fixed = np.ptp(seen, axis=0)
        assert np.allclose(fixed[2] if edges.by_far[j] else fixed[:2], 0.0, rtol=0, atol=1e-9)  # stays on its edge


def test_crossings_are_things_of_every_run_with_labels_and_noise(small):
    plain = cs.load_scenario("herath2007-stereo")
    wide = {"truth__sensor__disparity": (1e-6, 1e6), "truth__sensor__effects": [EFFECT | {"far_share": 0.0}]}
    crossed = plain.variant("crossed", **wide)
    a, b = (cs.simulate(crossed, run, seed=3) for run in (0, 1))
    assert np.array_equal(a.things, b.things)
    assert np.all(a.things >= 120)
    assert len(a.things) == a.n_landmarks - 120 == 12
    assert np.all(a.source[a.landmark >= 120] == -1)
    ideal = World(crossed.truth)._shared
    thing = ideal.landmark >= 120
    assert thing.sum() > 100
    spread = (a.z - ideal.z)[thing] / np.array(plain.truth.sensor.sigma)
    assert 0.5 < spread.std() < 2.0  # 300 numbers or more with a standard deviation of 1


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_the_matcher_takes_one_edge_or_the_other(share):
    _, effect, context = world_of()
    edges = effect.model_copy(update={"far_share": share}).drawn(context)
    assert np.all(edges.by_far == (share == 1.0))


@pytest.mark.parametrize("x, seen", [(3.0, True), (1.0, False)])
def test_the_far_edge_must_be_behind_the_near_one(x, seen):
    _, effect, context = world_of()
    edges = Crossings(np.array([[2.0, 0.0, 0.2]]), np.array([[x, 0.0, 0.3]]), np.array([[0.0, 1.0]]), np.zeros(1, bool))
    standing = Context(context.sensor, context.landmarks, np.zeros((3, 3)), np.zeros((3, 3)))
    z, observed = effect._seen(edges, standing)
    assert observed.tolist() == [[seen], [seen]]
    assert np.allclose(z[:, 0], [0.0, -150.0 * 0.3 / x, 150.0 * 0.09 / 2.0])


def test_edges_are_drawn_as_a_world_is():
    """From their own seed, and as far behind each other as the scenario says."""
    _, effect, context = world_of()
    edges, again = effect.drawn(context), effect.drawn(context)
    assert np.array_equal(edges.near, again.near)
    other = effect.model_copy(update={"seed": 6}).drawn(context)
    assert not np.array_equal(edges.near, other.near)
    gap = np.linalg.norm((edges.far - edges.near)[:, :2], axis=1)
    assert np.all((gap >= 1.0) & (gap <= 3.0))
    assert np.allclose(np.linalg.norm(edges.along, axis=1), 1.0)
    assert np.allclose(((edges.far - edges.near)[:, :2] * edges.along).sum(axis=1), 0.0, atol=1e-12)
