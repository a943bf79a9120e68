"""Where f and h are linearised."""
