import onnxruntime

import visadapt as va
from tests.cli.commands import refused, run
from tests.cli.test_cli_diagnose import OWN_EFFECT
from visadapt.effects import EFFECTS


def test_a_policy_as_onnx(here, capsys):
    assert run("export", va.shipped("cartpole_frames"), "--out", "policy.onnx") == 0
    printed = capsys.readouterr().out
    assert "frame, 5 x 100 x 120 uint8" in printed
    assert "0.05 s" in printed
    session = onnxruntime.InferenceSession(here / "policy.onnx")
    assert {each.name: each.shape for each in session.get_inputs()} == {
        "observations": [5, 100, 120],
        "actions": [5, 1],
    }
    assert session.get_outputs()[0].shape == [10, 1]
    about = session.get_modelmeta().custom_metadata_map
    assert (about["system"], about["period"]) == ("cartpole", "0.05 s")
    assert about["states"] == "x m, x_dot m/s, theta rad, theta_dot rad/s"


def test_the_goal_of_a_flight_is_explained(here, capsys):
    assert run("export", va.shipped("quadrotor"), "--out", "policy.onnx") == 0
    assert "goal          the next 10 points of the reference, a period apart: x, y, z in m" in capsys.readouterr().out


def test_a_policy_that_was_trained_with_an_effect_of_one_s_own(here, capsys):
    (here / "mine.py").write_text(OWN_EFFECT.format(name="Own", effect="test_cli_export"))
    given = ("train", "--system", "cartpole", "--out", "p.safetensors", "--iterations", 1, "--effects", "mine.py")
    try:
        assert run(*given, "--effect", "test_cli_export:strength=0.5") == 0
        EFFECTS.pop("test_cli_export")
        assert "name it by --effects" in refused(capsys, "export", "p.safetensors", "--out", "p.onnx")
        assert run("export", "p.safetensors", "--out", "p.onnx", "--effects", "mine.py") == 0
    finally:
        EFFECTS.pop("test_cli_export", None)


def test_what_is_no_policy_is_refused(here, capsys):
    assert "there is no such checkpoint" in refused(capsys, "export", "none.safetensors", "--out", "policy.onnx")
    policy = str(va.shipped("cartpole_states"))
    assert "is the file of POLICY, which would be lost" in refused(capsys, "export", policy, "--out", policy)
    assert not list(here.glob("*.onnx"))
