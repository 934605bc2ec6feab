"""Offline runs: job, stages, followers of a programme, report."""
