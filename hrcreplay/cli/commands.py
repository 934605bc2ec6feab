"""What all commands of the command line share: examples in their help, --quiet and --verbose, and Ctrl-C.

Only public parts of typer are used: a command's function gets two more options, and a wrapper reads them.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import inspect
import io
import json
import os
import platform
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, get_type_hints

import typer

from hrcreplay.errors import EXIT_INTERRUPTED, SettingsError
from hrcreplay.version import __version__

#: glibc's limit for arrays that go back when they are freed; by itself it grows with them. A lower one costs time.
_MMAP, _M_MMAP_THRESHOLD, _LARGE_BYTES = "MALLOC_MMAP_THRESHOLD_", -3, 1_000_000

#: How the modules begin whose functions compiled code calls, those of named tuples included; and the time after which
#: a signal that came in one of them comes again [s].
_CALLED_BY_KERNELS, _AGAIN_S = ("numba", "llvmlite", "ctypes", "namedtuple_"), 0.005

#: Command -> calls that its help shows.
EXAMPLES: dict[str, tuple[str, ...]] = {
    "info": ("hrcreplay info session.mcap", "hrcreplay info session.mcap --json > session.json"),
    "import": (
        "hrcreplay import azure left=a.csv right=b.csv --out session.mcap",
        "hrcreplay import table people.csv --mapping columns.toml --out session.mcap",
    ),
    "calibrate": ("hrcreplay calibrate session.mcap --out cell.toml --base 1.2,0,0.65,180",),
    "fuse": ("hrcreplay fuse session.mcap --cell cell.toml",),
    "predict": ("hrcreplay predict session.mcap --cell cell.toml --limits people",),
    "plan": ("hrcreplay plan session.mcap --cell cell.toml --set plan.task=task.toml",),
    "report": (
        "hrcreplay report session.mcap --cell cell.toml --set plan.task=task.toml",
        "hrcreplay report reports/session/RUN --snapshot 12.5 --out still.png",
        "hrcreplay report reports/session/RUN --figure 14",
        "hrcreplay report reports/session/RUN --movie --out worst.mp4",
        "hrcreplay report reports/session/RUN --pdf --out safety-file.pdf",
    ),
    "compare": (
        "hrcreplay compare session.mcap --cell cell.toml --out compared",
        "hrcreplay compare monday.mcap tuesday.mcap --methods none,pfl,qp,qp:paper:fixed",
    ),
    "why": ("hrcreplay why reports/session/RUN --at 46", "hrcreplay why reports/session/RUN --at 46 --method scaling"),
    "audit": ("hrcreplay audit session.mcap --cell cell.toml",),
    "fit-limits": ("hrcreplay fit-limits monday.mcap tuesday.mcap --out ours.toml",),
    "warmup": ("hrcreplay warmup",),
    "bench": ("hrcreplay bench", "hrcreplay bench session.mcap --cell cell.toml --json > bench.json"),
    "sweep": (
        "hrcreplay sweep monday.mcap tuesday.mcap --grid plan.method=qp,scaling --grid plan.clearance_m=0,0.05",
        "hrcreplay sweep s3://logs/monday.mcap --base 1.2,0,0,180 --base 1.5,0,0,180 --scheduler tcp://host:8786",
    ),
    "init": ("hrcreplay init new",),
    "settings": ("hrcreplay settings", "hrcreplay settings plan > settings.toml"),
    "demo": ("hrcreplay demo --out demo",),
    "live": ("hrcreplay live --human session.mcap --send --duration 20 --out rehearsal",),
    "twin": ("hrcreplay twin --duration 30",),
    "verify": ("hrcreplay verify rehearsal",),
}

Quiet = Annotated[
    bool, typer.Option("--quiet", "-q", help="Print the result and errors only: no notes, tables and progress.")
]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Also print versions, and the time of every stage.")]

_VERBOSE: ContextVar[bool] = ContextVar("verbose", default=False)


class App(typer.Typer):
    """A command line whose commands all have an example in their help, --quiet and --verbose."""

    def command(self, name: str | None = None, **options: Any) -> Callable[[Any], Any]:
        """Registers a function as a command, as ``typer.Typer.command`` does.

        Args:
            name: Name of the command; None: that of the function.
            **options: As ``typer.Typer.command`` takes them.
        """

        def register(function: Callable[..., Any]) -> Callable[..., Any]:
            called = name or function.__name__.replace("_", "-")
            examples = EXAMPLES.get(called, ())
            told = {"epilog": "\n\n".join([f"Example{'s' * (len(examples) > 1)}:", *examples])} if examples else {}
            super(App, self).command(name, **(told | options))(_with_messages(function))
            return function

        return register


def _with_messages(function: Callable[..., Any]) -> Callable[..., Any]:
    """Returns a command's function with the two options for its messages, which also says that it was interrupted."""
    hints = {**get_type_hints(function, include_extras=True), "quiet": Quiet, "verbose": Verbose}

    @functools.wraps(function)
    def run(*, quiet: bool, verbose: bool, **arguments: Any) -> Any:
        if quiet and verbose:
            raise SettingsError("--quiet, --verbose: found both; would be right: one of them")
        with interruptible(), _messages(quiet=quiet, verbose=verbose):
            return function(**arguments)

    more = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=False, annotation=hints[name])
        for name in ("quiet", "verbose")
    ]
    own = [part.replace(annotation=hints[part.name]) for part in inspect.signature(function).parameters.values()]
    run.__signature__ = inspect.Signature([*own, *more])  # type: ignore[attr-defined]
    run.__annotations__ = hints
    return run


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Says 'interrupted' at Ctrl-C instead of a traceback, and exits as shells expect it."""
    own = threading.current_thread() is threading.main_thread() and (
        signal.getsignal(signal.SIGINT) is signal.default_int_handler
    )
    try:
        if own:
            signal.signal(signal.SIGINT, interrupt)
        yield
    except KeyboardInterrupt:
        sys.stderr.write("hrcreplay: interrupted\n")
        sys.exit(EXIT_INTERRUPTED)
    finally:
        if own:
            signal.signal(signal.SIGINT, signal.default_int_handler)


def interrupt(number: int, frame: FrameType | None) -> None:
    """Raises KeyboardInterrupt, but not in Python functions that compiled code calls: it would be lost, or a crash.

    Kernels are loaded by callbacks, and convert their results by such functions. Then the signal comes again a little
    later.

    Raises:
        KeyboardInterrupt: No such function is under way.
    """
    while frame is not None and (name := str(frame.f_globals.get("__name__"))).partition(".")[0] != "hrcreplay":
        if name.startswith(_CALLED_BY_KERNELS):
            main = threading.main_thread().ident
            threading.Timer(_AGAIN_S, signal.pthread_kill, (main, number)).start()
            return
        frame = frame.f_back
    raise KeyboardInterrupt


@contextlib.contextmanager
def _messages(*, quiet: bool, verbose: bool) -> Iterator[None]:
    """Leaves out all messages on standard error, or adds versions and the duration. Errors are shown always."""
    if quiet:
        with contextlib.redirect_stderr(io.StringIO()):
            yield
        return
    before, began_s = _VERBOSE.set(verbose), time.perf_counter()
    try:
        if verbose:
            tell(f"version {__version__}, Python {platform.python_version()}, {platform.platform()}")
        yield
        if verbose:
            tell(f"took {time.perf_counter() - began_s:.1f} s")
    finally:
        _VERBOSE.reset(before)


def completion(values: Sequence[str]) -> Callable[[str], list[str]]:
    """Returns what a shell offers for a word that has only these values."""
    return lambda incomplete: [value for value in values if value.startswith(incomplete)]


def tell(note: str) -> None:
    """Prints a note on standard error, separate from the result on standard output."""
    sys.stderr.write(f"hrcreplay: {note}\n")


def give_back_memory() -> None:
    """Lets this process and those that it starts return large arrays to the system as soon as they are freed.

    glibc and Arrow keep such memory for later otherwise: a fifth of the most that a report of ten minutes has. An
    allocator that the user chose in the environment stays.
    """
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
    if _MMAP not in os.environ and platform.libc_ver()[0] == "glibc":
        os.environ[_MMAP] = str(_LARGE_BYTES)  # read by a process when it starts
        ctypes.CDLL(None).mallopt(_M_MMAP_THRESHOLD, _LARGE_BYTES)


def print_run(folder: Path, shown: Path | None = None) -> None:
    """Prints the run folder that a command made on standard output; verbose: also the time of its stages.

    Args:
        folder: Run folder.
        shown: Path to print instead, in that folder; None: the folder.
    """
    timing = folder / "timing.json"
    if _VERBOSE.get() and timing.is_file():
        for stage, took in sorted(json.loads(timing.read_text()).items()):
            if isinstance(took, dict) and "median_us" in took:
                each = f"{took['median_us']:.0f} us each (median), {took['max_us']:.0f} us at most"
                tell(f"{stage}: {took['ticks']} ticks, {each}")
    sys.stdout.write(f"{shown or folder}\n")
