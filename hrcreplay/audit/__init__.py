"""Comparison of recorded people with the volumes predicted for them, and limit sets fitted to recordings."""
