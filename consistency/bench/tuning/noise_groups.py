"""What a factor scales: process noise Q, measurement noise R, or single channels of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from consistency.bench.scenario import Belief
from consistency.referee.errors import InputError
from consistency.referee.types import Array

MOTION = ("v", "omega")  # channels of Q
CHANNELS = {  # of R, by model of the sensor
    "uvd": ("u", "v", "d"),
    "xyz": ("x", "y", "z"),
    "linear": ("x", "y", "z"),
    "relative-xy": ("dx", "dy"),
    "range-bearing": ("range", "bearing"),
}
DIGITS = 6  # of a tuned standard deviation, so that what is judged is what is written


class NoiseGroup(NamedTuple):
    """Channels whose variances have one factor, such as ``Q.v``; ``name`` is what the user calls them."""

    name: str
    channels: tuple[str, ...]


def noise_groups_of(text: str, belief: Belief) -> tuple[NoiseGroup, ...]:
    """Groups as the option ``--groups`` has them: "Q,R", "Q.v,Q.omega,R" or "Q,R.u+R.v,R.d".

    ``Q`` and ``R`` stand for all their channels with a noise. Channels that no group names stay as they are.

    Raises
    ------
    InputError
        An unknown channel, one that is named twice, or one whose noise is zero and stays so whatever its factor.
    """
    sigma, channels_by_name = sigma_by_channel(belief), dict[str, list[str]]()
    for noise in ("Q", "R"):
        members = [channel for channel in sigma if channel.startswith(noise)]
        channels_by_name[noise] = [channel for channel in members if sigma[channel] > 0.0]
        channels_by_name |= {channel: [channel] for channel in members}
    groups, seen = [], set[str]()
    for name in (part.strip() for part in text.split(",")):
        channels: list[str] = []
        for member in (part.strip() for part in name.split("+")):
            if member not in channels_by_name:
                raise InputError(f"--groups {text}: unknown noise '{member}'; there are {', '.join(channels_by_name)}")
            if not any(sigma[channel] for channel in channels_by_name[member]):
                raise InputError(
                    f"--groups {text}: '{member}' is believed to be zero, which no factor changes; believe in a noise, "
                    "or leave it out"
                )
            channels += channels_by_name[member]
        for channel in channels:
            if channel in seen:
                raise InputError(f"--groups {text}: '{channel}' is named twice; it has one factor")
            seen.add(channel)
        groups.append(NoiseGroup(name, tuple(channels)))
    return tuple(groups)


def scaled(belief: Belief, groups: Sequence[NoiseGroup], log_factors: Array) -> Belief:
    """The belief with the variances of each group times its factor; ``log_factors`` (groups,)."""
    sigma = sigma_by_channel(belief)
    for group, log_factor in zip(groups, log_factors, strict=True):
        for channel in group.channels:
            sigma[channel] *= float(np.exp(log_factor / 2.0))
    return _with_sigma(belief, sigma)


def rounded(belief: Belief) -> Belief:
    """The belief with the digits that are written of its standard deviations."""
    sigma = sigma_by_channel(belief)
    for channel, value in sigma.items():
        sigma[channel] = float(f"{value:.{DIGITS}g}")
    return _with_sigma(belief, sigma)


def sigma_by_channel(belief: Belief) -> dict[str, float]:
    """Standard deviation of each channel, SI units and px."""
    values = (belief.motion.sigma_v, belief.motion.sigma_omega, *belief.sensor.sigma)
    names = (*(f"Q.{name}" for name in MOTION), *(f"R.{name}" for name in CHANNELS[belief.sensor.model]))
    return dict(zip(names, values, strict=True))


def _with_sigma(belief: Belief, sigma: dict[str, float]) -> Belief:
    sigma_v, sigma_omega, *sensor_sigmas = sigma.values()
    motion = belief.motion.model_copy(update={"sigma_v": sigma_v, "sigma_omega": sigma_omega})
    return belief.model_copy(
        update={"motion": motion, "sensor": belief.sensor.model_copy(update={"sigma": tuple(sensor_sigmas)})}
    )
