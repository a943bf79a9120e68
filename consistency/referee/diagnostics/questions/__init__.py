"""The questions of a verdict, each a test in a file."""
