"""Lets the tests import the package ``cart``, which is not installed."""
