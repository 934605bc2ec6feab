"""Reading of logs: any supported format as one lazy stream of records in order of time; importers; writer."""
