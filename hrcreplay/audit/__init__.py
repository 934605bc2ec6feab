"""Recorded people held against their predictions, and limits fitted to them. Imported by the commands alone."""
