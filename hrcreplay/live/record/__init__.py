"""The record of a live session: the recorder's process, its messages, and the run folder made of them."""
