from __future__ import annotations

from pathlib import Path

import pytest

from hrcreplay.errors import SettingRenamed, SettingsError
from hrcreplay.settings.load import Settings, as_overrides, load_settings
from hrcreplay.settings.sections import setting
from tests.facts import facts


def test_defaults_are_the_papers() -> None:
    settings = Settings()
    assert settings.prediction.stop_s == 0.377  # Eq. (70)
    assert settings.plan.q_p == (0.10, 0.10)  # Eq. (71)
    assert settings.plan.q_v == (1.0, 1.0)  # Eq. (72)
    prediction = settings.prediction
    assert (prediction.radius_head_m, prediction.radius_thorax_m) == (0.12, 0.15)  # Table 2
    assert (prediction.radius_upper_arm_m, prediction.radius_lower_arm_m) == (0.07, 0.07)


def test_the_paper_as_printed_is_one_word_and_the_command_line_wins_over_it(tmp_path: Path) -> None:
    settings = load_settings(Path("paper"), ("plan.rows=soft",))
    plan = settings.plan
    assert (settings.prediction.method, settings.limits.prediction) == ("paper", "paper")
    assert (plan.horizon, plan.certify, plan.rows, plan.constraint_rhs) == ("fixed", False, "soft", "square")
    assert (plan.lead_s, plan.give_way_m, plan.jerk_s, plan.smooth_s) == (0.0, 0.0, 0.0, 0.0)
    with pytest.raises(SettingsError, match=facts(str(tmp_path / "paper"), "TOML")):
        load_settings(tmp_path / "paper")


def test_command_line_wins_over_file_and_file_over_defaults(tmp_path: Path) -> None:
    file = tmp_path / "s.toml"
    file.write_text("[fusion]\nrate_hz = 100\noutlier_m = 0.5\n")
    settings = load_settings(file, ("fusion.rate_hz=50", "plan.method=scaling"))
    assert settings.fusion.rate_hz == 50
    assert settings.fusion.outlier_m == 0.5
    assert settings.fusion.confidence_min == Settings().fusion.confidence_min
    assert settings.plan.method == "scaling"


def test_settings_of_an_earlier_run_come_back_whole() -> None:
    settings = load_settings(None, ("prediction.store_hz=all", "plan.q_p=[0.2, 0.3]"))
    again = load_settings(None, (), settings.model_dump(mode="json"))
    assert again == settings


def test_settings_that_are_not_the_defaults_as_a_command_line_gives_them() -> None:
    assert as_overrides(Settings()) == ()
    given = (
        "fusion.rate_hz=100.0",
        'limits.prediction="inf"',
        'live.zenoh={connect = ["tcp/cell:7447"], mode = "client"}',
        'logs.decoders=[{topic = "/bodies", camera = "left", points = "bodies.points", index = {head = 3}}]',
        'logs.topics=["/tf", "/two words"]',
        "plan.q_p=[0.2, 0.3]",
        "prediction.method=paper",
        "robot.urdf=/somewhere/on/disk/arm.urdf",
    )
    settings = load_settings(None, given)
    told = as_overrides(settings)
    assert "robot.urdf=arm.urdf" in told
    assert [text.split("=")[0] for text in told] == [text.split("=")[0] for text in given]
    again = load_settings(None, told)
    robot = settings.robot.model_copy(update={"urdf": Path("arm.urdf")})
    assert again == settings.model_copy(update={"robot": robot})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[fusion]\nrate = 3\n", "s.toml | fusion | 'rate' | rate_hz"),
        ("[fusio]\nrate_hz = 3\n", "'fusio' | logs, fusion"),
        ("[fusion]\nrate_hz = -3\n", "fusion.rate_hz | -3 | greater than 0"),
        ("[fusion]\nrate_hz = nan\n", "fusion.rate_hz | nan"),
        ("fusion = 3\n", "fusion | 3"),
        ("[fusion\n", "not TOML"),
        ("[prediction]\nmethod = 'hopeful'\n", "prediction.method | 'hopeful' | 'paper'"),
        (
            "[[logs.decoders]]\ntopic='/a'\ncamera='a'\npoints='p'\nindex={nose=1}\n",
            "logs.decoder 1 | 'nose' | pelvis",
        ),
        ("[logs]\njoint_names = ['a', 'b', 'a']\n", "logs | 'a' | joint_names"),
        ("[plan]\nq_p = [0.1, 'x']\n", "plan.q_p.1 | 'x' | number"),
        ("[fusion]\nrate_hz = -3\nrate = 3\n", "fusion | 'rate' | rate_hz"),
    ],
)
def test_a_wrong_file_is_one_clear_line(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "s.toml"
    file.write_text(text)
    with pytest.raises(SettingsError, match=facts(*message.split(" | "))) as caught:
        load_settings(file)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 2


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("fusion", "section.key=value"),
        ("fusion.a.b=1", "section.key=value"),
        ("fusion.rat=1", "fusion | 'rat'"),
        ("limits.tracking=3", "limits.tracking | 3"),
    ],
)
def test_a_wrong_override_is_one_clear_line(override: str, message: str) -> None:
    with pytest.raises(SettingsError, match=facts(*message.split(" | "))):
        load_settings(None, (override,))


