"""A system of one's own on the command line: named by file and class, checked, and refused in one line."""

import runpy
import sys

import pytest

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
    assert "furuta is right; 46 effects act on it" in capsys.readouterr().out
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


def test_no_policy_is_trained_on_it(rig, capsys):
    line = refused(capsys, "train", "--system", "furuta.py:Furuta", "--out", "policy.safetensors")
    assert "furuta" in line
