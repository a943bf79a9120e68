"""What the referee is given: the record, which covariances are valid, steps left out, whitened errors."""
