"""Datagrams that somebody else sends, or a robot that is not well: what must never move a robot."""
