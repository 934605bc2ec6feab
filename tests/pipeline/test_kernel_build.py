"""Kernels are compiled by two processes at once into one folder, and a command tells what it waits for."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from numba.core.caching import IndexDataCacheFile

from hrcreplay import kernels
from hrcreplay.pipeline import kernel_build, progress
from hrcreplay.pipeline.progress import ProgressBar

MODULE = """
from hrcreplay.kernels import njit
@njit(cache=True)
def double(x):
    return x + x
"""


def _compile(folder: str, value: object, together: Any) -> None:
    """Compiles one version of a kernel in a process of its own, and takes its time between reading and writing."""
    sys.path.insert(0, folder)
    import tried  # type: ignore[import-not-found]

    save = IndexDataCacheFile._save_index

    def save_slowly(self: Any, overloads: Any) -> None:
        time.sleep(0.5)
        save(self, overloads)

    IndexDataCacheFile._save_index = save_slowly
    together.wait()
    tried.double(value)


def test_versions_that_processes_compile_at_once_are_all_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a lock on the index the versions of two processes got the same file."""
    (tmp_path / "tried.py").write_text(MODULE)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kept"))
    (tmp_path / "kept").mkdir()
    values = [1, 1.5, 2j, (1, 2), (1.5, 2), (1, 2.5)]
    context = multiprocessing.get_context("spawn")
    together = context.Barrier(len(values))
    processes = [context.Process(target=_compile, args=(str(tmp_path), value, together)) for value in values]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert all(process.exitcode == 0 for process in processes)
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import tried\n"
    code += f"for value in {values!r}: assert tried.double(value) == value + value\n"
    code += "assert sum(tried.double.stats.cache_hits.values()) == 6 and not tried.double.stats.cache_misses"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_second_command_finds_the_kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[object] = []

    def compile_nothing(bar: object) -> str:
        calls.append(bar)
        return ""

    monkeypatch.delenv("HRCREPLAY_COMPILING", raising=False)
    monkeypatch.setattr(kernels, "folder", lambda: tmp_path)
    monkeypatch.setattr(kernel_build, "_compile", compile_nothing)
    assert kernel_build.ensure_compiled()
    assert kernel_build.ensure_compiled()
    assert len(calls) == 1


def test_a_process_that_fails_is_told_and_stops_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("HRCREPLAY_COMPILING", raising=False)
    monkeypatch.setattr(kernels, "folder", lambda: tmp_path)
    monkeypatch.setattr(kernel_build, "PARTS", ("no such part",))
    assert not kernel_build.ensure_compiled()
    assert "no such part" in capsys.readouterr().err
    assert not list(tmp_path.glob("compiled-*"))


def test_a_process_that_compiles_does_not_start_others(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(kernels, "folder", lambda: tmp_path)
    monkeypatch.setenv("HRCREPLAY_COMPILING", "robot")
    monkeypatch.setattr(kernel_build, "_compile", lambda _: os.abort())
    assert kernel_build.ensure_compiled()


def test_without_a_terminal_progress_is_a_line_now_and_then(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "_LOOK_S", 0.01)
    began_s = time.monotonic()
    with ProgressBar("reading", every_s=0.05) as bar:
        time.sleep(0.2)
        bar.begin("plan", 15_000)
        bar.advance("fuse", 7_000)  # of another part
        bar.advance("plan", 6_000)
        time.sleep(0.2)
        bar.begin("figures", 12)
        bar.advance("figures")
        time.sleep(0.2)
    lines = capsys.readouterr().err.splitlines()
    told = {line.removeprefix("hrcreplay: ").rpartition(",")[0] for line in lines}
    assert {"reading", "plan: 40 %", "figures: 1 of 12"} <= told
    assert len(lines) <= (time.monotonic() - began_s) / 0.05
