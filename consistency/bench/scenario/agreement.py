"""Whether what a scenario believes is what is true."""

from __future__ import annotations

from consistency.bench.scenario.effects import LocalBias
from consistency.bench.scenario.scenario import Scenario

# keys of both halves; of the second kind one half may have what the other leaves out
NUMBERS = (("motion", ("sigma_v", "sigma_omega")), ("sensor", ("sigma", "mount", "f", "B", "disparity")))
OPTIONAL = (("sensor", ("disparity_growth",)),)


def misbelief(scenario: Scenario) -> str:
    """What the belief has otherwise than the truth, and the remedy, in one clause; empty where the belief is right.

    A bias map must be believed if it is the case. Other effects that make observations err are in no belief.
    """
    truth, belief = scenario.truth, scenario.belief
    for keys, may_lack in ((NUMBERS, True), (OPTIONAL, False)):
        for table, key in ((table, key) for table, names in keys for key in names):
            believed, true = (getattr(getattr(of, table), key, None) for of in (belief, truth))
            if believed != true and not (may_lack and None in (believed, true)):
                return f"key 'belief.{table}.{key}' is not what truth.{table}.{key} is; make them the same"
    effects = truth.sensor.effects
    maps = [effect.map() for effect in effects if isinstance(effect, LocalBias)]
    if maps != ([] if belief.sensor.bias is None else [belief.sensor.bias]):
        return "key 'belief.sensor.bias' is not the bias of the effect 'local-bias' in truth.sensor; make them the same"
    unknown = [effect.label for effect in effects if effect.errs and not isinstance(effect, LocalBias)]
    return f"no belief holds the effect '{unknown[0]}' (truth.sensor.effects); leave it out" if unknown else ""
