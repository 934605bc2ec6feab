"""Stages of a run, assembled from its configuration."""
