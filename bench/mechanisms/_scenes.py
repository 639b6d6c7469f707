"""All mechanisms by name."""

from bench.mechanisms._planar import planar_scenes
from bench.mechanisms._spatial import spatial_scenes

SCENES = spatial_scenes() | planar_scenes()
