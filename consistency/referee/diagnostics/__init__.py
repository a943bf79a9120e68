"""Statistics of filter consistency: arrays in, records out; needs numpy and scipy only.

Tables, plots and files do not belong here.
"""

from consistency.referee.extras import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)  # the names stand in __init__.pyi
