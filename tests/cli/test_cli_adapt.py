import json

import pytest
import torch

import visadapt as va
from tests.cli.commands import GUESS, refused, run, write_frames
from visadapt import progress
from visadapt.diagnosis.search import camera

SHIPPED = va.shipped("cartpole_states")
SMALL = ("--samples", 40, "--round", 20, "--iterations", 2, "--out", "run")


def test_a_policy_on_states(here, trained, capsys):
    policy = ("adapt", "--policy", trained / "states.safetensors", "--target", "rig:states")
    command = (*policy, *SMALL)
    assert run(*command) == 0
    assert capsys.readouterr().out == "40 samples of synthetic cart-pole used; the policy is run/policy.safetensors\n"
    ledger = json.loads((here / "run" / "ledger.json").read_text())
    assert (ledger["budget"], ledger["used"]) == (40, 40)
    assert sum(steps for _, steps in ledger["entries"]) == 40
    written = json.loads((here / "run" / "settings.json").read_text())
    assert written["settings"]["seed"] == 0
    assert written["settings"]["target"] == "rig:states"
    assert written["versions"]["torch"] == torch.__version__
    before, after = va.load_policy(trained / "states.safetensors"), va.load_policy("run/policy.safetensors")
    assert after.residual is not None
    assert not torch.equal(before.state_dict()["first.weight"], after.state_dict()["first.weight"])
    assert va.load_source("run/policy.safetensors").system == va.CartPole()
    # A finished run is read, not run again; other settings are another run.
    kept = (here / "run" / "policy.safetensors").read_bytes()
    assert run(*command) == 0
    assert (here / "run" / "policy.safetensors").read_bytes() == kept
    assert "run holds a run with other settings (samples)" in refused(capsys, *policy, "--samples", 60, *SMALL[2:])


def test_a_policy_on_frames_of_any_shape(here, trained):
    frames, renderer = trained / "frames.safetensors", trained / "renderer.safetensors"
    target = ("--target", "rig:filmed", "--renderer", renderer, "--samples", 20, "--round", 20, "--iterations", 1)
    assert run("adapt", "--policy", frames, *target, "--out", "run") == 0
    assert va.load_policy("run/policy.safetensors").residual is not None


def test_on_a_gymnasium_environment(here, trained, capsys):
    (here / "map.toml").write_text("period = 0.02\n" + (here / "map.toml").read_text())
    train = ("train", "--system", "cartpole", "--period", 0.02, "--iterations", 2, "--out", "fast.safetensors")
    assert run(*train) == 0
    gym = ("--policy", "fast.safetensors", "--target", "rig:pushed", "--map", "map.toml")
    assert run("adapt", *gym, *SMALL) == 0
    assert "between actions" not in capsys.readouterr().err
    assert json.loads((here / "run" / "ledger.json").read_text())["used"] == 40


def test_a_command_of_the_opposite_sign_is_said_without_a_diagnosis_too(here, capsys):
    for target in ("rig:turned", "rig:states"):
        assert run("adapt", "--policy", SHIPPED, "--target", target, *SMALL[:-1], target[4:]) == 0
        warned = "Warning    command of the target has the opposite sign" in capsys.readouterr().out
        assert warned == (target == "rig:turned")


def test_effects_of_a_diagnosis_are_fitted_to_the_target(here, trained, diagnosis):
    policy = ("--policy", trained / "states.safetensors", "--target", "rig:states")
    assert run("adapt", *policy, "--diagnosis", diagnosis([("constant_force", {"force": 0.0})]), *SMALL) == 0
    (force,) = va.load_source("run/policy.safetensors").effects
    assert force.name == "constant_force"
    assert float(force.get_parameter("force").detach()) == pytest.approx(1.0, abs=0.2)


def test_an_effect_that_is_given_replaces_that_of_the_diagnosis(here, trained, diagnosis):
    policy = ("--policy", trained / "states.safetensors", "--target", "rig:states")
    effect = ("--diagnosis", diagnosis([("constant_force", {"force": 0.0})]), "--effect", "constant_force:force=1")
    assert run("adapt", *policy, *effect, *SMALL) == 0
    assert [effect.name for effect in va.load_source("run/policy.safetensors").effects] == ["constant_force"]


def test_the_causes_of_the_gap_are_named_and_put_into_the_simulator(here, capsys, only_effects):
    only_effects("constant_force", "actuator_bias", "actuator_gain", "viscous_friction", "spring", "angle_offset")
    policy = ("--policy", SHIPPED, "--target", "rig:states", "--diagnose")
    assert run("adapt", *policy, *SMALL) == 0
    # A bias of the command is the same as the target's force of 1 N: no experiment tells one from the other.
    said = "ambiguous: actuator_bias (offset 0.0333); as well explained by constant_force (force 1.000 N) (to tune"
    assert said in capsys.readouterr().out
    (bias,) = va.load_source("run/policy.safetensors").effects
    assert bias.name == "actuator_bias"
    assert not [*here.glob("run/*/plan.csv")]
    assert json.loads((here / "run" / "round-02" / "diagnosis.json").read_text())["recording"]["samples"] == 40
    effect = ("--effect", "viscous_friction:coefficient=1")
    assert "leave --diagnosis and --effect out" in refused(capsys, "adapt", *policy, *effect, *SMALL)
    again = ("adapt", "--policy", "run/policy.safetensors", "--target", "rig:states", "--diagnose")
    assert "starts from the bare system" in refused(capsys, *again, *SMALL[:-1], "other")


