"""The control process of a live session: receive a packet, answer it, update the perception of the person."""
