"""The HTML page of a run, with its 3-D replay."""
