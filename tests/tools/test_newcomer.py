"""What a newcomer installs: the wheel holds all that runs, and the container has the versions of the lock."""

from __future__ import annotations

import re
import subprocess
import tomllib
import zipfile
from pathlib import Path

import pytest

from hrcreplay import __version__
from tests.tools import newcomer

ROOT = newcomer.ROOT


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return newcomer.build_wheel(tmp_path_factory.mktemp("wheel"))


def test_the_wheel_holds_every_file_of_the_package_and_the_demo(wheel: Path) -> None:
    tracked = subprocess.run(["git", "ls-files", "hrcreplay"], cwd=ROOT, capture_output=True, text=True, check=True)
    with zipfile.ZipFile(wheel) as file:
        held = {name: file.getinfo(name).file_size for name in file.namelist() if ".dist-info/" not in name}
    wanted = {name: (ROOT / name).stat().st_size for name in tracked.stdout.split() if (ROOT / name).exists()}
    demo = {
        f"hrcreplay/data/{name}": (ROOT / "datasets" / name).stat().st_size for name in ("demo.mcap", "demo_cell.toml")
    }
    assert wanted | demo == {name: held[name] for name in wanted | demo}


def test_the_installed_wheel_runs_without_the_checkout(wheel: Path, tmp_path: Path) -> None:
    program = newcomer.link_wheel(wheel, tmp_path / "env")
    version, _, _, plan, info = newcomer.use(program, tmp_path / "work", newcomer.SESSION)
    assert version == f"hrcreplay {__version__}\n"
    assert tomllib.loads(plan)["plan"]["method"] == "qp"
    assert '"has_task": true' in info
    with pytest.raises(subprocess.CalledProcessError):
        newcomer.use(program, tmp_path / "again", ((("report", "none.mcap"), ()),))


def test_the_container_pins_every_library_as_the_lock_does(tmp_path: Path) -> None:
    (line,) = (line for line in (ROOT / "Dockerfile").read_text().splitlines() if line.startswith("RUN grep"))
    command = line.removeprefix("RUN ").replace("/wheel/versions.txt", str(tmp_path / "versions.txt"))
    subprocess.run(["bash", "-c", command], cwd=ROOT, check=True)
    rows = [row.split("==") for row in (tmp_path / "versions.txt").read_text().splitlines()]
    pinned = {name.replace(".", "-"): version for name, version in rows}
    for needed in tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]:
        name = re.split(r"[<>=\[]", needed)[0].replace(".", "-")
        assert re.match(r"[\w.]+$|[\w.]+ ;", pinned[name]), name


def test_the_container_has_a_python_that_the_project_takes() -> None:
    found = re.findall(r"^FROM python:(\d+\.\d+)-slim", (ROOT / "Dockerfile").read_text(), re.MULTILINE)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert len(found) == 2
    assert all(f"Programming Language :: Python :: {version}" in project["classifiers"] for version in found)
