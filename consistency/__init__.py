"""The filter-consistency test bench: does an estimator tell the truth about its own uncertainty?"""

import lazy_loader

# the names stand in __init__.pyi; each is loaded on first use, so that `import consistency` and `--help` stay fast
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
