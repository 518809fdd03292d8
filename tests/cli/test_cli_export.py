import onnxruntime

import visadapt as va
from tests.cli.commands import refused, run


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


def test_what_is_no_policy_is_refused(here, capsys):
    assert "there is no such checkpoint" in refused(capsys, "export", "none.safetensors", "--out", "policy.onnx")
    policy = str(va.shipped("cartpole_states"))
    assert "would be lost" in refused(capsys, "export", policy, "--out", policy)
    assert not list(here.glob("*.onnx"))
