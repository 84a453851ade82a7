"""A run as people look at it: pictures, curves and tables."""
