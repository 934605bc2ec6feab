"""Evaluation of a run: metrics, figures, HTML page."""