def test_from_frames_the_camera_is_named_beside_what_moves(here, capsys, only_effects, monkeypatch):
    only_effects("actuator_gain", "cart_mass", "viscous_friction")
    monkeypatch.setattr(camera, "FRAMES", 8)
    monkeypatch.setattr(camera, "SEARCHED", (va.effects.Brightness, va.effects.CameraRotation))
    (here / "filmed.py").write_text(
        "import visadapt as va\nfrom renderers import DrawnCartPole\n\n\ndef target():\n"
        "    faults = [va.effects.CameraRotation(angle=0.06), va.effects.ActuatorGain(scale=0.6)]\n"
        "    return va.SyntheticTarget(lambda batch, generator: faults, DrawnCartPole())\n"
    )
    policy = ("--policy", va.shipped("cartpole_frames"), "--target", "filmed:target", "--diagnose")
    assert run("adapt", *policy, "--samples", 60, "--round", 60, "--iterations", 2, "--out", "run") == 0
    assert "camera_rotation (angle 0.06" in capsys.readouterr().out
    assert {str(effect.name) for effect in va.load_source("run/policy.safetensors").effects} == {
        "camera_rotation",
        "actuator_gain",
    }


def test_without_a_gap_the_policy_is_left_as_it_is(here, capsys):
    (here / "same.py").write_text("import visadapt as va\n\n\ndef target():\n    return va.SyntheticTarget()\n")
    policy = ("--policy", SHIPPED, "--target", "same:target", "--diagnose")
    assert run("adapt", *policy, *SMALL) == 0
    assert "no_gap: the policy is left as it was" in capsys.readouterr().out
    before, after = va.load_policy(SHIPPED), va.load_policy("run/policy.safetensors")
    assert torch.equal(before.state_dict()["first.weight"], after.state_dict()["first.weight"])
    assert json.loads((here / "run" / "ledger.json").read_text())["rounds"][0]["policy_loss"] is None


def test_under_a_late_motor_the_policy_stays_what_it_was_and_the_tuned_one_is_kept(here, capsys):
    (here / "late_motor.py").write_text(
        "import visadapt as va\n\n\ndef target():\n"
        "    return va.SyntheticTarget(lambda batch, generator: [va.effects.ActuatorDelay(delay=0.05)])\n"
    )
    samples = ("--samples", 120, "--round", 30, "--iterations", 100, "--out", "run")
    assert run("adapt", "--policy", SHIPPED, "--target", "late_motor:target", *samples) == 0
    said = capsys.readouterr().out
    assert "as, since the tuned one, run/tuned.safetensors, was worse: " in said
    assert "of its episodes on the machine ended early" in said
    target = va.SyntheticTarget(lambda batch, generator: [va.effects.ActuatorDelay(delay=0.05)])
    files = (SHIPPED, "run/policy.safetensors", "run/tuned.safetensors")
    before, after, tuned = (va.score(va.load_policy(file), target, episodes=4, steps=60) for file in files)
    assert before == after
    assert tuned.mean_length < 20


def test_a_round_too_short_to_diagnose_is_refused_before_a_folder_is_made(here, capsys):
    (here / "same.py").write_text("import visadapt as va\n\n\ndef target():\n    return va.SyntheticTarget()\n")
    command = ("adapt", "--policy", SHIPPED, "--target", "same:target", "--diagnose", "--samples", 40, "--out", "run")
    assert run(*command, "--round", 9) == 2
    said = capsys.readouterr().err
    assert "episodes of at most 9 samples last 0.45 s, and a diagnosis predicts 0.5 s ahead" in said
    assert "of at least 10 samples are right" in said
    assert not (here / "run").exists()


def test_episodes_that_are_too_short_for_a_diagnosis_are_said_to_be(here, trained, capsys):
    (here / "slippery.py").write_text(
        "import rig\nfrom dataclasses import replace\n\n\nclass Slippery(rig.Bare):\n"
        "    def reset(self, batch, generator):\n"
        "        self.steps = 0\n        return super().reset(batch, generator)\n\n"
        "    def step(self, action):\n        self.steps += 1\n        seen = super().step(action)\n"
        "        return replace(seen, alive=seen.alive & (self.steps < 4))\n"
    )
    policy = ("--policy", trained / "states.safetensors", "--target", "slippery:Slippery", "--diagnose")
    assert run("adapt", *policy, "--samples", 20, "--round", 20, "--iterations", 1, "--out", "run") == 0
    said = "20 of 20 samples are in episodes shorter than 0.5 s, not diagnosed: a residual learnt the gap\n"
    assert capsys.readouterr().out.startswith(said)


