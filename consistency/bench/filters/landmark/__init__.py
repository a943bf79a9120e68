"""How a landmark is kept in the state, one file for each parametrisation."""
