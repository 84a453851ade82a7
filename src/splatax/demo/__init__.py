"""A small capture out of nothing: an analytic still life, photographed by a ray caster.

shapes.py       where a ray meets a surface
still_life.py   which surfaces, and their textures
raycast.py      light, shadow and highlight: a photo
dataset.py      cameras around it, photos and surface points, in memory
capture.py      the same on disk: photos, and a COLMAP model with exact poses and points
"""
