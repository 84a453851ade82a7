"""Procedural captures: analytic scenes, photographed by a ray caster.

shapes.py       intersections of rays with surfaces
textures.py     colours of surfaces and skies
viewpoints.py   where the cameras stand
scene.py        record of a scene: surfaces, light, viewpoints
scenes/         one file a scene, and their registry
raycast.py      photos with light, shadows, highlights and mirrors; exact depth, normals and surfaces
dataset.py      cameras, photos and surface points, in memory
capture.py      the same on disk: photos, and a COLMAP model with exact poses and points
"""
