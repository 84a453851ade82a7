"""Benchmarks of each part of rendering and training.

scenes.py       the scenes: procedural ones of any size, and splat files
operations.py   the operations: projection, rasterizer, loss, Adam, a whole training step
timing.py       interleaved timing: all operations in turn, round after round
roofline.py     the time that the arithmetic of the rasterizer takes at the machine's measured peak
plot.py         time over the size of the scene, as a picture
"""
