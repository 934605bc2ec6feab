"""Tools that measure and fit; each answers ``python -m tests.tools.NAME --help``. Documents quote their figures."""
