"""Comparison of a run with the recording: the recorded person, contact, and containment in swept volumes."""
