"""Statistics of filter consistency: arrays in, records out; needs numpy and scipy only.

Tables, plots and files do not belong here.
"""

from consistency.referee.diagnostics.coverage import coverage as coverage
from consistency.referee.diagnostics.equivalence import equivalence as equivalence
from consistency.referee.diagnostics.independence import independence as independence
from consistency.referee.diagnostics.nees import nees as nees
from consistency.referee.diagnostics.outliers import outliers as outliers
from consistency.referee.extras import lazy_names

# the names stand in __init__.pyi; each is loaded on first use, but for functions that are named as their modules are
__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
