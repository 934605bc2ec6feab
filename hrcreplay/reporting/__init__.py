"""Reports of a run: metrics, figures, the HTML page, and the 3-D scene."""
