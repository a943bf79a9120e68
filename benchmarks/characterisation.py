"""Does ``consistency characterise`` recover what was simulated, in all parameters at once?

    python benchmarks/characterisation.py                     # the promise: 100 repetitions of 10 runs, two worlds
    python benchmarks/characterisation.py --repetitions 5     # quicker

Each repetition has a seed of its own. The world ``plain`` is herath2007-stereo; in ``real`` the noise of disparity
grows with disparity and the image has a bias map of up to 2 px, as in Herath et al. (2007) fig. 5c and 8. Exit status 1
if all intervals hold together in fewer than 95 of 100 repetitions, if the interval of one of sigma_u, sigma_v, sigma_d
is wider than 5 % of its value, or if the bias map is off by more than 0.1 px rms.
"""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from script_options import options_of

import consistency as cs
from consistency.bench.scenario import PicturedSensor, Scenario, UvdSensor, models
from consistency.bench.scenario.observations import BiasMap, DisparityGrowth
from consistency.bench.simulation import World
from consistency.bench.types import Trial
from consistency.referee.types import Array
from consistency.stereo.characterising.characterise import Characterisation, characterise, residuals_of
from consistency.stereo.characterising.sensor_text import believed_sensor

SCENARIO = "herath2007-stereo"
EVERYTHING = (1e-6, 1e6)  # px: a search range that leaves nothing out
SHARE = 0.95  # of the repetitions, at least
WIDTH = 0.05  # of a sigma, at most
RMS = 0.1  # px, of the bias map, at most


@dataclass(frozen=True)
class Real:
    """What a real sensor adds to the noise of the scenario."""

    growth: DisparityGrowth | None
    bias: BiasMap | None


def real() -> Real:
    """A growth of 4 from far to near, and a smooth bias of 2 px towards the corners."""
    u, v = np.linspace(-160.0, 160.0, 5), np.linspace(-120.0, 120.0, 4)
    x, y = np.meshgrid(u / 160.0, v / 120.0)
    maps = {"bias_u": 0.8 * x * (1 - y**2), "bias_v": 0.6 * y + 0.4 * x * y, "bias_d": x**2 + y**2 - 0.5 * x}
    matrices = {key: tuple(tuple(map(float, row)) for row in value) for key, value in maps.items()}
    bias = BiasMap(u=tuple(map(float, u)), v=tuple(map(float, v)), **matrices)
    return Real(DisparityGrowth(disparity=(2.0, 32.0), ratio=(0.6, 2.4)), bias)


def trials_of(scenario: Scenario, world: World, of: Real, runs: int, seed: int) -> list[Trial]:
    """Trials whose noise grows and whose image is bent; ``world`` must search all disparities."""
    return [_changed(world.trial(run, seed), scenario, of) for run in range(runs)]


def _changed(trial: Trial, scenario: Scenario, of: Real) -> Trial:
    sensor = scenario.truth.sensor
    assert isinstance(sensor, UvdSensor)
    assert trial.truth is not None
    assert trial.landmarks is not None
    step = trial.step
    body = models.to_robot(*trial.truth[step].T, *trial.landmarks[trial.landmark].T)
    ideal = np.stack(models.project(*models.to_sensor(*body, sensor.mount.packed()), *sensor.rig), axis=-1)
    noise = trial.z - ideal
    if of.growth is not None:
        noise[:, 2] *= of.growth.ratio_at(ideal[:, 2])
    z = ideal + noise + (0.0 if of.bias is None else of.bias.at(ideal[:, 0], ideal[:, 1]))
    low, high = sensor.disparity
    seen = (z[:, 2] >= low) & (z[:, 2] <= high)
    first = np.append(0, np.cumsum(np.add.reduceat(np.append(seen, False), trial.first)))[:-1]
    return replace(trial, z=z[seen], landmark=trial.landmark[seen], first=first)


