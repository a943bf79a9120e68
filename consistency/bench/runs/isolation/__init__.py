"""Filters that are not compiled, in processes that can be killed."""
