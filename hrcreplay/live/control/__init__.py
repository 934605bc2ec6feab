"""The control process of a live session: receives a packet, answers it, updates the perception of the person."""
