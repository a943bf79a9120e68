"""Where the runs of a study are done: executors, which know nothing of runs."""