def test_a_missing_file_says_so(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=facts("none.toml", "cannot be read")):
        load_settings(tmp_path / "none.toml")


def test_paths_in_a_file_are_beside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As are those of a colleague who gives a folder away; from the command line they are from where it runs."""
    (tmp_path / "cell" / "meshes").mkdir(parents=True)
    for name in ("arm.urdf", "task.toml", "mine.toml"):
        (tmp_path / "cell" / name).write_text("")
    text = '[robot]\nurdf = "arm.urdf"\npackages = ["meshes", "none"]\n'
    text += '[plan]\ntask = "task.toml"\n[limits]\ntracking = "mine.toml"\nprediction = "people"\n'
    (tmp_path / "cell" / "settings.toml").write_text(text)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    found = load_settings(Path("../cell/settings.toml"))
    assert found.robot.urdf is not None
    assert found.robot.urdf.samefile(tmp_path / "cell" / "arm.urdf")
    assert [path.name for path in found.robot.packages] == ["meshes", "none"]
    assert found.robot.packages[0].samefile(tmp_path / "cell" / "meshes")
    assert found.robot.packages[1] == Path("none")
    assert found.plan.task is not None
    assert found.plan.task.samefile(tmp_path / "cell" / "task.toml")
    assert Path(found.limits.tracking).samefile(tmp_path / "cell" / "mine.toml")
    assert found.limits.prediction == "people"
    assert load_settings(None, ("robot.urdf=arm.urdf",)).robot.urdf == Path("arm.urdf")


def test_the_word_none_stands_for_no_value_where_there_may_be_none() -> None:
    decoder = '{topic = "/a", camera = "c", points = "p", index = {head = 0}, stamp = "none"}'
    found = load_settings(None, (f"logs.decoders=[{decoder}]", "logs.joints_topic=none", "plan.method=none"))
    assert found.logs.decoders[0].stamp is None
    assert found.logs.joints_topic is None
    assert found.plan.method == "none"
    assert load_settings(None, as_overrides(found)) == found  # a command line that makes the same run again


OLD_NAMES = {
    "occupancy.store_hz=50": "prediction.store_hz=50",
    "plan.leash_m=0.2": "plan.max_reference_lead_m=0.2",
    "plan.room=square": "plan.constraint_rhs=square",
    "live.look_s=0.03": "live.perception_max_age_s=0.03",
}


@pytest.mark.parametrize("old", OLD_NAMES)
def test_names_of_the_version_before_are_read_and_told(tmp_path: Path, old: str) -> None:
    new = OLD_NAMES[old]
    with pytest.warns(SettingRenamed, match=rf"--set {old}: \S+ is now called {new.partition('.')[0]}"):
        assert load_settings(None, (old,)) == load_settings(None, (new,)) != Settings()
    (section, _, key), value = old.partition("=")[0].partition("."), old.partition("=")[2]
    file = tmp_path / "old.toml"
    file.write_text(f"[{section}]\n{key} = {value if value[0].isdigit() else repr(value)}\n")
    with pytest.warns(SettingRenamed, match="old.toml: "):
        assert load_settings(file) == load_settings(None, (new,))
    with pytest.warns(SettingRenamed):  # and wins over the settings of the file and of an earlier run
        assert load_settings(file, (old,), load_settings(None, (new,)).model_dump(mode="json")) == load_settings(
            None, (new,)
        )


def test_settings_that_an_earlier_version_recorded_are_read_without_a_word(recwarn: pytest.WarningsRecorder) -> None:
    recorded = {"occupancy": {"stop_s": 0.5}, "plan": {"leash_m": 0.1}}
    settings = load_settings(None, ("plan.max_reference_lead_m=0.3",), recorded)
    assert (settings.prediction.stop_s, settings.plan.max_reference_lead_m) == (0.5, 0.3)
    assert setting(recorded, "prediction", "stop_s") == 0.5
    assert setting(recorded, "plan", "max_reference_lead_m") == 0.1
    assert setting(recorded, "plan", "constraint_rhs") == "product"
    assert not recwarn.list


def test_a_setting_under_both_names_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "both.toml"
    file.write_text("[plan]\nleash_m = 0.1\nmax_reference_lead_m = 0.2\n")
    with pytest.raises(SettingsError, match="plan: unknown key 'leash_m'"):
        load_settings(file)