def test_interrupted_it_goes_on(here, trained, monkeypatch, capsys):
    command = ("adapt", "--policy", trained / "states.safetensors", "--target", "rig:states", *SMALL[:-1])
    assert run(*command, "whole") == 0

    def log(self, stage, done, total, loss):
        if stage == "round 2/2: ground":
            raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(progress._Log, "__call__", log)
        assert run(*command, "run") == 130
    assert capsys.readouterr().err.splitlines()[-1] == "visadapt: interrupted; run the same command to go on"
    assert not (here / "run" / "policy.safetensors").exists()
    assert run(*command, "run") == 0
    whole, resumed = (va.load_policy(f"{name}/policy.safetensors").state_dict() for name in ("whole", "run"))
    assert all(torch.equal(value, resumed[name]) for name, value in whole.items())


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--effect", "viscous_friction:coefficient=1,coefficient=2"), "coefficient=2: coefficient is given twice"),
        (("--renderer", "r.safetensors"), "states.safetensors: is shown states, for which --renderer has no use"),
        (("--effect", "rotor_drag:x=1"), "rotor_drag acts on a quadrotor, not on a cartpole"),
        (("--diagnosis", "none.json"), "none.json: cannot be read"),
    ],
)
def test_what_it_refuses(here, trained, capsys, arguments, says):
    command = ("adapt", "--policy", trained / "states.safetensors", "--target", "rig:states", *SMALL)
    assert says in refused(capsys, *command, *arguments)
    assert not (here / "run").exists()


def test_a_round_of_more_samples_than_there_are(here, trained, capsys):
    command = ("adapt", "--policy", trained / "states.safetensors", "--target", "rig:states", "--out", "run")
    line = refused(capsys, *command, "--samples", 40, "--round", 50)
    assert "--round 50 is more than --samples 40" in line
    assert not (here / "run").exists()


def test_a_file_in_the_place_of_the_folder(here, trained, capsys):
    command = ("adapt", "--policy", trained / "states.safetensors", "--target", "rig:states", *SMALL[:-1])
    (here / "kept.txt").write_text("notes")
    assert "--out: kept.txt is a file; name a folder" in refused(capsys, *command, "kept.txt")
    assert (here / "kept.txt").read_text() == "notes"


def test_a_folder_with_files_that_are_no_run_is_left_as_it_is(here, trained, capsys):
    command = ("adapt", "--policy", trained / "states.safetensors", "--target", "rig:states", *SMALL)
    (here / "run").mkdir()
    (here / "run" / "policy.safetensors").write_text("mine")
    assert "run has files in it that are no run of visadapt: name another by --out" in refused(capsys, *command)
    assert (here / "run" / "policy.safetensors").read_text() == "mine"
    assert len([*(here / "run").iterdir()]) == 1


def test_warnings_of_a_diagnosis_are_said_where_its_effects_are_used(here, trained, diagnosis, capsys):
    path = diagnosis()
    warning = "the angle has the opposite sign of the source's; it was inverted"
    path.write_text(json.dumps({**json.loads(path.read_text()), "warnings": [warning]}))
    command = ("adapt", "--policy", trained / "states.safetensors", "--target", "rig:states", "--out", "run")
    assert run(*command, "--diagnosis", path, "--samples", 40, "--round", 50) == 2
    assert f"visadapt: {path}: {warning}\n" in capsys.readouterr().err


def test_a_diagnosis_that_named_nothing(here, trained, diagnosis, capsys):
    command = ("adapt", "--policy", trained / "states.safetensors", "--target", "rig:states", *SMALL)
    line = refused(capsys, *command, "--diagnosis", diagnosis((), "no_gap"))
    assert "the verdict is no_gap: the diagnosis named no cause" in line


def test_a_renderer_that_the_policy_was_not_trained_with(here, trained, capsys):
    command = ("adapt", "--policy", trained / "frames.safetensors", "--target", "rig:filmed", *SMALL)
    assert "the policy was not trained with this renderer" in refused(capsys, *command)
    write_frames(here / "a.h5", 40)
    other = (*GUESS, "--iterations", 60, "--out", "other.safetensors")
    assert run("renderer", "a.h5", *other) == 0
    line = refused(capsys, *command, "--renderer", "other.safetensors")
    assert "the policy was not trained with this renderer: give the one that" in line
    assert not (here / "run").exists()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["constant_force:force=0", "constant_force:force=1"], "constant_force is given more than once"),
        (["actuator_bias:offset=0", "constant_force:force=0"], "passive data cannot tell apart actuator_bias and"),
    ],
)
def test_effects_that_cannot_be_fitted_are_refused_before_the_machine_is_run(here, trained, capsys, given, said):
    command = ("adapt", "--policy", trained / "states.safetensors", "--target", "rig:states", *SMALL)
    assert said in refused(capsys, *command, *(part for effect in given for part in ("--effect", effect)))
    assert not (here / "run").exists()
