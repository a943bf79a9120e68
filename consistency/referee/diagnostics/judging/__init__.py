"""From the tests of a record to its verdict: which faults were found, what they are called, and where they are."""
