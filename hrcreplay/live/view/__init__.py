"""What a person sees of a live session: panel, JSON lines or Foxglove."""
