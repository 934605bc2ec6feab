"""Offline runs: a job, its stages, the followers of a programme, the run folder."""
