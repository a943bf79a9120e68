"""Feature management: which tracks are chosen, how many, and when they are forgotten."""

import numpy as np
import pytest

import consistency as cs
from consistency.bench.scenario.effects import FieldOfView, Selection
from consistency.bench.simulation import World

EFFECT = {
    "kind": "selection", "count": 6, "forget_steps": 4, "seed": 11, "cells": [4, 3], "near_px": 6.0,
    "strength": 1.0, "stereo": 0.7, "image": 0.9, "depth": 0.8,
}  # fmt: skip
STEPS = 120


def world(**changes):
    dense = {"truth__steps": STEPS, "truth__landmarks__count": 400}
    world = World(cs.load_scenario("herath2007-stereo").variant("dense", **{**dense, **changes}).truth)
    return world.context(world.reference)


def observed(context):
    return FieldOfView().apply(context.ideal(), np.random.default_rng(0), context)


def flickering(context):
    """With gaps of one to a few steps in tracks."""
    everything = observed(context)
    gone = np.random.default_rng(3).random((7, everything.ids))[everything.step // 3 % 7, everything.landmark] < 0.3
    return everything.keep(~gone)


def kept(effect, observations, context):
    chosen = effect.apply(observations, np.random.default_rng(0), context)
    return set(zip(chosen.step.tolist(), chosen.landmark.tolist(), strict=True))


def plainly(effect, observations, context):
    """The same rules, one step and one feature at a time."""
    strength = np.random.default_rng(effect.seed).random(observations.ids)
    (width, height), (columns, rows), high = context.sensor.image, effect.cells, context.sensor.disparity[1]
    unseen = {}
    out = set()
    for k in range(1, context.steps + 1):
        here = np.flatnonzero(observations.step == k)
        z = {int(observations.landmark[i]): observations.z[i] for i in here}
        for label in list(unseen):
            unseen[label] = 0 if label in z else unseen[label] + 1
            if unseen[label] >= effect.forget_steps:
                del unseen[label]

        def cell(label, z=z):
            return int((z[label][0] + width / 2) * columns // width), int((z[label][1] + height / 2) * rows // height)

        while len(unseen) < effect.count and (left := [label for label in z if label not in unseen]):
            chosen = [label for label in unseen if label in z]
            rank = {}
            for label in left:
                crowd = sum(cell(other) == cell(label) for other in chosen)
                across = [(z[other][2] >= effect.near) != (z[label][2] >= effect.near) for other in chosen]
                rank[label] = (
                    effect.strength * strength[label]
                    + effect.stereo * min(z[label][2] / high, 1.0)
                    + effect.image / (1 + crowd)
                    + effect.depth * (np.mean(across) if across else 1.0)
                )
            unseen[max(rank, key=rank.__getitem__)] = 0
        out |= {(k, label) for label in unseen if label in z}
    return out


@pytest.mark.parametrize("weights", [(1, 0, 0, 0), (0, 1, 0, 0), (0.1, 0, 1, 0), (0.1, 0, 0, 1), (1.0, 0.7, 0.9, 0.8)])
def test_a_selection_is_that_of_plain_rules(weights):
    names = dict(zip(("strength", "stereo", "image", "depth"), map(float, weights), strict=True))
    effect, context = Selection.model_validate(EFFECT | names), world()
    observations = flickering(context)
    assert len(observations) > 1000
    assert kept(effect, observations, context) == plainly(effect, observations, context)


def test_there_are_never_more_tracks_than_places():
    effect, context = Selection.model_validate(EFFECT), world()
    steps = [step for step, _ in kept(effect, observed(context), context)]
    assert np.bincount(steps).max() == 6
    everything = Selection.model_validate(EFFECT | {"count": 1000})
    assert len(kept(everything, observed(context), context)) == len(observed(context))


def test_a_track_is_kept_while_it_is_seen_and_over_short_gaps():
    """One landmark is best, is gone for some steps, and comes back to find its place or another in it."""
    context = world(truth__landmarks={"layout": "listed", "points": [[3.9, 3.0, 0.0], [4.1, 3.0, 0.0]]})
    strong = int(np.random.default_rng(11).random(2).argmax())
    for gap, there in ((3, strong), (4, 1 - strong)):
        step, landmark = np.divmod(np.arange(24), 2)
        away = (landmark == strong) & (step >= 4) & (step < 4 + gap)
        observations = context.at(step[~away] + 1, landmark[~away])
        effect = Selection.model_validate(EFFECT | {"count": 1, "stereo": 0.0, "image": 0.0, "depth": 0.0})
        rows = kept(effect, observations, context)
        assert {label for step, label in rows if step <= 4} == {strong}
        assert {label for step, label in rows if step > 4 + gap} == {there}
        assert not {step for step, _ in rows if 4 < step < 8}


def test_weights_do_what_they_say():
    context = world()

    def chosen(**weights):
        none = {"strength": 0.05, "stereo": 0.0, "image": 0.0, "depth": 0.0}
        effect = Selection.model_validate(EFFECT | none | weights)
        return effect.apply(observed(context), np.random.default_rng(0), context).z

    def cells(z):
        return len(set(zip(z[:, 0] // 80, z[:, 1] // 80, strict=True)))

    plain, near = chosen(), chosen(stereo=2.0)
    assert near[:, 2].mean() > 1.2 * plain[:, 2].mean()
    all_near, even = np.mean(plain[:, 2] >= 9.0), np.mean(chosen(depth=2.0, near_px=9.0)[:, 2] >= 9.0)
    assert all_near < 0.3
    assert even > all_near + 0.1
    assert cells(chosen(image=2.0)) >= cells(plain)


def test_what_is_chosen_does_not_depend_on_the_noise_and_is_done_once():
    scenario = cs.load_scenario("herath2007-stereo").variant(
        "chosen", truth__steps=STEPS, truth__sensor__effects=[EFFECT], truth__sensor__disparity=(1e-6, 1e6)
    )
    world = World(scenario.truth)
    a, b = world.trial(0, 0), world.trial(1, 0)
    assert np.array_equal(a.landmark, b.landmark)
    assert not np.array_equal(a.z, b.z)
    plain = World(scenario.variant("plain", truth__sensor__effects=[]).truth).trial(0, 0)
    assert 0 < len(a.z) < len(plain.z)


def test_apparent_features_compete_with_real_ones():
    junction = {"kind": "junction", "count": 9, "seed": 5, "behind_m": [1.0, 3.0], "edge_m": 2.0, "far_share": 0.5}
    base = cs.load_scenario("herath2007-stereo").variant("both", truth__sensor__effects=[junction, EFFECT])
    after = cs.load_scenario("herath2007-stereo").variant("other", truth__sensor__effects=[EFFECT, junction])
    most = [np.diff(cs.simulate(scenario).first).max() for scenario in (base, after)]
    assert most[0] <= 6 < most[1]
    assert len(cs.simulate(base).things) > 0
