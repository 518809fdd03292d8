"""No input is overwritten, and outputs are checked before the work: one line, exit status 2, every file as it was."""

import os

import pytest

from tests.cli.commands import refused
from tests.recorded import a_table, write

DIAGNOSE = ("diagnose", "run.csv", "--system", "cartpole", "--params", "rig.toml")
SCORE = ("score", "--policy", "policy.safetensors", "--target", "rig:states")
ADAPT = ("adapt", "--policy", "kept/policy.safetensors", "--target", "rig:states")
EFFECTS = ("--effects", "mine.py")


@pytest.fixture
def files(here):
    """Inputs, links to them, and what is no file; with what each file holds."""
    write(here / "run.csv", a_table())
    (here / "kept").mkdir()
    for name in ("rig.toml", "mine.py", "policy.safetensors", "kept/policy.safetensors", "old.json"):
        (here / name).write_text("kept")
    (here / "link").symlink_to("run.csv")
    os.link(here / "run.csv", here / "hard")
    yield here
    assert (here / "run.csv").read_bytes() == (here / "hard").read_bytes()
    assert all((here / name).read_text() == "kept" for name in ("rig.toml", "mine.py", "kept/policy.safetensors"))


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ((*DIAGNOSE, "--json", "run.csv"), "--json: run.csv is the file of RECORDING, which would be lost"),
        ((*DIAGNOSE, "--report", "run.csv"), "--report: run.csv is the file of RECORDING"),
        ((*DIAGNOSE, "--json", "kept/../run.csv"), "run.csv is the file of RECORDING"),
        ((*DIAGNOSE, "--json", "link"), "link is the file of RECORDING"),
        ((*DIAGNOSE, "--json", "hard"), "hard is the file of RECORDING"),
        ((*DIAGNOSE, "--json", "rig.toml"), "rig.toml is the file of --params"),
        ((*DIAGNOSE, *EFFECTS, "--json", "mine.py"), "mine.py is the file of --effects"),
        ((*DIAGNOSE, "--policy", "policy.safetensors", "--json", "policy.safetensors"), "is the file of --policy"),
        ((*DIAGNOSE, "--json", "new", "--report", "./new"), "--report: ./new is the file of --json"),
        (("diagnose", ".", "--system", "cartpole", "--json", "run.csv"), "run.csv is the file of RECORDING"),
        ((*DIAGNOSE, "--json", "kept"), "kept cannot be written: it is a folder"),
        ((*DIAGNOSE, "--report", "run.csv/a.html"), "run.csv/a.html cannot be written: Not a directory"),
        ((*DIAGNOSE, "--json", "a" * 300), "cannot be written: File name too long"),
        ((*SCORE, "--film", "rig.py"), "--film: rig.py is the file of --target"),
        ((*SCORE, "--json", "policy.safetensors"), "policy.safetensors is the file of --policy"),
        ((*ADAPT, "--out", "kept"), "--out: kept is the folder of --policy, which would be lost"),
        (("train", "--system", "cartpole", "--params", "rig.toml", "--out", "rig.toml"), "is the file of --params"),
        ((*DIAGNOSE, "--json", ""), "--json: is empty; leave it out"),
        (("diagnose", "", "--system", "cartpole"), "RECORDING: is empty"),
        (("diagnose", "run.csv", "--system", "cartpole", "--params", ""), "--params: is empty"),
        (("diagnose", "a\0b", "--system", "cartpole"), "RECORDING: holds a NUL"),
        ((*DIAGNOSE, "--policy", "a\0b"), "--policy: holds a NUL"),
        (("diagnose", "\x1b[31m\n.csv", "--system", "cartpole"), r"visadapt: \x1b[31m\n.csv: there is no such file"),
    ],
)
def test_refused(files, capsys, arguments, says):
    assert says in refused(capsys, *arguments)


def test_an_unknown_argument_sends_no_terminal_its_control_characters(files, capsys):
    with pytest.raises(SystemExit):
        refused(capsys, *DIAGNOSE, "--\x1b[31m")
    assert r"unrecognized arguments: --\x1b[31m" in capsys.readouterr().err
