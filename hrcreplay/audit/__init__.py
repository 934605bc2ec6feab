"""Comparison of recorded people with the volumes predicted for them, and limit sets fitted to recordings."""

#: Defaults of a fit of limits: share of the ticks to cover, share of every log's time that is held back, and the kind
#: of coverage: joints in their intervals or limbs in their volumes.
COVERAGE, HELD_BACK, COVER = 0.99, 0.3, "limbs"
