"""``python -m hrcreplay``."""

from hrcreplay.cli import main

main()
