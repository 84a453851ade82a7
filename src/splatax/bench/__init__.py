"""The project's own stopwatch: what each part of rendering and training costs.

scenes.py       what is drawn: procedural clouds of any size, splat files
operations.py   what is timed: projection, rasterizer, loss, Adam, the whole step
timing.py       how: all operations in turn, round after round
"""
