"""Reading of logs: every supported format as one lazy stream of records in order of time; importers; writer."""
