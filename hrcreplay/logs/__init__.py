"""Files in: logs of any supported kind as one lazy, time-ordered stream of records."""
