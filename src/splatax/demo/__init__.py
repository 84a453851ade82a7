"""A small synthetic capture: an analytic still life, photographed by a ray caster.

shapes.py       intersections of rays and surfaces
still_life.py   the surfaces of the scene, and their textures
raycast.py      photos: light, shadow and highlight
capture.py      cameras around the scene, and a COLMAP model with exact poses and points
"""
