"""A covariance that is too large by the factor of a usual confidence level."""

from __future__ import annotations

from consistency.referee.diagnostics.verdict.verdict import Findings

NARROW = 1.25  # upper over lower end of a ratio that tells such factors from others
CEP = 1.386  # 2 log 2
LEVELS = {
    3.84: "deviations stated at 95 % (1.96 sigma)",
    4.0: "deviations of 2 sigma",
    CEP: "a CEP in place of deviations (the radius of 50 % in the plane, 1.1774 sigma)",
}  # by the factor on a variance, the squares of these multiples


def level_causes(found: Findings) -> list[str]:
    """Usual levels whose factor the interval of the ratio holds, if it is narrow and all components agree; or none.

    Other faults make such a ratio, too: about one in 20 of the filters whose covariance is too large by any factor.
    """
    if found.status != "conservative" or found.scale is None:
        return []
    ratio = found.scale.inflation
    if not 0.0 < ratio.high <= NARROW * ratio.low:
        return []
    ratios = [ratio]
    if found.axes is not None:
        ratios += [found.axes.inflation[name] for name in found.axes.names]
    fitting = [of for of in LEVELS if all(each.holds(1.0 / of) for each in ratios)]
    if found.scale.dof != 2:
        fitting = [of for of in fitting if of != CEP]
    if not fitting:
        return []
    words = " or ".join(LEVELS[of] for of in fitting)
    factors = " or ".join(f"{of:g}" for of in fitting)
    return [f"perhaps a matter of what is stated: a covariance that is {factors} times too large would fit {words}"]
