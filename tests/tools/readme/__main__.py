"""Measures every figure of README and docs/validation.md, keeps them in docs/figures.json and writes them there.

python -m tests.tools.readme [NAME...]

What was measured with the same sources is taken from .readme/, so a run that was broken off goes on where it stood.
Without $HRCREPLAY_DATA the figures of others' recordings stay as they are. NAME: only those that begin so.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from hrcreplay.settings.listing import as_toml
from tests.tools.readme import reference
from tests.tools.readme.blocks import fill
from tests.tools.readme.measurements import ROOT, Measurement, load, measurements

FACTS = ROOT / "docs" / "figures.json"
PAGES = (ROOT / "README.md", ROOT / "docs" / "validation.md")
GUIDE = ROOT / "docs" / "guide.md"
REFERENCE = ROOT / "docs" / "reference.md"
PICTURE = ROOT / "reports" / "demo.png"
CACHE = ROOT / ".readme"

#: What no figure of the README rests on.
_LEFT_OUT = ("live", "egm", "cli.py", "cli_live.py", "progress.py", "options.py")
#: What the sampler rests on beside itself.
_SAMPLED = ("human", "limits", "records.py")


def main(arguments: list[str] | None = None) -> int:
    """Measures, and tells what was left as it was."""
    parser = argparse.ArgumentParser(prog="python -m tests.tools.readme", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="only the measurements whose names begin so")
    wanted = tuple(parser.parse_args(arguments).names)
    data = os.environ.get("HRCREPLAY_DATA")
    known = {measurement.name: measurement for measurement in measurements()}
    old = load(FACTS)
    facts = {name: old[name] for name in known if name in old}
    for name, measurement in known.items():
        if wanted and not name.startswith(wanted):
            continue
        if measurement.needs_data and not data:
            print(f"{name}: left as it was, for HRCREPLAY_DATA is not set")
            continue
        facts[name] = {"command": " && ".join(measurement.commands), "figures": _figures(measurement, data or "")}
        FACTS.write_text(json.dumps(facts, indent=1, sort_keys=True, ensure_ascii=False) + "\n")
    FACTS.write_text(json.dumps(facts, indent=1, sort_keys=True, ensure_ascii=False) + "\n")
    for page in PAGES:
        page.write_text(fill(page.read_text(), facts))
    GUIDE.write_text(with_settings(GUIDE.read_text()))
    REFERENCE.write_text(reference.fill(REFERENCE.read_text()))
    missing = [name for name in known if name not in facts]
    if missing:
        print(f"never measured, so the pages keep what they had: {', '.join(missing)}")
    return int(bool(missing))


def with_settings(guide: str) -> str:
    """The guide with all settings as they are now."""
    begin, end = "<!-- settings -->\n", "<!-- end of settings -->"
    before, after = guide.index(begin) + len(begin), guide.index(end)
    return f"{guide[:before]}```toml\n{as_toml()}```\n{guide[after:]}"


def _figures(measurement: Measurement, data: str) -> dict[str, Any]:
    """The figures of a measurement, from .readme/ where the same sources made them before."""
    key = hashlib.sha256(
        repr((measurement.commands, sorted(measurement.files.items()), _sources(measurement))).encode()
    )
    kept = CACHE / f"{key.hexdigest()[:32]}.json"
    picture = kept.with_suffix(".png")
    if not kept.exists() or (measurement.picture and not picture.exists()):
        began = time.monotonic()
        CACHE.mkdir(exist_ok=True)
        kept.write_text(json.dumps(_measure(measurement, data, picture)))
        print(f"{measurement.name}: {time.monotonic() - began:.0f} s", flush=True)
    if measurement.picture:
        shutil.copyfile(picture, PICTURE)
    return measurement.keep(json.loads(kept.read_text()))


def _measure(measurement: Measurement, data: str, picture: Path) -> Any:
    with tempfile.TemporaryDirectory(prefix="hrcreplay-readme-") as tmp:
        for name, text in measurement.files.items():
            (Path(tmp) / name).write_text(text)
        for command in measurement.commands:
            words = [word.format(tmp=tmp, data=data) for word in shlex.split(command)]
            done = subprocess.run([sys.executable, "-m", *words], cwd=ROOT, check=False, capture_output=True, text=True)
            if done.returncode:
                raise SystemExit(f"{measurement.name}: {shlex.join(words)}\n{done.stderr}")
        if measurement.picture:
            shutil.copyfile(Path(tmp) / measurement.picture, picture)
        text = (Path(tmp) / measurement.result).read_text() if measurement.result else done.stdout
    return json.loads(text)


def _sources(measurement: Measurement) -> str:
    """Digest of the sources that a measurement rests on, the lock of their versions included."""
    package = ROOT / "hrcreplay"
    if measurement.sampled:
        paths = [
            *(path for name in _SAMPLED for path in _files(package / name)),
            *_files(ROOT / "tests" / "tools" / "soundness"),
        ]
    else:
        paths = [path for path in _files(package) if path.relative_to(package).parts[0] not in _LEFT_OUT]
        paths.append(ROOT / "datasets" / "demo.mcap")
    digest = hashlib.sha256()
    for path in sorted([*paths, ROOT / "requirements.lock"]):
        digest.update(f"{path.relative_to(ROOT)}\0{hashlib.sha256(path.read_bytes()).hexdigest()}\n".encode())
    return digest.hexdigest()


def _files(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    return [p for p in path.rglob("*") if p.is_file() and "__pycache__" not in p.parts]


if __name__ == "__main__":
    sys.exit(main())
