"""Poses and clock offsets of cameras, the floor, and the cell file that keeps them."""
