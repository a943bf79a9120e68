"""Drives that no white noise describes: each refused or named, with the reason and the remedy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fit_covariance import PER_M, World, drives, matrices_of

import consistency as cs
from consistency.referee.errors import InputError
from consistency.referee.fit_covariance.covariance_ratios import Ratio
from consistency.referee.fit_covariance.drives import Drive
from consistency.referee.fit_covariance.persistence import TERMS, Lasting, persistent
from consistency.referee.fit_covariance.refusals import Growth, body_turn, growth_of, revisits
from consistency.referee.fit_covariance.white_noise import fit_noise
from consistency.referee.fit_covariance.windows import span_of, windows_of
from consistency.referee.fit_covariance.wording import lines, sentence
from consistency.referee.geometry.groups import composed, inverse, vectors
from consistency.referee.types import Array

SPAN = "10m"
RIGHT = Ratio(1.0, 0.8, 1.25, 0.1, 6, 600)


@pytest.mark.parametrize(
    ("world", "words"),
    [
        (World(closed=True), ("loops are closed", "record the live odometry")),
        (World(metric=2.2), ("2.2 times", "not metric", "scale state")),
        (World(metric=0.5), ("0.5 times", "not metric")),
        (World(turned=0.1), ("constant turn of the body by 5.7", "calibration")),
        (World(turned=np.pi / 2), ("constant turn of the body by 90", "calibration")),
        (World(jumps=8), ("have a jump", "more than 5 %")),
    ],
)
def test_a_drive_that_is_refused(world: World, words: tuple[str, ...], rng: np.random.Generator) -> None:
    with pytest.raises(InputError) as error:
        cs.fit_covariance(drives(rng, 2, world), SPAN)
    assert all(word in str(error.value) for word in words), str(error.value)
    assert "\n" not in str(error.value)


def test_scale_is_the_users_matter_without_correction(rng: np.random.Generator) -> None:
    model = cs.fit_covariance(drives(rng, 2, World(metric=2.2), 400.0), SPAN, correct=False)
    assert (model.noise.mean.way, model.noise.mean.turn, model.noise.mean.drift) == (1.0, 1.0, (0.0,))


def test_too_few_windows(rng: np.random.Generator) -> None:
    short = drives(rng, 1, length=40.0)
    with pytest.raises(InputError, match=r"too few to fit|fewer than|5 drives"):
        cs.fit_covariance(short, SPAN)
    with pytest.raises(InputError, match="only 40 m"):
        cs.fit_covariance(short, "100m")
    with pytest.raises(InputError, match="at least one drive"):
        cs.fit_covariance([], SPAN)
    with pytest.raises(InputError, match=r"of cs\.read_drives"):
        cs.fit_covariance(["wheels"], SPAN)  # type: ignore[list-item]


def test_estimate_and_truth_are_the_same(rng: np.random.Generator) -> None:
    drive = drives(rng, 1)[0]
    with pytest.raises(InputError, match="same positions"):
        fit_noise(windows_of([replace(drive, estimate=drive.truth)], span_of(SPAN)))


def test_a_loop_that_is_closed_has_small_errors_between_passes(rng: np.random.Generator) -> None:
    """Circles of 250 m: white noise adds up between passes; a heading that is corrected at each pass does not."""

    def circles(closed: bool) -> list[Drive]:
        found = []
        for i in range(4):
            n = 4000
            angle = 2 * np.pi * np.arange(n) / 500
            T = np.tile(np.eye(3), (n, 1, 1))
            T[:, 0, 0] = T[:, 1, 1] = np.cos(angle)
            T[:, 1, 0], T[:, 0, 1] = np.sin(angle), -np.sin(angle)
            T[:, 0, 2], T[:, 1, 2] = 250 / (2 * np.pi) * np.sin(angle), 250 / (2 * np.pi) * (1 - np.cos(angle))
            yaw = np.cumsum(0.002 * rng.normal(size=n))
            if closed:  # what has gathered in a lap is taken out at its end
                laps = np.arange(n) // 500
                ends = np.concatenate([[0.0], yaw[499::500]])
                yaw = yaw - ends[laps]
            E = np.tile(np.eye(3), (n, 1, 1))
            E[:, 0, 0] = E[:, 1, 1] = np.cos(yaw)
            E[:, 1, 0], E[:, 0, 1] = np.sin(yaw), -np.sin(yaw)
            found.append(Drive(f"lap {i}", np.arange(n) * 0.5, np.arange(n), T @ E, T))
        return found

    for closed in (False, True):
        made = circles(closed)
        ratio, chance = revisits(made, windows_of(made, span_of("5m")))
        assert (ratio > 1.2 and chance > 0.002) if not closed else (chance < 0.01 and ratio < 1.2)
    assert np.isnan(revisits(made, windows_of(made, span_of("5s")))[0])


def test_growth_of_white_noise_and_of_a_persistent_drift(rng: np.random.Generator) -> None:
    """Power 1 within 4 standard errors of 0.1; nearly 2 where the drift of a drive outweighs its noise."""
    for world, low, high in ((World(), 0.6, 1.4), (World(memory=2000.0, coloured=3e-3), 1.6, 2.1)):
        made = drives(rng, 5, world)
        w = windows_of(made, span_of(SPAN))
        growth = growth_of(made, w, False, fit_noise(w).mean)
        assert low < growth.power < high
        assert growth.persists == (low > 1)
        told = [each for each in cs.fit_covariance(made, SPAN).warnings if "errors last longer than a window" in each]
        assert len(told) == (low > 1)
        assert not growth.shrinks
    short = drives(rng, 1, length=150.0)
    w = windows_of(short, span_of(SPAN))
    assert np.isnan(growth_of(short, w, False, fit_noise(w).mean).power)


def test_growth_needs_its_standard_errors() -> None:
    assert Growth(0.3, 0.1).shrinks
    assert not Growth(0.3, 0.3).shrinks
    assert not Growth(0.6, 0.01).shrinks
    assert Growth(1.6, 0.1).persists
    assert not Growth(1.6, 0.3).persists


@pytest.mark.parametrize(
    ("world", "word"),
    [(World(scale=0.02), "the scale of the way"), (World(memory=5000.0, coloured=3e-3), "drift of the heading")],
)
def test_terms_that_persist_are_named_from_five_drives_on(world: World, word: str, rng: np.random.Generator) -> None:
    made = drives(rng, 6, world)
    few = cs.fit_covariance(made[:4], SPAN)
    assert not any("differs between drives" in each for each in few.warnings)
    assert not few.lasting
    model = cs.fit_covariance(made, SPAN)
    told = [each for each in model.warnings if word in each]
    assert told
    assert "add a state" in told[0]
    assert [word in each.term and each.decides for each in model.lasting].count(True) == 1
    right = replace(model, spans=(replace(model.spans[0], whole=RIGHT, axes=(RIGHT,) * 3), *model.spans[1:]))
    assert right.status == "undecided"
    assert "of the variance of an axis, so that new drives may have another covariance" in sentence(right)
    for term, decides in zip(TERMS, (True, True, False), strict=True):
        small = replace(right, lasting=(Lasting(term, 0.1, 0.2),))
        assert small.status == ("undecided" if decides else "consistent")
        assert ("new drives may" in sentence(small)) == decides
    assert replace(right, lasting=()).status == "consistent"
    wrong = replace(RIGHT, low=2.0, value=2.5, high=3.0)
    assert replace(model, spans=(replace(model.spans[0], whole=wrong), *model.spans[1:])).status == "overconfident"


def test_no_term_is_named_without_one(rng: np.random.Generator) -> None:
    """1 % a draw: of 12, more than 2 with a chance of 2e-4."""
    named = 0
    for _ in range(12):
        w = windows_of(drives(rng, 5, length=300.0), span_of(SPAN))
        named += bool(persistent(fit_noise(w), w))
    assert named <= 2


def test_body_frames_that_agree(rng: np.random.Generator) -> None:
    w = windows_of(drives(rng, 2), span_of(SPAN))
    angle, share, chance = body_turn(w)
    assert angle < 0.05
    assert share < 0.1
    assert chance > 1e-6


def test_a_second_estimator_with_the_same_errors(rng: np.random.Generator) -> None:
    """Errors of the truth are in both; of another odometry they are not."""
    made = drives(rng, 5, length=500.0)
    same = cs.fit_covariance(made, SPAN, second=made)
    np.testing.assert_allclose(same.second.correlation, 1.0, atol=0.05)
    np.testing.assert_allclose(same.second.size, 1.0, atol=0.05)
    assert same.status != "consistent"
    assert "correlate" in repr(same)

    def steps(T: Array) -> Array:
        return inverse(T[:-1]) @ T[1:]

    def twin(drive: Drive, error: Array) -> Drive:
        """Another estimate of the same truth, with errors (N - 1, 3) of its steps."""
        T = np.concatenate([drive.truth[:1], steps(drive.truth) @ matrices_of(error)])
        return replace(drive, estimate=composed(T))

    def own(times: float) -> list[Drive]:
        """With noise of its own: in x and y ``times`` as large."""
        sigma = np.sqrt(0.5 * np.array(PER_M)) * [times, times, 1.0]
        return [twin(drive, sigma * rng.normal(size=(len(drive.t) - 1, 3))) for drive in made]

    larger = [twin(d, 3 * vectors(inverse(steps(d.truth)) @ steps(d.estimate))) for d in made]
    found = cs.fit_covariance(made, SPAN, second=larger).second
    np.testing.assert_allclose(found.correlation, 1.0, atol=0.1)
    np.testing.assert_allclose(found.size, 3.0, rtol=0.1)
    other, rough = (cs.fit_covariance(made, SPAN, second=own(times)) for times in (1.0, 5.0))
    assert np.abs(other.second.correlation).max() < 0.4
    assert other.second.is_rough.tolist() == [False] * 3
    assert rough.second.is_rough.tolist() == [True, True, False]
    assert lines(rough)[1].endswith("above 0.7 they are the truth's; it errs too much to tell in x, y")
    assert "too much" not in lines(other)[1]
    with pytest.raises(InputError, match="--second"):
        cs.fit_covariance(made, SPAN, second=[replace(each, name="else") for each in made])


def test_a_second_estimator_in_space_beside_three_axes(rng: np.random.Generator) -> None:
    made = drives(rng, 2, World(per_m=(1e-3,) * 3 + (1e-5,) * 3, per_rad=(1e-9,) * 6), 400.0)
    model = cs.fit_covariance(made, SPAN, axes=3, second=made)
    assert (model.second.correlation > 0.8).all()


def test_the_turn_of_a_straight_drive_is_the_least(rng: np.random.Generator) -> None:
    """A camera that looks 3 degrees to the side on a straight road, which tells nothing of a roll."""
    world = World(per_m=(1e-5,) * 3 + (1e-7,) * 3, per_rad=(1e-9,) * 6)
    made = drives(rng, 1, world, 400.0)[0]
    T = np.tile(np.eye(4), (len(made.t), 1, 1))
    T[:, 0, 3] = np.arange(len(made.t))
    T[:, 1:3, 3] = 0.001 * rng.normal(size=(len(T), 2))
    noise = inverse(made.truth) @ made.estimate
    side = matrices_of(np.array([[0.0, 0, 0, 0, 0, np.deg2rad(3.0)]]))
    straight = replace(made, truth=T, estimate=inverse(side) @ T @ noise @ side)
    angle, share, _ = body_turn(windows_of([straight], span_of(SPAN)))
    assert 2.0 < np.rad2deg(angle) < 5.0
    assert share > 0.5
