"""The run folder and its tables on disk."""
