"""What measures and fits, each ``python -m tests.tools.NAME --help``; the README's and docs' figures come from these."""
