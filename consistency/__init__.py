"""The filter-consistency test bench: do the errors of an estimator have the covariance that it states?"""

from consistency.doors import DOORS, open_doors
from consistency.referee.extras import lazy_names

open_doors()

# the names stand in __init__.pyi; each is loaded on first use, so that `import consistency` and `--help` stay fast
__getattr__, __dir__, __all__ = lazy_names(__name__, __file__, DOORS)
