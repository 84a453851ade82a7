"""Blocks of a scene that is too large for one run: the plan, the runs of single blocks, and their merging."""
