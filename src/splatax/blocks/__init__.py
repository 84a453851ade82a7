"""Blocks of a scene that is too large for one run: a plan, runs of single blocks, and their merger."""
