"""Clouds larger than memory: cut into tiles on disk, worked on tile by tile.

Whole and tiled work give the same points: a tile is a node of the filter's own octree, so no voxel
lies in two of them, and what a filter must know of the whole cloud is found in passes over it.
"""
