"""The noises that a filter should believe in, and the verdict on them."""

from consistency.referee.extras import explained_import

with explained_import(__name__):
    from consistency.bench.tuning.tune import Factor, Setting, Tuning, tune

__all__ = ["Factor", "Setting", "Tuning", "tune"]
