"""How often does ``consistency challenge`` find a right filter overconfident? Many searches, each with another seed.

    python benchmarks/challenge_rate.py                          # the promise: 200 searches of 10 s, some 40 minutes
    python benchmarks/challenge_rate.py --searches 40 --trials 200   # quicker, and the same on each machine

Exit status 1 if more searches found something than a rate as stated explains (binomial, 1 %).
"""

from __future__ import annotations

import argparse
import sys

from scipy import stats

from consistency.bench.challenging.challenge import Plan, challenge

SURE = 0.01  # chance that a rate exactly as stated is called broken


def main() -> None:
    """Search, count, and compare with the stated rate."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--searches", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=10.0, help="of each search")
    parser.add_argument("--trials", type=int, help="of each search, in place of --seconds")
    parser.add_argument("--filter", default="kf", help="one that is right in the worlds of its scenario")
    parser.add_argument("--false-alarm", type=float, default=0.05)
    parser.add_argument("--seed", type=int, default=0, help="of the first search")
    parser.add_argument("--jobs", type=int, default=-1)
    options = parser.parse_args()
    minutes = None if options.trials is not None else options.seconds / 60.0
    found, worlds, longest = 0, 0, 0.0
    for seed in range(options.seed, options.seed + options.searches):
        plan = Plan(minutes, options.trials, seed, options.jobs, options.false_alarm)
        outcome = challenge(options.filter, None, plan)
        found, worlds = found + outcome.found, worlds + outcome.worlds
        longest = max(longest, outcome.seconds)
        if outcome.found:
            print(f"seed {seed}: {outcome.verdict.status} in {outcome.space.text(outcome.point)}", flush=True)
    p_value = float(stats.binom.sf(found - 1, options.searches, options.false_alarm))
    high = stats.binomtest(found, options.searches).proportion_ci(0.98, "exact").high
    print(
        f"{options.filter}: found in {found} of {options.searches} searches (at most {high:.1%}, 99 % binomial; stated "
        f"{options.false_alarm:.1%}, p {p_value:.3f}); {worlds / options.searches:.0f} worlds a search, the longest "
        f"{longest:.1f} s"
    )
    sys.exit(1 if p_value <= SURE else 0)


if __name__ == "__main__":
    main()
