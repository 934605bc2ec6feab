"""What a user of audit and fit-limits gets wrong: one clear line, the right exit code, nothing half-written."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from hrcreplay import limits
from hrcreplay.commands import replay
from tests.audit.standing import frames, log_of_one_who_does_not_stir, standing
from tests.cli.test_app import Run, run
from tests.facts import tells
from tests.logs import own

__all__ = ["run"]  # the fixture

DEMO = replay.demo_log()
PAPER = (Path(limits.__file__).parent / "paper.toml").read_text()
SHORT = ("--start", 8, "--end", 8.3)
FIT = ("fit-limits", DEMO, "--out", "fitted.toml")
SHARE = "would be right: a share above 0 and below 1, e.g."

BAD: dict[str, tuple[tuple[object, ...], int, str]] = {
    "audit shorter than the horizon": (
        ("audit", DEMO, *SHORT),
        3,
        "demo.mcap: found 0.30 s; an audit needs more than the horizon of 0.377 s",
    ),
    "fit shorter than the horizon": (
        (*FIT, *SHORT),
        3,
        "demo.mcap: found 0.30 s; the part to fit on and the part held",
    ),
    "fit without arm motion": (("fit-limits", "still.mcap", "--out", "x.toml"), 3, "still.mcap: found no arm motion"),
    **{
        f"coverage of {value}": ((*FIT, "--coverage", value), 2, f"--coverage {value}: {SHARE} 0.99")
        for value in ("0", "1", "1.5", "-0.1", "nan", "inf")
    },
    **{
        f"{value} held back": ((*FIT, "--held-back", value), 2, f"--held-back {value}: {SHARE} 0.3")
        for value in ("-0.1", "1.5", "nan", "inf")
    },
    "nothing held back": (
        (*FIT, "--held-back", "0"),
        2,
        "--held-back 0: nothing is left to try the fit on; would be right: a share, e.g. 0.3",
    ),
    "all held back": (
        (*FIT, "--held-back", "1"),
        2,
        "--held-back 1: nothing is left to fit to; would be right: a share, e.g. 0.3",
    ),
    "too little held back": ((*FIT, "--held-back", "1e-9"), 3, "both need more than the horizon of 0.377 s"),
    "fit onto an existing file": (("fit-limits", DEMO, "--out", "crossed.toml"), 2, "crossed.toml: exists already"),
    **{
        f"{command} with min over max": (
            (command, DEMO, "--limits", "crossed.toml", *SHORT),
            2,
            "crossed.toml: joints.ar1.velocity: found [2.0, 1.0]; would be right: [low, high] with low <= high",
        )
        for command in ("audit", "predict", "plan", "report")
    },
    "tracking with min over max": (("fuse", DEMO, "--set", "limits.tracking=crossed.toml"), 2, "joints.ar1.velocity"),
    "audit with an unknown key": (
        ("audit", DEMO, "--limits", "unknown.toml"),
        2,
        "unknown.toml: unknown key 'speed'; known here: coupled, joints, departure, provenance",
    ),
    "predict with an unknown joint": (("predict", DEMO, "--limits", "knee.toml"), 2, "joints: unknown key 'knee'"),
    "audit without camera poses": (
        ("audit", "unposed.mcap"),
        3,
        "find it with: hrcreplay calibrate unposed.mcap --out cell.toml, then give --cell cell.toml",
    ),
    "fit without camera poses": (
        ("fit-limits", "unposed.mcap", "--out", "x.toml"),
        3,
        "the pose of camera left is not",
    ),
    "audit of nobody": (("audit", "nobody.mcap"), 3, "nobody.mcap: nobody was seen for longer than the horizon"),
    "audit of a body in one place": (("audit", "oneplace.mcap"), 3, "oneplace.mcap: n"),
    "audit of metres taken for nanometres": (("audit", "far.mcap"), 3, "far.mcap: camera cam: by its bones"),
    "audit of no log": (("audit", "none.mcap"), 3, "none.mcap: nothing is there; give a log or a run folder"),
    "one bad log of two": (("audit", DEMO, "unposed.mcap", *SHORT), 3, "mcap: "),
    "audit onto an existing folder": (("audit", DEMO, "--out", "."), 2, ".: exists already"),
}


@pytest.fixture
def files(run: Run) -> None:
    """Files of the cases, in the folder in which ``run`` runs."""
    line = re.search(r"(?m)^ar1 .*$", PAPER)
    assert line is not None
    crossed = re.sub(r"velocity *= *\[[^]]*\]", "velocity = [2.0, 1.0]", line[0])
    Path("crossed.toml").write_text(PAPER.replace(line[0], crossed))
    Path("unknown.toml").write_text(f"speed = 3\n{PAPER}")
    Path("knee.toml").write_text(PAPER.replace(line[0], f"{line[0]}\n{line[0].replace('ar1', 'knee')}"))
    log_of_one_who_does_not_stir(Path("still.mcap"))
    own.write(Path("unposed.mcap"), own.frames())
    own.write(Path("nobody.mcap"), frames(np.full((60, 20, 3), np.nan)), cameras={"cam": np.eye(4)})
    own.write(Path("oneplace.mcap"), frames(np.ones((60, 20, 3))), cameras={"cam": np.eye(4)})
    own.write(Path("far.mcap"), frames(1e9 * standing(60)), cameras={"cam": np.eye(4)})


@pytest.mark.usefixtures("files")
@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line_and_leaves_nothing(run: Run, tmp_path: Path, case: str) -> None:
    before = sorted(tmp_path.rglob("*"))
    arguments, code, message = BAD[case]
    found, out, err = run(*arguments)
    assert found == code, err
    assert out == ""
    assert message in err
    lines = err.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("hrcreplay: ")
    left = [path for path in sorted(tmp_path.rglob("*")) if path.name != "reports" and path.parent.name != "reports"]
    assert left == before


@pytest.mark.usefixtures("files")
def test_an_audit_of_one_who_does_not_stir_says_so(run: Run) -> None:
    code, out, err = run("audit", "still.mcap", "--out", "still", "--end", 2)
    assert (code, out) == (0, "still\n")
    assert tells(err.splitlines(), "still", "no arm motion")
