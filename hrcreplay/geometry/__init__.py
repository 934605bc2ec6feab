"""Convex hulls, support polytopes, distances and rotations. Knows no person and no robot. Pure."""
