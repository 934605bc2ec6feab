"""What run.json says of the machine, against other programs that tell of it, and with other kernels chosen."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys

import numpy as np
import pytest

from hrcreplay.store.machine import VARIABLES, describe_machine, name_machine

_TELL = "import json; from hrcreplay.store.machine import describe_machine; print(json.dumps(describe_machine()))"


def _elsewhere(**chosen: str) -> dict[str, object]:
    environment = {name: value for name, value in os.environ.items() if name not in VARIABLES}
    told = subprocess.run(
        [sys.executable, "-c", _TELL], env=environment | chosen, capture_output=True, text=True, check=True
    )
    found: dict[str, object] = json.loads(told.stdout)
    return found


def test_another_process_on_this_machine_says_the_same() -> None:
    chosen = {name: os.environ[name] for name in VARIABLES if name in os.environ}
    here = describe_machine()
    assert _elsewhere(**chosen) == here
    assert here["architecture"] == platform.machine()
    assert json.loads(json.dumps(here)) == here


@pytest.mark.skipif(not describe_machine()["blas"]["core"], reason="this BLAS does not choose its kernels by a name")
def test_other_blas_kernels_are_told() -> None:
    for core in ("Nehalem", "Sandybridge"):
        found = _elsewhere(OPENBLAS_CORETYPE=core)
        assert found["blas"] == describe_machine()["blas"] | {"core": core}
        assert found["environment"] == {"OPENBLAS_CORETYPE": core}
        assert f"BLAS kernels {core}" in name_machine(found)


def test_other_loops_of_numpy_are_told() -> None:
    found = (np.show_config(mode="dicts") or {})["SIMD Extensions"].get("found", [])
    if not found:
        pytest.skip("this processor has nothing beyond numpy's baseline")
    without = _elsewhere(NPY_DISABLE_CPU_FEATURES=" ".join(found))["numpy_simd"]
    assert set(describe_machine()["numpy_simd"]) - set(without) == set(found)  # type: ignore[call-overload]


def test_a_record_without_a_machine_says_so() -> None:
    assert "does not name" in name_machine(None)
