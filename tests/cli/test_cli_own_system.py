"""A system of one's own on the command line: named by file and class, checked, and refused in one line."""

import json
import os
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

import visadapt as va
from tests.own_systems import page_code
from visadapt.cli import main as cli


@pytest.fixture
def rig(tmp_path, monkeypatch):
    """The page's class in a file, in the current directory."""
    (tmp_path / "furuta.py").write_text(page_code()[0])
    monkeypatch.delitem(sys.modules, "furuta", raising=False)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def refused(capsys, *arguments):
    """The last line on stderr of a command that ends with status 2."""
    status: object = None
    try:
        status = cli.main(arguments)
    except SystemExit as ended:  # argparse's
        status = ended.code
    said = capsys.readouterr().err
    assert status == 2
    assert "Traceback" not in said
    return said.strip().splitlines()[-1]


def test_the_tutorial_as_a_user_runs_it(rig, capsys, monkeypatch):
    (rig / "record.py").write_text(page_code()[1].replace("range(4)", "range(2)").replace("range(125)", "range(80)"))
    monkeypatch.syspath_prepend(rig)
    runpy.run_path("record.py")
    (rig / "diagnose.py").write_text(page_code()[2])
    world = runpy.run_path("diagnose.py")["world"]
    assert [effect.name for effect in world.effects] == ["arm_axis.coulomb_friction"]
    del sys.modules["furuta"]
    assert cli.main(["check", "furuta.py:Furuta"]) == 0
    said = capsys.readouterr().out
    assert "furuta is right; 50 effects act on it" in said
    assert "changes no rate" not in said
    assert cli.main(["effects", "--system", "furuta.py"]) == 0
    assert "hinge.coulomb_friction (dynamics)" in capsys.readouterr().out
    assert len((rig / "run.csv").read_text().splitlines()) == 161
    (rig / "rig.toml").write_text("[parameters]\ncart_mass = 1.0\n")
    diagnose = ("diagnose", "run.csv", "--system", "furuta.py:Furuta")
    line = refused(capsys, *diagnose, "--params", "rig.toml")
    assert line.startswith(
        "visadapt: rig.toml: unknown key 'cart_mass' in [parameters]; there are arm_length, arm_inertia"
    )
    line = refused(capsys, *diagnose, "--columns", "voltage=volts")
    assert "has no column 'volts' for voltage" in line
    (rig / "run.csv").write_text(
        (rig / "run.csv").read_text().replace("voltage", "millivolt").replace("0.0\n", "900\n")
    )
    line = refused(capsys, *diagnose, "--columns", "voltage=millivolt")
    assert "is 900" in line
    assert "within [-10, 10] is right (V)" in line


@pytest.mark.parametrize(
    ("system", "right"),
    [
        ("nothing.py:Furuta", "nothing.py: there is no such file"),
        ("furuta.py:Rig", "furuta.py: has no class 'Rig'; its systems are Furuta"),
        ("furuta.py:torch", "furuta.py: torch is no visadapt.System; `class torch(visadapt.System)` would be right"),
        ("broken.py:Rig", "broken.py: line 2: NameError: name 'va' is not defined"),
        ("empty.py", "empty.py: it has no class that derives from visadapt.System; empty.py:MyRig would name one"),
        ("furuta", "there is no system 'furuta'; there are cartpole, quadrotor, fixed_wing, and your own as my_rig.py"),
    ],
)
def test_what_names_no_system_is_said(rig, capsys, system, right):
    (rig / "broken.py").write_text("\nclass Rig(va.System): pass\n")
    (rig / "empty.py").write_text("")
    assert right in refused(capsys, "effects", "--system", system)


def test_a_system_may_import_a_file_beside_it_from_any_folder(rig, tmp_path, monkeypatch, capsys):
    (rig / "mine_only.py").write_text("import furuta\n\nFuruta = furuta.Furuta\n")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    monkeypatch.setattr(sys, "path", list(sys.path))
    assert cli.main(["effects", "--system", f"{rig / 'mine_only.py'}:Furuta"]) == 0
    assert "arm_axis.coulomb_friction" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        (
            "    gravity:",
            "    encoder_counts: float = 4096.0\n    gravity:",
            "encoder_counts changes no rate within the ranges: derivative does not use this parameter",
        ),
        (
            '"voltage", "V", -10.0, 10.0),',
            '"voltage", "V", -10.0, 10.0), va.Variable("brake", "V", 0.0, 5.0),',
            "brake    changes no rate within the ranges: derivative does not use this command",
        ),
    ],
    ids=["parameter", "command"],
)
def test_what_the_derivative_does_not_use_is_named(rig, capsys, old, new, line):
    (rig / "furuta.py").write_text(page_code()[0].replace(old, new))
    assert cli.main(["check", "furuta.py:Furuta"]) == 0
    assert line in capsys.readouterr().out.splitlines()


def test_a_class_that_lacks_something_is_refused_by_every_command(rig, capsys):
    text = page_code()[0].replace('"arm", "rad"', '"arm", ""').replace('"voltage", "V"', '"voltage", " "')
    (rig / "furuta.py").write_text(text)
    refused(capsys, "check", "furuta.py:Furuta")
    status = cli.main(["check", "furuta.py:Furuta"])
    said = capsys.readouterr().err.splitlines()
    assert status == 2
    assert [line.split(";")[0] for line in said] == [
        "visadapt: Furuta: states: arm has no unit",
        "visadapt: Furuta: actions: voltage has no unit",
    ]
    (rig / "run.csv").write_text("time\n0\n")
    for command in (["effects"], ["diagnose", "run.csv"]):
        line = refused(capsys, *command, "--system", "furuta.py:Furuta")
        assert line.startswith("visadapt: Furuta: states: arm has no unit")
        assert line.endswith("(and 1 more: `visadapt check` lists them)")


