"""World frames and bodies that differ: `--align`, and what an alignment takes from the errors."""
