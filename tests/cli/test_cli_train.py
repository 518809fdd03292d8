import json

import pytest
import torch

import visadapt as va
from tests.cli.commands import refused, run
from tests.cli.test_cli_diagnose import OWN_EFFECT
from visadapt import progress
from visadapt.effects import EFFECTS
from visadapt.policies import ImagePolicy, StatePolicy

CARTPOLE = ("train", "--system", "cartpole", "--out", "p.safetensors")
TINY = (*CARTPOLE, "--iterations", 2)


def test_a_policy_on_states_and_the_world_that_it_was_trained_in(here, diagnosis, capsys):
    (here / "rig.toml").write_text("[parameters]\ncart_mass = 0.5\n")
    effects = ("--diagnosis", diagnosis(), "--effect", "actuator_delay:delay=0.02")
    assert run(*TINY, "--params", "rig.toml", "--period", 0.04, *effects) == 0
    assert capsys.readouterr().out == "p.safetensors\n"
    assert isinstance(va.load_policy("p.safetensors"), StatePolicy)
    source = va.load_source("p.safetensors")
    assert (source.system, source.period) == (va.CartPole(cart_mass=0.5), 0.04)
    assert {each.name: [float(p.detach()) for p in each.parameters()] for each in source.effects} == {
        "viscous_friction": [2.0],
        "actuator_delay": [pytest.approx(0.02)],
    }
    assert sorted(path.name for path in here.iterdir()) == [
        "diagnosis.json",
        "map.toml",
        "p.safetensors",
        "rig.py",
        "rig.toml",
    ]


def test_seeds(here):
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        assert run(*CARTPOLE[:3], "--iterations", 2, "--seed", seed, "--out", f"{name}.safetensors") == 0
    a, b, c = (va.load_policy(f"{name}.safetensors").state_dict() for name in "abc")
    assert all(torch.equal(value, b[name]) for name, value in a.items())
    assert not all(torch.equal(value, c[name]) for name, value in a.items())


def test_a_policy_on_frames(trained):
    policy = va.load_policy(trained / "frames.safetensors")
    assert isinstance(policy, ImagePolicy)
    assert policy.encoder.background.shape == (40, 48)


def test_a_fixed_wing(here):
    assert run("train", "--system", "fixed_wing", "--iterations", 1, "--out", "wing.safetensors") == 0
    assert va.load_source("wing.safetensors").system == va.FixedWing()


def test_a_quadrotor_follows_references(here, capsys):
    quadrotor = ("train", "--system", "quadrotor", "--iterations", 1, "--out", "q.safetensors")
    assert "a quadrotor follows references" in refused(capsys, *quadrotor)
    rows = [f"{t / 10},{0.05 * t},0,1" for t in range(30)]
    (here / "line.csv").write_text("\n".join(["time,x,y,z", *rows]) + "\n")
    assert run(*quadrotor, "--references", "line.csv") == 0
    assert va.load_source("q.safetensors").period == pytest.approx(0.1)


def test_an_effect_beyond_what_a_diagnosis_looks_for_is_said_so(here, capsys):
    assert run(*TINY, "--effect", "viscous_friction:coefficient=-5") == 0
    assert "coefficient is -5 N s/m; a diagnosis looks for it from 0 to 30 N s/m" in capsys.readouterr().err


def test_of_an_ambiguous_diagnosis_it_is_said_which_effects_the_simulator_has(here, diagnosis, capsys):
    names = ["constant_force", "actuator_bias"]
    path = diagnosis([(names[0], {"force": 1.0}), (names[1], {"offset": 0.03})], "ambiguous")
    content = json.loads(path.read_text())
    for cause, other in zip(content["causes"], reversed(names), strict=True):
        cause["indistinguishable_from"] = [other]
    path.write_text(json.dumps(content))
    assert run(*TINY, "--diagnosis", path) == 0
    (taken,) = (str(effect.name).replace("_", " ") for effect in va.load_source("p.safetensors").effects)
    said = capsys.readouterr().err
    assert f"diagnosis.json: ambiguous: the simulator has {taken}, not " in said


@pytest.mark.parametrize("iterations", [1, 10])
def test_a_few_iterations(here, iterations):
    assert run("train", "--system", "cartpole", "--out", "p.safetensors", "--iterations", iterations) == 0


def test_effects_of_one_s_own(here, diagnosis):
    (here / "mine.py").write_text(OWN_EFFECT.format(name="Own", effect="test_cli_own"))
    try:
        found = diagnosis([("test_cli_own", {"strength": 0.5})])
        assert run(*TINY, "--effects", "mine.py", "--diagnosis", found) == 0
        assert [effect.name for effect in va.load_source("p.safetensors").effects] == ["test_cli_own"]
    finally:
        EFFECTS.pop("test_cli_own", None)


