"""The built-in filters by name, and guards before them."""

from consistency.referee.extras import explained_import

with explained_import(__name__):
    from consistency.bench.filters import filter_names, filter_summaries, get_filter, usable_names
    from consistency.bench.filters.compiled import guarded

__all__ = ["filter_names", "filter_summaries", "get_filter", "guarded", "usable_names"]
