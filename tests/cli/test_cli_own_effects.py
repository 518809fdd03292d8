"""A file of effects of the user's own is tried before anything is searched: one line says what is wrong."""

import inspect
import sys

import pytest

from tests.cli.commands import refused, run
from tests.own_systems import Winch
from tests.recorded import a_run, write
from visadapt.effects import EFFECTS

EFFECT = """
import sys
import numpy as np
import torch
import visadapt as va

class Mine(va.DynamicsEffect):
    name = "test_mine"
    systems = (va.CartPole,)
    equation = "F = strength"
    source = "a test"
    table = (va.Parameter("strength", "N", -1.0, 1.0, 0.0, linear=True),)

    def load(self, time, state, system):
        force = self.value("strength", state).expand_as(time)
        return torch.stack((force, torch.zeros_like(force)), 1)
"""
RIGID = "import sys\nfrom visadapt.systems.rigid_body import RigidBody"
WRENCH = "return torch.zeros(len(state), len(system.loads), dtype=state.dtype) + force[:, None]"
RETURN = "return torch.stack((force, torch.zeros_like(force)), 1)"


@pytest.fixture(autouse=True)
def forgotten(tmp_path):
    before = dict(EFFECTS)
    yield
    EFFECTS.clear()
    EFFECTS.update(before)
    for name, module in list(sys.modules.items()):
        if str(getattr(module, "__file__", "")).startswith(str(tmp_path)):
            del sys.modules[name]


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (EFFECT, "x = 1", "mine.py: defines no effect: a class with a name that derives from visadapt.Effect"),
        (EFFECT, "import sys\nsys.exit()", "mine.py: line 2: SystemExit: it ends the program"),
        (EFFECT, "class E(BaseException): pass\nraise E('off')", "mine.py: line 2: E: off"),
        ('    name = "test_mine"\n', "", "mine.py: defines no effect"),
        ('"test_mine"', '"a <b>"', "Mine: name is 'a <b>'; a word such as magnet_force is right"),
        ('    equation = "F = strength"\n', "", "Mine: has no equation"),
        ('"a test"', "None", "Mine: has no source"),
        ("va.CartPole,", "va.Quadrotor,", "mine.py: none of its effects acts on a cartpole"),
        ("va.DynamicsEffect", "va.Effect", "Mine: acts nowhere: derive it from ActuationEffect, DynamicsEffect or"),
        ("-1.0, 1.0", "1.0, -1.0", "Mine: strength goes from 1.0 to -1.0; two finite numbers, the lower first"),
        ("-1.0, 1.0", "-1.0, float('nan')", "Mine: strength goes from -1.0 to nan"),
        ("0.0, linear", "5.0, linear", "Mine: strength is neutral at 5.0; a value from -1.0 to 1.0 is right"),
        ('(va.Parameter("strength", "N", -1.0, 1.0, 0.0, linear=True),)', "()", "Mine: table is ()"),
        ("linear=True),)", "linear=True),) * 2", "Mine: table has 'strength' twice"),
        ('self.value("strength"', 'self.value("size"', "Mine: raises AttributeError: 'Mine' object has no attribute"),
        (RETURN, "raise RuntimeError('off')", "Mine: raises RuntimeError: off ("),
        (RETURN, "sys.exit(0)", "mine.py: line 16: SystemExit: it ends the program"),
        (RETURN, "return None", "Mine: load returns a NoneType; a tensor (5, 2) is right"),
        (RETURN, "return force[:, None]", "Mine: load returns the shape (5, 1); a tensor (5, 2) is right"),
        (RETURN, "return np.zeros((len(state), 2))", "Mine: load returns a ndarray; a tensor (5, 2) is right"),
        (RETURN, "return state[:, :2] / 0", "Mine: load gives a number that is not finite"),
        (RETURN, "return state[:, :2].float()", "Mine: load turns torch.float64 into torch.float32"),
        (
            RETURN,
            "if len(state) > 5: raise RuntimeError('late')\n        return 0 * state[:, :2]",
            "mine.py: line 16: RuntimeError: late",
        ),
    ],
)
def test_refused(here, capsys, old, new, says):
    assert old in EFFECT
    write(here / "run.csv", a_run(0.1, 1e-3, rows=60))
    (here / "mine.py").write_text(EFFECT.replace(old, new))
    assert says in refused(capsys, "diagnose", "run.csv", "--system", "cartpole", "--effects", "mine.py")


def test_a_right_one_is_listed(here, capsys):
    (here / "mine.py").write_text(EFFECT)
    assert run("effects", "--system", "cartpole", "--effects", "mine.py") == 0
    assert "F = strength" in capsys.readouterr().out


def test_one_for_every_vehicle_and_the_cart_pole(here, capsys):
    systems = "systems = (va.CartPole, RigidBody)"
    text = EFFECT.replace("systems = (va.CartPole,)", systems).replace("import sys", RIGID).replace(RETURN, WRENCH)
    (here / "mine.py").write_text(text)
    assert run("effects", "--effects", "mine.py") == 0
    assert "F = strength" in capsys.readouterr().out


def test_one_for_the_system_of_its_own_file_or_of_another(here, capsys):
    body = inspect.getsource(Winch).replace("(System)", "(va.System)").replace("Variable", "va.Variable")
    head = "from dataclasses import dataclass\nfrom typing import ClassVar\n"
    text = EFFECT.replace("va.CartPole", "Winch").replace(RETURN, "return force[:, None]")
    (here / "winch.py").write_text(head + "import torch\nimport visadapt as va\n" + body)
    (here / "mine.py").write_text("from winch import Winch\n" + text)
    (here / "both.py").write_text(head + text.replace("class Mine", body + "\n\nclass Mine", 1))
    for system, effects in (("winch.py", "mine.py"), ("both.py", "both.py")):
        assert run("effects", "--system", f"{system}:Winch", "--effects", effects) == 0
        assert "F = strength" in capsys.readouterr().out


@pytest.mark.parametrize("ended", ["raise SystemExit(0)", "class E(BaseException): pass\n    raise E"])
def test_a_target_that_ends_the_program(here, capsys, trained, ended, monkeypatch):
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    (here / "mine.py").write_text(f"def made():\n    {ended}\n")
    line = refused(capsys, "score", "--policy", trained / "states.safetensors", "--target", "mine:made")
    assert f"{here / 'mine.py'}, line" in line
