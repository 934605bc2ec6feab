"""Runs a command on a spoilt log in this process, and says what of it was not as it must be."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pyarrow.parquet as pq

import hrcreplay
from hrcreplay.cli import app
from hrcreplay.live import session
from hrcreplay.records import JOINTS
from hrcreplay.store import run_folder
from tests.live.sessions import PATIENT, children
from tests.tools.fuzz.clip import CAMERAS, Clip, write
from tests.tools.fuzz.spoil import spoilt

PACKAGE = Path(hrcreplay.__file__).parent
OFFLINE = ("fuse", "audit", "report")
LIVE = "live"

#: Where the robot double of live sessions calls; 0 without one.
PORT = "HRCREPLAY_FUZZ_PORT"

#: A live session's settings: nobody waits for an approach at a tenth of the speed.
_SETTINGS = (*PATIENT, "live.approach_speed=1.0", "prediction.method=paper", "limits.prediction=paper")
_SECONDS = 0.8
_LEAST = 4  # frames of a camera that is clean, from which there must be a state


@dataclass
class Trial:
    """A command on the log of a seed."""

    number: int
    command: str
    told: list[str]  #: what was spoilt
    code: int = 0
    err: str = ""
    wrong: list[str] = field(default_factory=list)
    warned: list[str] = field(default_factory=list)  #: what Python had to remark, which a user sees too

    def __str__(self) -> str:
        """What is wrong, and with what log."""
        return f"seed {self.number}, {self.command} ({', '.join(self.told)}): {'; '.join(self.wrong)}"


def trial(number: int, command: str, keep: Path | None = None) -> Trial:
    """The command on the log of a seed.

    Args:
        number: Seed of the log.
        command: One of OFFLINE, or LIVE.
        keep: Folder for the logs of trials that failed.
    """
    made = spoilt(number)
    found = Trial(number, command, made.told)
    folder = Path(tempfile.mkdtemp(prefix="hrcreplay-fuzz-"))
    try:
        log, out = write(made, folder / "log.mcap"), folder / "out"
        _run(found, _words(command, log, out), folder)
        _judge(found, made, out)
        if found.wrong and keep is not None:
            keep.mkdir(parents=True, exist_ok=True)
            shutil.copy(log, keep / f"{number}.mcap")
            (keep / f"{number}-{command}.txt").write_text(f"{found}\n\n{found.err}")
    finally:
        shutil.rmtree(folder)
    return found


def _words(command: str, log: Path, out: Path) -> list[str]:
    if command != LIVE:
        return [command, str(log), "--out", str(out)]
    port = os.environ.get(PORT, "0")
    words = ["live", "--human", str(log), "--repeat", "--duration", str(_SECONDS), "--json", "--send", "--port", port]
    return [*words, "--out", str(out), *(word for setting in _SETTINGS for word in ("--set", setting))]


def _run(found: Trial, words: list[str], folder: Path) -> None:
    with (
        mock.patch.object(sys, "argv", ["hrcreplay", *words]),
        mock.patch.object(session, "compile_kernels"),  # the kernels are warm after the first
        warnings.catch_warnings(record=True) as remarks,
        _captured(folder / "stderr") as captured,
    ):
        warnings.simplefilter("always")
        try:
            app.main()
        except SystemExit as left:
            found.code = left.code if isinstance(left.code, int) else 1
            if found.code == 128 + signal.SIGTERM:
                raise  # it is the fuzzer that is to end
        except BaseException:  # whatever it is
            found.code = 1
            captured.append(traceback.format_exc())
    found.err = (folder / "stderr").read_text(errors="replace") + "".join(captured)
    found.warned = sorted({f"{remark.category.__name__}: {remark.message}" for remark in remarks})


@contextmanager
def _captured(path: Path) -> Iterator[list[str]]:
    """What this process and its children say, in a file; the command's own output, nowhere."""
    sys.stdout.flush()
    sys.stderr.flush()
    before = os.dup(1), os.dup(2)
    with path.open("wb") as file, Path(os.devnull).open("wb") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        os.dup2(file.fileno(), 2)
        streams = sys.stdout, sys.stderr
        sys.stdout, sys.stderr = os.fdopen(os.dup(1), "w"), os.fdopen(os.dup(2), "w")
        try:
            yield []
        finally:
            for stream in (sys.stdout, sys.stderr):
                stream.close()
            sys.stdout, sys.stderr = streams
            for number, there in zip((1, 2), before, strict=True):
                os.dup2(there, number)
                os.close(there)


def _judge(found: Trial, made: Clip, out: Path) -> None:
    """Fills in what is wrong."""
    allowed = (0, 2, 3, 4) if found.command == LIVE else (0, 2, 3)
    if found.code not in allowed:
        found.wrong.append(f"exit code {found.code}")
    if "Traceback" in found.err:
        found.wrong.append(_last(found.err))
    beside = {path.name for path in out.parent.iterdir()} - {"log.mcap", "stderr", out.name}
    if beside:
        found.wrong.append(f"left behind: {sorted(beside)}")
    if found.code in (2, 3):
        lines = [line for line in found.err.splitlines() if line.strip()]
        if not any(re.match(r"hrcreplay: \S", line) for line in lines):
            found.wrong.append(f"no line that says why: {lines[-1:]}")
        if out.exists():
            found.wrong.append("a run folder in spite of the error")
    if found.code in (0, 4):
        found.wrong += _incomplete(out)
    if found.code == 0 and found.command == "fuse" and (out / "state.parquet").exists():
        found.wrong += _not_finite(out, made)
    if found.command == LIVE and children(os.getpid()):
        found.wrong.append("helpers are left")


def _last(err: str) -> str:
    """The exception, and where in our code it arose."""
    lines = err.rstrip().splitlines()
    places = re.findall(rf'"{re.escape(str(PACKAGE))}/(\S+\.py)", line (\d+)', err)
    where = "{}:{}".format(*places[-1]) if places else "?"
    return f"traceback: {lines[-1]} ({where})"


def _incomplete(out: Path) -> list[str]:
    """What a finished run lacks."""
    if not (out / "run.json").exists():
        return ["no run.json"]
    meta: dict[str, Any] = json.loads((out / "run.json").read_text())
    if not meta.get("complete"):
        return [f"not complete: {meta.get('crashes')}"]
    damaged = [name for name, digest in meta["outputs"].items() if run_folder.sha256(out / name) != digest]
    return [f"not as the run left it: {damaged}"] if damaged else []


def _not_finite(out: Path, made: Clip) -> list[str]:
    """States that are not finite, where some camera was left as it was."""
    table = pq.read_table(out / "state.parquet").to_pandas()
    numbers = table[[name + ending for name in JOINTS for ending in ("", "_vel", "_acc", "_jerk")]].to_numpy()
    wrong = ["an infinite state"] if np.isinf(numbers).any() else []
    clean = [name for name in CAMERAS if name not in made.touched]
    seen = [name for name in clean if sum(frame.camera == name for frame in made.frames) >= _LEAST]
    base = table.loc[table["t_ns"] == table["t_ns"].max(), ["x", "y", "theta", "rho"]].to_numpy()  # a row per person
    if seen and not np.isfinite(base).all(axis=1).any():
        wrong.append(f"no state at the end although {seen} are as they were: {base}")
    return wrong
