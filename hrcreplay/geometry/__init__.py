"""Convex hulls, support polytopes, distances and rotations. Pure functions, independent of person and robot."""
