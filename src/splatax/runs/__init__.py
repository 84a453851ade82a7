"""Training runs: folders that are claimed, filled, interrupted, resumed and read again."""
