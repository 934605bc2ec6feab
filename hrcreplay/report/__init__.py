"""What a run shows: metrics, figures, page."""
