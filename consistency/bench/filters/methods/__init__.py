"""Compiled filters: a file for each method, with the parts that its kernel is made of."""
