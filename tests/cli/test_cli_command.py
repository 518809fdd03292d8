"""What all subcommands share: help, exit statuses, and what the wheel holds."""

import importlib
import os
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import visadapt
from tests.cli.commands import run
from tests.recorded import a_run, write
from visadapt.cli.arguments import SYSTEMS_HELP
from visadapt.cli.main import COMMANDS
from visadapt.systems import SYSTEMS

ROOT = Path(visadapt.__file__).parents[1]


def names():
    return [command.__name__ for command in COMMANDS]


@pytest.mark.parametrize("name", names())
def test_help_says_what_a_subcommand_does_and_every_option(name, capsys):
    with pytest.raises(SystemExit) as caught:
        run(name, "--help")
    assert caught.value.code == 0
    printed = capsys.readouterr().out
    assert f"usage: visadapt {name}" in printed
    parser_lines = [line for line in printed.splitlines() if line.startswith("  --") and "  " not in line[4:].strip()]
    # An option whose line holds nothing else is explained on the next.
    for line in parser_lines:
        following = printed.splitlines()[printed.splitlines().index(line) + 1]
        assert following.startswith("        "), line


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--effects", "a.py", "--effects", "b.py"), "argument --effects: given twice; one is right"),
        (("--columns", "x=a", "--columns", "theta=b,x=c"), "argument --columns: x is given twice"),
        (("--effect", "viscous_friction:coefficient=1"), "unrecognized arguments: --effect"),  # no --effects
    ],
)
def test_no_option_is_dropped_or_guessed(arguments, says, capsys):
    with pytest.raises(SystemExit) as caught:
        run("diagnose", "run.csv", "--system", "cartpole", *arguments)
    assert caught.value.code == 2
    assert says in capsys.readouterr().err


def test_help_needs_no_torch():
    script = "import sys; sys.modules['torch'] = None; from visadapt.cli.main import main; main()"
    for arguments in (["--help"], ["train", "--help"]):
        done = subprocess.run(
            [sys.executable, "-c", script, *arguments],
            capture_output=True,
            text=True,
            env={"PYTHONPATH": str(ROOT)},
            check=False,
        )
        assert (done.returncode, done.stderr) == (0, "")
        assert all(name in done.stdout for name in (names() if len(arguments) == 1 else ["--period"]))


def test_the_systems_that_help_names_are_those_there_are():
    assert SYSTEMS_HELP.replace(" or ", ", ").split(", ") == [*SYSTEMS]


def test_without_a_subcommand_or_with_an_unknown_one(capsys):
    for arguments in ((), ("fly",)):
        with pytest.raises(SystemExit) as caught:
            run(*arguments)
        assert caught.value.code == 2


def test_a_bug_is_not_taken_for_bad_input(monkeypatch):
    def broken(system):
        raise ZeroDivisionError

    monkeypatch.setattr("visadapt.cli.effects.catalogue_text", broken)
    with pytest.raises(ZeroDivisionError):
        run("effects")


@pytest.mark.parametrize(
    ("sent", "status", "says"),
    [(signal.SIGINT, 130, "visadapt: interrupted\n"), (signal.SIGTERM, 143, "")],
)
def test_interrupted_or_ended_it_says_so_in_a_line_and_leaves_nothing(tmp_path, sent, status, says):
    write(tmp_path / "run.csv", a_run(0.1, 1e-3))
    script = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "from visadapt.cli.main import main; sys.exit(main())"
    )
    arguments = ("diagnose", "run.csv", "--system", "cartpole", "--jobs", "2", "--json", "a.json")
    begun = subprocess.Popen(
        [sys.executable, "-c", script, *arguments],
        cwd=tmp_path,
        env={"PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert begun.stderr is not None
    assert "200 rows of 4 channels" in begun.stderr.readline()
    os.killpg(begun.pid, sent)
    printed, told = begun.communicate(timeout=60)
    assert (begun.returncode, printed, told) == (status, "", says)
    assert [path.name for path in tmp_path.iterdir()] == ["run.csv"]


def test_whoever_closes_the_output_early_is_not_told_of_it():
    script = "from visadapt.cli.main import main; import sys; sys.exit(main(['effects']))"
    done = subprocess.run(
        f'"{sys.executable}" -c "{script}" | head -1',
        shell=True,
        capture_output=True,
        text=True,
        env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"},
        check=False,
    )
    assert "(actuation)" in done.stdout
    assert done.stderr == ""


def test_the_wheel_holds_the_command_and_the_weights():
    content = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert content["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"] == ["visadapt", "renderers"]
    module, _, function = content["project"]["scripts"]["visadapt"].partition(":")
    assert callable(getattr(importlib.import_module(module), function))
    assert any(line.startswith("gymnasium>=") for line in content["project"]["dependencies"])
    # hatch leaves out of a package what git ignores.
    weights = sorted((ROOT / "visadapt" / "weights").glob("*.safetensors"))
    assert [path.stem for path in weights] == [
        "cartpole_frames",
        "cartpole_states",
        "fixed_wing",
        "quadrotor",
        "renderer",
    ]
    ignored = (ROOT / ".gitignore").read_text().split()
    assert not any("weights" in line or "safetensors" in line for line in ignored)
