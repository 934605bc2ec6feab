"""The record of a live session: its messages, the process that writes them, and the run folder."""
