"""``python -m hrcreplay``."""

from hrcreplay.cli.app import main

main()
