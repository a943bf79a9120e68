"""How many runs a verdict needs, and when runs may stop."""