BELT = """
from dataclasses import dataclass

import visadapt as va


@dataclass(frozen=True)
class BeltCart(va.CartPole):
    slip: float = 0.1

    name = "belt_cart"

    def derivative(self, state, command, load):
        return super().derivative(state, command * (1 - self.slip * state[:, 1].abs()).unsqueeze(1), load)


def make():
    return va.SyntheticTarget(system=BeltCart())
"""


def command(*arguments):
    """The command as a process of its own, in which no class of the user's is known before it begins."""
    script = "import sys; from visadapt.cli.main import main; sys.exit(main())"
    environment = {**os.environ, "PYTHONPATH": str(Path(va.__file__).parents[1])}
    run = [sys.executable, "-c", script, *arguments]
    return subprocess.run(run, capture_output=True, text=True, env=environment, check=False)


def test_a_policy_for_it_is_read_where_system_names_its_class(rig):
    (rig / "belt.py").write_text(BELT)
    own, target = ("--system", "belt.py:BeltCart"), ("--target", "belt:make")
    done = command("train", *own, "--iterations", "2", "--out", "p.safetensors")
    assert done.returncode == 0, done.stderr
    score = ("score", "--policy", "p.safetensors", *target, "--episodes", "1")
    done = command(*score)
    assert done.returncode == 2
    assert "p.safetensors: needs 'belt_cart', which is not known here" in done.stderr
    assert done.stderr.endswith("or name it by --system\n")
    few = ("--samples", "20", "--round", "20", "--iterations", "1", "--out", "run")
    for working in (
        (*score, *own),
        ("adapt", "--policy", "p.safetensors", *target, *few, *own),
        ("export", "run/policy.safetensors", "--out", "p.onnx", *own),
    ):
        done = command(*working)
        assert done.returncode == 0, done.stderr
    (rig / "belt.py").write_text(BELT.replace("slip: float = 0.1", "slip: float = 0.2"))
    done = command(*score, *own)
    assert "p.safetensors: was made with slip 0.1 where BeltCart has 0.2; the policy's own are used" in done.stderr
    done = command(*score, "--system", "furuta.py:Furuta")
    assert "needs 'belt_cart'" in done.stderr
    shipped = ("score", "--policy", str(va.shipped("cartpole_states")), *target)
    done = command(*shipped, *own)
    assert done.stderr.endswith("a policy of a cartpole; --system is a belt_cart\n")


def test_a_policy_brings_it_to_the_goal_of_a_task(rig, capsys):
    (rig / "upright.toml").write_text(page_code("toml")[0])
    (rig / "late.py").write_text(page_code()[3])
    own, late = ("--system", "furuta.py:Furuta"), ("--effect", "voltage.actuator_delay:delay=0.02")
    train = ("train", *own, "--task", "upright.toml", "--period", "0.02", "--iterations")
    done = command(*train, "2", *late, "--out", "with_effect.safetensors")
    assert done.returncode == 0, done.stderr
    assert cli.main((*train, "10", "--out", "source.safetensors")) == 0
    score = ("score", *own, "--target", "late:make", "--episodes", "5", "--policy")
    assert cli.main((*score, "source.safetensors")) == 0
    assert capsys.readouterr().out.endswith("\n0 of 5 episodes survived\n")
    assert "a film is that of a cart-pole or of a vehicle" in refused(
        capsys, *score, "source.safetensors", "--film", "f.mp4"
    )
    run = ("--target", "late:make", "--samples", "40", "--iterations", "1", "--out", "run")
    assert cli.main(("adapt", *own, "--policy", "source.safetensors", *run, *late)) == 0
    assert cli.main((*score, "run/policy.safetensors", "--json", "score.json")) == 0
    assert json.loads((rig / "score.json").read_text())["units"]["arm_rate"] == "rad/s"
    code = page_code()[4].replace("task=task", "task=task, iterations=1").replace("500", "30, iterations=1")
    (rig / "adapt.py").write_text(code)
    assert runpy.run_path("adapt.py")["adapted"].ledger.used == 30


@pytest.mark.parametrize(
    ("arguments", "right"),
    [
        ((), "what a furuta is to do is not known: give a task, by task= or --task"),
        (("--task", "upright.toml"), "--task: say how often the rig is commanded: --period, in s, is needed"),
        (("--task", "none.toml", "--period", "0.02"), "none.toml: cannot be read: No such file"),
        (("--task", "wrong.toml", "--period", "0.02"), "wrong.toml: tolerance: a furuta has no state 'leg': arm, pend"),
        (("--task", "upright.toml", "--period", "0.02", "--frames"), "a furuta has no renderer"),
    ],
)
def test_what_no_policy_is_trained_for_is_said(rig, capsys, arguments, right):
    (rig / "upright.toml").write_text(page_code("toml")[0])
    (rig / "wrong.toml").write_text("[tolerance]\nleg = 0.1\n")
    line = refused(capsys, "train", "--system", "furuta.py:Furuta", "--out", "policy.safetensors", *arguments)
    assert right in line
