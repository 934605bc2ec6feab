"""Rewrites the golden text of the report page and the terminal: ``python -m tests.tools.golden``."""

from __future__ import annotations

import argparse
import sys

from tests.reporting.reading import GOLDEN, golden_text


def main(arguments: list[str] | None = None) -> int:
    """Accepts what page and terminal say now; ``--check`` only tells whether that differs, by exit code 1."""
    parser = argparse.ArgumentParser(prog="python -m tests.tools.golden", description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing; exit code 1 where the text differs")
    check = parser.parse_args(arguments).check
    now = golden_text()
    same = GOLDEN.is_file() and GOLDEN.read_text("utf-8") == now
    if not same and not check:
        GOLDEN.parent.mkdir(exist_ok=True)
        GOLDEN.write_text(now, "utf-8")
    sys.stdout.write(f"{GOLDEN}: {'as accepted' if same else 'differs' if check else 'rewritten'}\n")
    return int(check and not same)


if __name__ == "__main__":
    sys.exit(main())
