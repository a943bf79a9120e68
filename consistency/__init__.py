"""The filter-consistency test bench: does an estimator tell the truth about its own uncertainty?"""

from consistency.extras import lazy_names

# the names stand in __init__.pyi; each is loaded on first use, so that `import consistency` and `--help` stay fast
__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
