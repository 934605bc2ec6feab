"""The control process of a live session: a packet, an answer, a look at the person."""
