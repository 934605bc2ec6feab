"""A simulated session: a worker who is not the filter's model, two depth cameras, and a pick-and-place task."""