def missed(of: Characterisation, scenario: Scenario, truth: Real) -> list[str]:
    """Parameters whose true value is outside its interval."""
    sigma = scenario.truth.sensor.sigma
    d = of.kept.ideal[:, 2]
    ratio = np.ones(len(d)) if truth.growth is None else truth.growth.ratio_at(d)
    true_sigma = (*sigma[:2], sigma[2] * float(np.sqrt(np.mean(ratio**2))))
    out = [f"sigma_{c.name}" for c, true in zip(of.coordinates, true_sigma, strict=True) if not c.sigma.holds(true)]
    for c in of.coordinates:
        out += [f"correlation {c.name}"] * bool(c.correlation and not c.correlation.holds(0.0))
        out += [f"offset {c.name}"] * bool(c.offset and not c.offset.holds(0.0))
        out += [f"tails {c.name}"] * (not c.tails.weight.holds(0.0))
    out += ["gross"] * (not of.gross.holds(0.0))
    if of.growth is not None:
        at = np.ones(len(of.growth.nodes)) if truth.growth is None else truth.growth.ratio_at(of.growth.nodes)
        out += ["growth"] * (not all(s.holds(sigma[2] * r) for s, r in zip(of.growth.sigma, at, strict=True)))
    if of.bias is not None:
        u, v = (grid.ravel() for grid in np.meshgrid(of.bias.grid.u, of.bias.grid.v))
        true_bias = np.zeros((len(u), 3)) if truth.bias is None else truth.bias.at(u, v)
        off = np.abs(of.bias.value - true_bias.T) > of.bias.half
        out += [f"bias {'uvd'[k]}" for k in np.flatnonzero(off[:, of.bias.grid.known].any(axis=1))]
    return out


def bias_rms(of: Characterisation, truth: Real) -> Array:
    """Root mean square error of what is believed of the bias of u, v, d, over the places of the observations, px."""
    u, v = of.kept.ideal[:, 0], of.kept.ideal[:, 1]
    bias = believed_sensor(of).bias
    found = np.zeros((len(u), 3)) if bias is None else bias.at(u, v)
    true = np.zeros((len(u), 3)) if truth.bias is None else truth.bias.at(u, v)
    return np.asarray(np.sqrt(np.mean((found - true) ** 2, axis=0)))


@dataclass(frozen=True)
class Outcome:
    """All repetitions of one world."""

    missed: list[list[str]]
    width: Array  # (repetitions, 3), of the intervals of sigma over the value
    rms: Array  # (repetitions, 3), px

    @property
    def good(self) -> bool:
        share = np.mean([not names for names in self.missed])
        return bool(share >= SHARE and self.width.max() <= WIDTH and np.sqrt(np.mean(self.rms**2)) <= RMS)

    def text(self, name: str) -> str:
        held = sum(not names for names in self.missed)
        counts = (
            ", ".join(f"{key} {n}" for key, n in Counter(key for names in self.missed for key in names).most_common())
            or "none"
        )
        width, rms = 100 * self.width.mean(axis=0), np.sqrt(np.mean(self.rms**2, axis=0))
        return (
            f"{name}: all intervals hold in {held} of {len(self.missed)} repetitions; missed: {counts}\n"
            f"  width of sigma_u, sigma_v, sigma_d: {width[0]:.1f}, {width[1]:.1f}, {width[2]:.1f} % of the value "
            f"(widest {100 * self.width.max():.1f} %)\n"
            f"  bias map of u, v, d: {rms[0]:.3f}, {rms[1]:.3f}, {rms[2]:.3f} px rms (worst {self.rms.max():.3f})"
        )


def repeat(truth: Real, repetitions: int, runs: int, seed: int) -> Outcome:
    scenario = cs.load_scenario(SCENARIO)
    sensor = scenario.truth.sensor
    assert isinstance(sensor, UvdSensor)
    world = World(scenario.variant("everything", truth__sensor__disparity=EVERYTHING).truth)
    known = PicturedSensor(
        model="uvd", sigma=sensor.sigma, f=sensor.f, B=sensor.B, disparity=sensor.disparity, image=sensor.image
    )
    names, widths, errors = [], [], []
    for number in range(repetitions):
        data, _ = residuals_of(trials_of(scenario, world, truth, runs, seed + number), known)
        of = characterise(data, known, f"seed {seed + number}")
        names.append(missed(of, scenario, truth))
        widths.append([(c.sigma.high - c.sigma.low) / c.sigma.value for c in of.coordinates])
        errors.append(bias_rms(of, truth))
        if names[-1]:
            print(f"seed {seed + number}: {', '.join(names[-1])}", flush=True)
    return Outcome(names, np.array(widths), np.array(errors))


def main() -> None:
    options = options_of(
        __doc__,
        repetitions=(100, None),
        runs=(10, None),
        seed=(0, "of the first repetition"),
    )
    good = True
    for name, truth in {"plain": Real(None, None), "real": real()}.items():
        outcome = repeat(truth, options.repetitions, options.runs, options.seed)
        print(outcome.text(name), flush=True)
        good &= outcome.good
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()
