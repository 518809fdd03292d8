import json
import subprocess
import sys
from pathlib import Path

import pytest

import visadapt as va
from tests.cli.commands import refused, run
from visadapt.cli.arguments import SCORE_SEED as SEED
from visadapt.evaluation import SCORE_SEED


def score(*arguments):
    return ("score", "--episodes", 2, *arguments)


def test_the_score_is_that_of_the_library_with_failed_episodes_apart(here, trained, capsys):
    policy = trained / "states.safetensors"
    assert run(*score("--policy", policy, "--target", "rig:states", "--json", "s.json", "--film", "f.mp4")) == 0
    printed = capsys.readouterr().out
    found = va.score(va.load_policy(policy), va.SyntheticTarget(va.constant_force(1.0)), 2)
    assert printed == f"{found}\n"
    written = json.loads((here / "s.json").read_text())
    assert (written["episodes"], written["survived"], written["seed"]) == (2, found.survived, SCORE_SEED)
    assert (here / "f.mp4").read_bytes()[4:8] == b"ftyp"
    assert SEED == SCORE_SEED


def test_a_target_that_does_not_say_its_system(here, trained, capsys):
    """As docs/own_rig.md says what a target has to have."""
    policy = ("--policy", trained / "states.safetensors", "--target", "rig:bare")
    assert run(*score(*policy)) == 0
    printed = capsys.readouterr().out
    assert run(*score(*policy[:3], "rig:states")) == 0
    assert printed == capsys.readouterr().out
    assert run("adapt", *policy, "--samples", 20, "--round", 20, "--iterations", 1, "--out", "run") == 0


def test_a_command_that_is_held_for_several_steps_of_an_environment_is_said_to_be(here, trained, capsys):
    (here / "held.toml").write_text("period = 0.05\n" + (here / "map.toml").read_text())
    (here / "fine.py").write_text("import rig\n\n\nclass Fine(rig.Pushed):\n    dt = 0.025\n")
    target = ("--target", "fine:Fine", "--map", "held.toml")
    assert run(*score("--policy", trained / "states.safetensors", *target)) == 0
    said = "visadapt: fine:Fine: each command is held for 2 of its steps of 0.025 s\n"
    assert capsys.readouterr().err == said


def test_shipped_policies_balance(here, capsys):
    assert run(*score("--policy", va.shipped("cartpole_states"), "--target", "rig:states")) == 0
    assert "2 of 2 episodes up" in capsys.readouterr().out


def test_a_flight(here, capsys):
    assert run(*score("--policy", va.shipped("fixed_wing"), "--target", "rig:flying")) == 0
    assert "of 2 stayed near" in capsys.readouterr().out


def test_frames(here, trained, capsys):
    assert run(*score("--policy", trained / "frames.safetensors", "--target", "rig:filmed")) == 0
    assert "of 2 episodes up" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("CartPole-v1",), "CartPole-v1: a gymnasium id needs --map MAP.toml"),
        (("module:Thing-v0",), "module:Thing-v0: a gymnasium id needs --map MAP.toml"),
        (("rig:pushed",), "rig:pushed: returned a gymnasium environment, which needs --map MAP.toml"),
        (("rig:states", "--map", "map.toml"), "rig:states: returns a visadapt.Target, for which --map has no use"),
        (("rig:pushed", "--map", "none.toml"), "none.toml: cannot be read: No such file"),
        (("rig:pushed", "--map", "torn.toml"), "torn.toml: not TOML"),
        (("rig:pushed", "--map", "typo.toml"), "typo.toml: unknown key 'hight'"),
        (("rig:pushed", "--map", "part.toml"), "rig:pushed: its tau says 0.02 s a step"),
        (("rig:pushed", "--map", "map.toml"), "rig:pushed has 0.02 s between actions"),
        (("Nothing-v0", "--map", "map.toml"), "Nothing-v0: cannot be made"),
        (("CartPole-v1", "--map", "map.toml"), "CartPole-v1: its actions are Discrete(2)"),
        (("none:make",), "none:make: there is no module 'none', installed or in"),
        (("rig.sub:make",), "rig.sub:make: there is no module 'rig.sub'"),
        (("rig:none",), "has nothing called 'none'"),
        (("rig:not_callable",), "has a int, not a function, called 'not_callable'"),
        (("torn:make",), "torn.py, line 2: ZeroDivisionError"),
        (("needs:make",), "needs.py, line 1: ModuleNotFoundError: No module named 'absent'"),
        (("rig.py:nonsense",), "rig.py:nonsense: returned a str"),
        (("rig:needy",), "rig:needy: takes arguments (speed); a function without arguments is right"),
        (("rig:broken",), "RuntimeError: the motor is off"),
        (("rig:nonsense",), "rig:nonsense: returned a str; a visadapt.Target or a gymnasium environment is needed"),
        (("rig:timeless",), "rig:timeless: its target's period is '50 ms'; the time between actions in s, above 0"),
        (("rig:slow",), "synthetic cart-pole has 0.1 s between actions"),
        (("rig:flying",), "a policy of a cartpole, with 1 commands; synthetic vehicle takes 4: it is another system"),
    ],
)
def test_targets_that_it_refuses(here, trained, capsys, arguments, says):
    (here / "torn.toml").write_text("actions = [")
    (here / "typo.toml").write_text("hight = 3\n" + (here / "map.toml").read_text())
    (here / "part.toml").write_text("period = 0.05\n" + (here / "map.toml").read_text())
    (here / "torn.py").write_text("x = 0\n1 / x\n")
    (here / "needs.py").write_text("import absent\n")
    command = score("--policy", trained / "states.safetensors", "--json", "s.json", "--target", *arguments)
    assert says in refused(capsys, *command)
    assert not (here / "s.json").exists()


