"""What a user types and reads: every bad input is one clear line, the right exit code, and nothing half-written."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import typer

from hrcreplay import __version__
from hrcreplay.cli import app
from hrcreplay.cli.commands import EXAMPLES
from hrcreplay.commands import replay
from tests.facts import tells
from tests.logs import own

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Run:
    """Runs the command line in an empty folder; gives exit code, stdout, stderr."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["hrcreplay", *map(str, arguments)])
        with pytest.raises(SystemExit) as left:
            app.main()
        out, err = capsys.readouterr()
        return int(left.value.code or 0), out, err

    return call


DEMO = replay.demo_log()
SHORT = ("--start", 8, "--end", 8.4)


def test_help_lists_every_command(run: Run) -> None:
    code, out, _ = run("--help")
    assert code == 0
    for command in (
        "info",
        "import",
        "calibrate",
        "fuse",
        "predict",
        "plan",
        "report",
        "audit",
        "fit-limits",
        "sweep",
        "demo",
    ):
        assert f" {command} " in out


def test_each_command_answers_h_with_an_example(run: Run) -> None:
    commands: Any = typer.main.get_command(app.app)
    assert set(EXAMPLES) == set(commands.commands)
    for name, command in commands.commands.items():
        code, out, _ = run(name, "-h")
        assert (code, out) == run(name, "--help")[:2]
        assert "--quiet" in out
        for example in EXAMPLES[name]:
            assert example in " ".join(out.split())
            program, called, *arguments = shlex.split(example.split(" > ")[0])
            assert (program, called) == ("hrcreplay", name)
            command.make_context(name, arguments)  # raises where an option or a value is none


