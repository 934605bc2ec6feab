"""Convex hulls, support polytopes, distances, rotations and a QP solver. Knows no person and no robot. Pure."""
