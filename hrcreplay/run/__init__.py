"""Offline runs: job, stages, controllers, report."""
