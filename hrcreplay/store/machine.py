"""Describes what changes the last bits of results: processor, instruction set, mathematical libraries.

BLAS, numpy's loops, the C library and numba each choose code by the processor at run time. So each run records its
machine, and a repeated run can distinguish the effect of another processor from another motion.
"""

from __future__ import annotations

import ctypes
import os
import platform
from pathlib import Path
from typing import Any

import numpy as np

#: Processor features by which these libraries choose their code.
FEATURES = frozenset({"sse4_2", "avx", "avx2", "fma", "fma4", "avx512f", "avx512dq", "avx512bw", "avx512vl", "sve"})
#: Variables that override the choice.
VARIABLES = (
    *("GLIBC_TUNABLES", "NPY_DISABLE_CPU_FEATURES", "NPY_ENABLE_CPU_FEATURES"),
    *("NUMBA_CPU_FEATURES", "NUMBA_CPU_NAME", "OPENBLAS_CORETYPE"),
)
#: Names of the OpenBLAS function that returns the kernels' name; they differ between the copies of numpy and scipy.
_CORE_NAMES = tuple(f"{before}openblas_get_corename{after}" for before in ("scipy_", "") for after in ("64_", "_", ""))


def describe_machine() -> dict[str, Any]:
    """Processor, instructions, BLAS, C library and the target of numba, as run.json has them."""
    from llvmlite import binding  # not needed to compare machines

    cpu, config = _cpu_information(), np.show_config(mode="dicts") or {}
    blas = config.get("Build Dependencies", {}).get("blas", {})
    simd = config.get("SIMD Extensions", {})
    return {
        "processor": cpu.get("model name") or platform.processor() or platform.machine(),
        "architecture": platform.machine(),
        "features": sorted(FEATURES & {*cpu.get("flags", cpu.get("Features", "")).split()}),
        "blas": {"library": blas.get("name"), "version": blas.get("version"), "core": _blas_core()},
        "numpy_simd": [*simd.get("baseline", ()), *simd.get("found", ())],
        "numba_target": os.environ.get("NUMBA_CPU_NAME") or binding.get_host_cpu_name(),
        "c_library": " ".join(platform.libc_ver()).strip(),
        "environment": {name: os.environ[name] for name in VARIABLES if name in os.environ},
    }


def name_machine(machine: dict[str, Any] | None) -> str:
    """Describes a machine in one line: processor, instructions, BLAS kernels, C library, and overriding variables."""
    if not machine:
        return "a processor that the record does not name"
    core, variables = machine.get("blas", {}).get("core"), machine.get("environment", {})
    parts = [
        " ".join(machine.get("features", ())),
        f"BLAS kernels {core}" if core else "",
        machine.get("c_library", ""),
        *(f"{name}={value}" for name, value in sorted(variables.items())),
    ]
    return f"{machine.get('processor')} ({'; '.join(part for part in parts if part)})"


def _cpu_information() -> dict[str, str]:
    """Linux's description of the first processor; empty on other systems."""
    try:
        text = Path("/proc/cpuinfo").read_text().partition("\n\n")[0]
    except OSError:
        return {}
    return {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in text.splitlines())}


def _blas_core() -> str:
    """Processor type of numpy's OpenBLAS kernels; empty for another library or if unavailable."""
    try:
        lines = Path("/proc/self/maps").read_text().splitlines()
    except OSError:
        return ""
    paths = sorted({line.split(maxsplit=5)[5] for line in lines if "openblas" in line.lower()})
    numpys = [path for path in paths if "numpy" in path]  # scipy may have another copy, loaded on demand
    return next((core for path in numpys or paths if (core := _ask_core(path))), "")


def _ask_core(path: str) -> str:
    try:
        library = ctypes.CDLL(path)  # already loaded in this process
    except OSError:
        return ""
    for name in _CORE_NAMES:
        ask = getattr(library, name, None)
        if ask is not None:
            ask.restype = ctypes.c_char_p
            return str((ask() or b"").decode())
    return ""
