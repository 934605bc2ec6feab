"""Displays of a live session: terminal panel, JSON lines and Foxglove."""
