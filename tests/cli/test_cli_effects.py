import pytest

from tests.cli.commands import refused, run
from tests.cli.test_cli_diagnose import OWN_EFFECT
from visadapt.effects import EFFECTS


def test_the_catalogue_says_stage_equation_unit_and_range(capsys):
    assert run("effects") == 0
    printed = capsys.readouterr().out
    for text in ("viscous_friction (dynamics)", "rotor_drag (dynamics)", "F = -coefficient v", "N s/m"):
        assert text in printed


def test_the_catalogue_of_one_system(capsys):
    assert run("effects", "--system", "cartpole") == 0
    printed = capsys.readouterr().out
    assert "viscous_friction (dynamics)" in printed
    assert "rotor_drag" not in printed


def test_effects_of_one_s_own_are_listed(capsys, tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(OWN_EFFECT.format(name="Listed", effect="test_cli_listed"))
    try:
        assert run("effects", "--system", "cartpole", "--effects", path) == 0
        assert "test_cli_listed (dynamics)" in capsys.readouterr().out
    finally:
        EFFECTS.pop("test_cli_listed", None)


def test_what_it_refuses(capsys, tmp_path):
    assert "none.py: there is no such file" in refused(capsys, "effects", "--effects", tmp_path / "none.py")
    with pytest.raises(SystemExit) as caught:
        run("effects", "--system", "unicycle")
    assert caught.value.code == 2
    assert "there is no system 'unicycle'; there are cartpole, quadrotor, fixed_wing" in capsys.readouterr().err
