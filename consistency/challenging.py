"""The world in which a filter is most overconfident."""

from consistency.referee.extras import explained_import

with explained_import(__name__):
    from consistency.bench.challenging.challenge import Challenge, Plan, challenge

__all__ = ["Challenge", "Plan", "challenge"]
