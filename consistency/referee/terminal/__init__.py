"""Progress of long work on a terminal; what is said there of results is rendered by ``show``."""
