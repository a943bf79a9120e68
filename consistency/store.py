"""Results and logs, in memory and in folders."""

from consistency.referee.extras import explained_import

with explained_import(__name__):
    from consistency.bench.store.recorded_log import Log, read_log, write_log
    from consistency.bench.store.results import Results, StoredResults, open_results, read_results

__all__ = ["Log", "Results", "StoredResults", "open_results", "read_log", "read_results", "write_log"]
