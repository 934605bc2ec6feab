"""A simulated robot controller for EGM sessions, with injected faults and a report of the received messages."""
