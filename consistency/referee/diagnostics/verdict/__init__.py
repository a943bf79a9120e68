"""From a record to a verdict: the p values of all questions, their answers, and the place of a fault."""
