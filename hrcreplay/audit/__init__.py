"""Comparison of recorded people with the volumes predicted for them, and limit sets fitted to recordings."""

#: What a fit of limits is to reach where nothing else is asked for: share of the ticks that is covered, share of every
#: log's time that is not fitted to, and what is covered, joints in their intervals or limbs in their volumes.
COVERAGE, HELD_BACK, COVER = 0.99, 0.3, "limbs"