def test_a_shell_completes_commands_options_and_values() -> None:
    as_program = "import sys; sys.argv = ['hrcreplay']\nfrom hrcreplay.cli.app import main\nmain()"

    def complete(words: str) -> list[str]:
        asked = {"_HRCREPLAY_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
        env = {**os.environ, **asked}
        program = [sys.executable, "-c", as_program]
        return subprocess.run(program, env=env, capture_output=True, text=True, check=False).stdout.split()

    assert complete("hrcreplay re") == ["report"]
    assert complete("hrcreplay report --chunk") == ["--chunk-ticks"]
    assert complete("hrcreplay import open") == ["openpose"]
    assert complete("hrcreplay report a.mcap --limits p") == ["paper", "people"]
    assert complete("hrcreplay settings fus") == ["fusion"]


def test_quiet_says_the_result_alone_and_errors_still(run: Run) -> None:
    assert run("fuse", DEMO, "--out", "here", *SHORT, "--quiet") == (0, "here\n", "")
    code, out, err = run("fuse", DEMO, "--out", "here", *SHORT, "-q")
    assert (code, out) == (2, "")
    assert tells(err, "here", "exists already")
    assert len(err.splitlines()) == 1


def test_verbose_adds_versions_and_the_time_of_the_stages(run: Run) -> None:
    _, _, usual = run("fuse", DEMO, "--out", "usual", *SHORT)
    code, out, err = run("fuse", DEMO, "--out", "here", *SHORT, "-v")
    assert (code, out) == (0, "here\n")
    lines = err.splitlines()
    assert usual.splitlines()[0] in lines
    assert tells([lines[0]], "version", __version__, "Python")
    timing = json.loads(Path("here/timing.json").read_text())
    assert any(f"fuse: {timing['fuse']['ticks']} ticks" in line for line in lines)
    assert lines[-1].startswith("hrcreplay: took ")
    code, _, err = run("fuse", DEMO, "-q", "-v")
    assert code == 2
    assert tells(err, "--quiet", "--verbose", "one of them")


def test_ctrl_c_says_interrupted_and_leaves_nothing(tmp_path: Path) -> None:
    arguments = [
        sys.executable,
        "-m",
        "hrcreplay",
        "fuse",
        str(DEMO),
        "--out",
        "deep/here",
        "--set",
        "fusion.rate_hz=1000",
    ]
    # compiled before: an interrupt inside the compiler can get lost in its finalizers
    subprocess.run([*arguments[:5], "--out", "warm", *arguments[7:], "--end", "7"], cwd=tmp_path, check=True)
    shutil.rmtree(tmp_path / "warm")
    child = subprocess.Popen(arguments, cwd=tmp_path, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    until = time.monotonic() + 120.0
    while not (tmp_path / "deep" / "here.partial").exists() and time.monotonic() < until:
        time.sleep(0.02)
    child.send_signal(signal.SIGINT)
    out, err = child.communicate(timeout=120)
    assert (child.returncode, out) == (130, "")
    assert err.splitlines()[-1] == "hrcreplay: interrupted"
    assert "Traceback" not in err
    assert list(tmp_path.iterdir()) == []


def test_version(run: Run) -> None:
    assert run("--version") == (0, f"hrcreplay {__version__}\n", "")


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; sys.argv = ['hrcreplay', '--help']\nfrom hrcreplay.cli.app import main\ntry:\n main()\nfinally:\n"
    )
    code += " heavy = {'numpy', 'pandas', 'numba', 'matplotlib', 'pydantic', 'pinocchio'} & set(sys.modules)\n"
    code += " sys.exit(3 if heavy else 0)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0


def test_figures_are_listed_with_what_a_run_lacks_for_them(run: Run) -> None:
    code, every, _ = run("report", "--list-figures")
    assert code == 0
    assert [line.split("  ")[0].strip() for line in every.splitlines()][:6] == ["5", "7, 8", "9", "13a", "13b", "14"]
    run("fuse", DEMO, "--out", "here", *SHORT)
    code, out, _ = run("report", "here", "--list-figures")
    assert code == 0
    state = {line[:17].strip(): line[93:] for line in out.splitlines()}
    assert state["18"] == "there"
    assert tells(state["14"], "lacks", "robot", "plan", "report")
    assert tells(state["9"], "lacks", "swept volumes", "predict", "plan", "report")
    assert tells(state["17"], "lacks", "person", "three seconds")
    code, out, err = run("report", "here", "--figure", 14)
    assert (code, out) == (2, "")
    assert tells(err, "--figure 14", "here", state["14"].removeprefix("lacks: "))
    code, out, _ = run("report", "here", "--figure", 18, "--out", "drawn")
    assert (code, out.split()) == (0, [f"drawn/fig18_coordinate.{suffix}" for suffix in ("png", "svg", "pdf")])
    code, _, err = run("report", "here", "--figure", 18, "--out", "drawn")
    assert code == 2
    assert tells(err, "drawn/fig18_coordinate.png", "exists")


def test_stdout_carries_only_the_run_folder(run: Run) -> None:
    code, out, err = run("fuse", DEMO, "--out", "here", *SHORT)
    assert (code, out) == (0, "here\n")
    assert err.startswith("hrcreplay: fuse: ")
    assert tells(err, "101 ticks", "kinect 13")
    assert len(err.splitlines()) == 1
    assert Path("here/state.parquet").exists()


def test_the_default_folder_is_under_reports(run: Run) -> None:
    code, out, _ = run("fuse", DEMO, *SHORT)
    assert code == 0
    assert out.startswith("reports/demo/")
    assert out.endswith("Z-fuse\n")
    assert (Path(out.strip()) / "run.json").exists()


CELL_WITHOUT_BASE = """
[cameras.kinect]
T_world_camera = [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]
"""
TASK_OUT_OF_REACH = """
[[waypoints]]
joints_deg = [0, 0, 0, 0, 90, 0]
[[waypoints]]
name = "the moon"
position_m = [3.0, 0.0, 0.5]
rpy_deg = [180, 0, 0]
"""

BAD: dict[str, tuple[tuple[object, ...], int, str]] = {
    "no log": (("fuse", "none.mcap"), 3, "none.mcap: nothing is there; give a log or a run folder"),
    "empty file": (("fuse", "empty.mcap"), 3, "empty.mcap: the log holds no messages (0 bytes)"),
    "no log at all": (("info", "text.bag"), 3, "text.bag: "),
    "unknown setting": (
        ("fuse", DEMO, "--set", "fusion.rate=3"),
        2,
        "fusion: unknown key 'rate'; known here: rate_hz",
    ),
    "unknown limit set": (("fuse", DEMO, "--set", "limits.tracking=robot"), 2, "robot: no limit set"),
    "settings file missing": (("fuse", DEMO, "--config", "none.toml"), 2, "none.toml: cannot be read"),
    "cell missing": (("fuse", DEMO, "--cell", "none.toml"), 2, "none.toml: cannot be read"),
    "cell of another log": (("fuse", DEMO, "--cell", "other.toml"), 2, "camera third is not in the log"),
    "out exists": (("fuse", DEMO, "--out", "taken"), 2, "taken: exists already; name another folder with --out"),
    "out below a file": (("fuse", DEMO, "--out", "empty.mcap/run"), 2, "empty.mcap/run: cannot be made"),
    "task out of reach": (
        ("plan", DEMO, "--set", "plan.task=moon.toml", *SHORT),
        2,
        "moon.toml: waypoint 2 (the moon)",
    ),
    "task missing": (("plan", DEMO, "--set", "plan.task=none.toml"), 2, "none.toml: cannot be read"),
    "urdf missing": (("plan", DEMO, "--set", "robot.urdf=none.urdf"), 2, "none.urdf is not a file"),
    "end before start": (("fuse", DEMO, "--start", 5, "--end", 4), 2, "--end 4: not after --start 5"),
    "span outside": (("fuse", DEMO, "--start", 90), 2, "nothing of the log is left; it lasts 60.0 s"),
    "start is no number": (("fuse", DEMO, "--start", "nan"), 2, "--start nan: would be right: seconds from the log's"),
    "end is endless": (("report", DEMO, "--end", "inf"), 2, "--end inf: would be right: seconds from the log's start"),
    "text for a log": (
        ("info", "people.csv"),
        3,
        "hrcreplay import azure|kinect2|keraal|table|mediapipe|optitrack people.csv --out LOG.mcap",
    ),
    "calibrate height": (
        ("calibrate", DEMO, "--out", "c.toml", "--height", "nan"),
        2,
        "--height nan: would be right: metres above the floor, 0 or more",
    ),
    "calibrate below the floor": (("calibrate", DEMO, "--out", "c.toml", "--height", -1), 2, "--height -1: would be"),
    "unknown topic": (("fuse", DEMO, "--topic", "/nose"), 3, "/nose"),
    "unknown kind": (("import", "xbox", "a.csv", "--out", "a.mcap"), 2, "found 'xbox'; would be right: azure"),
    "camera twice": (
        ("import", "azure", "a=x.csv", "a=y.csv", "--out", "a.mcap"),
        2,
        "camera a is given twice",
    ),
    "import out exists": (("import", "azure", "a=text.bag", "--out", "empty.mcap"), 2, "empty.mcap: exists already"),
    "import not the format": (("import", "azure", "a=text.bag", "--out", "a.mcap"), 3, "text.bag"),
    "calibrate out exists": (("calibrate", DEMO, "--out", "other.toml"), 2, "other.toml: exists already"),
    "calibrate up": (("calibrate", DEMO, "--out", "c.toml", "--up", "sky"), 2, "--up sky: would be right: 3 numbers"),
    "calibrate reference": (("calibrate", DEMO, "--out", "c.toml", "--reference", "eye"), 2, "found 'eye'"),
    "figure that there is not": (
        ("report", DEMO, "--figure", 12),
        2,
        "--figure 12: no such figure; there are 5, 7, 8, 9, 13a, 13b, 14, 15, 16, 17, 18, horizon, volume_horizon,",
    ),
    "figure of a log": (("report", DEMO, "--figure", "14"), 2, "is no run folder; make one with: hrcreplay report"),
    "two parts of a report": (("report", DEMO, "--movie", "--pdf"), 2, "report: "),
    "figures of a log": (("report", DEMO, "--list-figures"), 2, "--list-figures: "),
    "nothing to report on": (("report",), 2, "report: found neither log nor run folder; give one"),
    "not a run folder": (("report", "taken"), 3, "taken"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line_and_leaves_nothing(run: Run, tmp_path: Path, case: str) -> None:
    Path("empty.mcap").touch()
    Path("text.bag").write_text("not a bag\n" * 20)
    Path("people.csv").write_text("timestamp;body_idx;PELVIS (c)\n1;2;3\n")
    Path("taken").mkdir()
    Path("other.toml").write_text(CELL_WITHOUT_BASE.replace("kinect", "third"))
    Path("moon.toml").write_text(TASK_OUT_OF_REACH)
    before = sorted(tmp_path.rglob("*"))
    arguments, code, message = BAD[case]
    found, out, err = run(*arguments)
    assert found == code, err
    assert out == ""
    assert err.startswith("hrcreplay: ")
    assert message in err
    assert len(err.strip().splitlines()) <= 2
    assert sorted(tmp_path.rglob("*")) == before


def test_a_log_without_extrinsics_says_how_to_get_them(run: Run) -> None:
    own.write(Path("unposed.mcap"), own.frames())
    code, _, err = run("fuse", "unposed.mcap")
    assert code == 3
    assert tells(err, "hrcreplay calibrate unposed.mcap --out cell.toml", "--cell cell.toml")


def test_a_run_that_did_not_end_is_refused(run: Run) -> None:
    Path("half").mkdir()
    Path("half/run.json").write_text('{"complete": false}')
    code, _, err = run("report", "half")
    assert code == 2
    assert tells(err, "half", "complete", "run it again")


def test_info_tells_what_the_demo_holds(run: Run) -> None:
    code, out, _ = run("info", DEMO)
    assert code == 0
    assert "kinect: 1563 frames at 29.98 Hz" in out
    assert "task     in the log" in out


def test_info_as_json_holds_the_numbers_of_the_text(run: Run) -> None:
    code, out, _ = run("info", DEMO, "--json")
    assert code == 0
    found, (_, text, _) = json.loads(out), run("info", DEMO)
    assert found["path"] == str(DEMO)
    assert found["has_task"]
    assert f"span     {found['span_s']:.3f} s" in text
    for camera in found["cameras"]:
        assert f"{camera['name']}: {camera['frames']} frames at {camera['rate_hz']:.2f} Hz" in text
    kinect, topics = found["cameras"][0], {topic["name"]: topic["messages"] for topic in found["topics"]}
    assert topics[f"/camera/{kinect['name']}/skeleton"] >= kinect["frames"] == 1563
    assert found["missing"] == []


def test_the_values_that_a_shell_offers_are_those_that_there_are() -> None:
    from hrcreplay.commands.inputs import _OWN_KINDS
    from hrcreplay.logs.formats import FORMATS
    from hrcreplay.settings.load import Settings

    assert set(app.KINDS) == {*_OWN_KINDS, *FORMATS}
    assert list(app.SECTIONS) == list(Settings.model_fields)
