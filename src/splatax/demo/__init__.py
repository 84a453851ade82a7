"""Procedural capture: an analytic still life, photographed by a ray caster.

shapes.py       intersections of rays with surfaces
still_life.py   surfaces of the scene, and their textures
raycast.py      photos with light, shadows and highlights
dataset.py      cameras, photos and surface points, in memory
capture.py      the same on disk: photos, and a COLMAP model with exact poses and points
"""
