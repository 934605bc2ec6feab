"""Commands from a log to a run folder: replay, compare, audit, report, explain."""