def test_code_of_one_s_own_in_another_file_than_the_factory_s_is_named_where_it_raises(here, capsys):
    (here / "motor_driver.py").write_text(
        "import rig\n\n\nclass Driven(rig.Bare):\n    def step(self, action):\n"
        "        raise OSError('the driver reports over-current')\n"
    )
    (here / "workshop").mkdir()
    (here / "workshop" / "parts.py").write_text("import motor_driver\n\nmake = motor_driver.Driven\n")
    line = refused(capsys, *score("--policy", va.shipped("cartpole_states"), "--target", "workshop.parts:make"))
    assert line.endswith("motor_driver.py: line 6: OSError: the driver reports over-current")


def test_a_quadrotor_of_one_s_own_without_a_task_has_no_score(here, capsys):
    (here / "quad.py").write_text(
        "import torch\nimport visadapt as va\n\n\n"
        "class Quad(va.Target):\n    name, period, n_action = 'quad', 0.1, 4\n\n"
        "    def reset(self, batch, generator):\n"
        "        return va.Observation(torch.eye(13)[6].expand(batch, 13), torch.ones(batch, dtype=torch.bool),\n"
        "                              goal=torch.zeros(batch, 60))\n\n"
        "    def step(self, action):\n        return self.reset(len(action), None)\n"
    )
    line = refused(capsys, *score("--policy", va.shipped("quadrotor"), "--target", "quad:Quad"))
    assert line == "visadapt: quad: flights are scored by their task: derive the target from TaskTarget"


def test_policies_that_it_refuses(here, trained, capsys):
    def line(policy, target):
        return refused(capsys, *score("--policy", policy, "--target", target))

    assert "none.safetensors: there is no such checkpoint" in line("none.safetensors", "rig:states")
    assert "rig.py: not a complete safetensors file" in line("rig.py", "rig:states")
    assert "renderer.safetensors: holds a renderer; a policy" in line(va.shipped("renderer"), "rig:states")
    assert "the target has none: give it a camera" in line(trained / "frames.safetensors", "rig:states")
    assert "shows frames of 60 x 50 px" in line(trained / "frames.safetensors", "rig:larger")
    assert "a policy of a quadrotor; synthetic vehicle is a fixed_wing" in line(va.shipped("quadrotor"), "rig:flying")


def test_what_is_not_installed_is_named_with_the_command_that_installs_it(here):
    script = "import sys; sys.modules['mujoco'] = None; from visadapt.cli.main import main; sys.exit(main())"
    arguments = ["score", "--policy", str(va.shipped("cartpole_states")), "--map", "map.toml"]
    done = subprocess.run(
        [sys.executable, "-c", script, *arguments, "--target", "InvertedPendulum-v5"],
        capture_output=True,
        text=True,
        env={"PYTHONPATH": str(Path(va.__file__).parents[1])},
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr == "visadapt: InvertedPendulum-v5: mujoco is not installed: pip install 'visadapt[mujoco]'\n"