def test_interrupted_it_does_not_go_on_with_other_code_of_an_effect(here, capsys, monkeypatch):
    def stopped(*args, **kwargs):
        raise KeyboardInterrupt

    text = OWN_EFFECT.format(name="Own", effect="test_cli_own")
    (here / "mine.py").write_text(text)
    own = (*TINY, "--effects", "mine.py", "--effect", "test_cli_own:strength=0.5")
    try:
        with monkeypatch.context() as patched:
            patched.setattr(va.Setup, "pretrain", stopped)
            assert run(*own) == 130
        (here / "mine.py").write_text(text + "\n")
        assert "effects" in refused(capsys, *own)
    finally:
        EFFECTS.pop("test_cli_own", None)


def test_interrupted_it_goes_on_to_the_same_policy(here, monkeypatch):
    """Once while it is trained and once while it is refined: both go on from the last checkpoint."""
    monkeypatch.setattr("visadapt.learning.training_state.CHECKPOINT_ITERATIONS", 4)
    command = (*CARTPOLE[:3], "--iterations", 9)
    assert run(*command, "--out", "whole.safetensors") == 0
    calls = []

    def log(self, stage, done, total, loss):
        calls.append(done)
        if len(calls) in (6, 17):
            raise KeyboardInterrupt

    monkeypatch.setattr(progress._Log, "__call__", log)
    for _ in range(2):
        assert run(*command, "--out", "p.safetensors") == 130
        assert not (here / "p.safetensors").exists()
    assert run(*command, "--out", "p.safetensors") == 0
    trained, refined = [*range(1, 7), *range(5, 10)], [*range(1, 7), *range(5, 10)]
    assert calls == trained + refined
    whole, resumed = (va.load_policy(f"{name}.safetensors").state_dict() for name in ("whole", "p"))
    assert all(torch.equal(value, resumed[name]) for name, value in whole.items())
    assert not list(here.glob("*.unfinished")) + list(here.glob("*.rough.safetensors"))


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--effect", "viscous_frition:coefficient=1"), "no effect 'viscous_frition'; did you mean viscous_friction?"),
        (("--effect", "viscous_friction:mu=1"), "viscous_friction takes the parameters coefficient; got mu"),
        (("--effect", "viscous_friction"), "viscous_friction takes the parameters coefficient; got none"),
        (("--effect", "viscous_friction:coefficient=much"), "'coefficient=much' is not of the form PARAMETER=NUMBER"),
        (("--effect", "viscous_friction:coefficient=nan"), "coefficient must be finite"),
        (("--effect", "actuator_delay:delay=-0.1"), "delay must not be negative, got -0.1 s"),
        (("--effect", "rotor_drag:coefficient=0.1"), "rotor_drag acts on a quadrotor, not on a cartpole"),
        (("--diagnosis", "none.json"), "none.json: cannot be read: No such file"),
        (("--diagnosis", "rig.py"), "rig.py: not JSON"),
        (("--diagnosis", "empty.json"), "empty.json: no diagnosis of version"),
        (("--params", "none.toml"), "none.toml: cannot be read"),
        (("--renderer", "none.safetensors"), "none.safetensors: there is no such renderer"),
        (("--references", "line.csv"), "--references is for a quadrotor, not for a cartpole"),
        (("--seeing", 3), "--seeing is for a policy that is shown frames"),
        (("--effects", "none.py"), "none.py: there is no such file"),
    ],
)
def test_what_it_refuses(here, capsys, arguments, says):
    (here / "empty.json").write_text("{}")
    assert says in refused(capsys, *TINY, *arguments)
    assert not list(here.glob("p.safetensors*"))


def test_diagnoses_that_name_nothing_or_another_system(here, diagnosis, capsys):
    for verdict in ("no_gap", "unexplained"):
        line = refused(capsys, *TINY, "--diagnosis", diagnosis((), verdict))
        assert f"diagnosis.json: the verdict is {verdict}: the diagnosis named no cause" in line
    line = refused(capsys, *TINY, "--diagnosis", diagnosis(system="quadrotor"))
    assert "diagnosis.json: a diagnosis of a quadrotor, where a cartpole is given" in line
    line = refused(capsys, *TINY, "--diagnosis", diagnosis([("made_up", {})]))
    assert "diagnosis.json: names made_up, which is not known here" in line
    line = refused(capsys, *TINY, "--diagnosis", diagnosis([("viscous_friction", {"coefficient": None})]))
    assert "viscous_friction: the recording does not determine its coefficient" in line


def test_frames_are_for_a_cart_pole(here, capsys):
    wing = ("train", "--system", "fixed_wing", "--out", "p.safetensors")
    assert "a fixed_wing has no renderer" in refused(capsys, *wing, "--frames")


def test_a_policy_that_is_there_is_not_overwritten(here, capsys):
    (here / "p.safetensors").write_text("mine")
    assert "p.safetensors is there already" in refused(capsys, *TINY)
    assert (here / "p.safetensors").read_text() == "mine"


def test_a_folder_of_the_name_that_it_works_in_is_left_as_it_is(here, capsys):
    """It removes that folder at the end."""
    (here / "p.safetensors.unfinished").mkdir()
    (here / "p.safetensors.unfinished" / "notes.txt").write_text("mine")
    assert "p.safetensors.unfinished has files in it that are no run of visadapt" in refused(capsys, *TINY)
    assert (here / "p.safetensors.unfinished" / "notes.txt").exists()
