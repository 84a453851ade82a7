"""Reports of runs: pictures, curves and tables."""
