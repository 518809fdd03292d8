import io
import json
import os
import subprocess
import sys
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import torch

from tests.diagnosis.test_report import SCHEMA, a_diagnosis
from visadapt import diagnosis
from visadapt.cli import main as cli
from visadapt.effects import EFFECTS
from visadapt.policies import ImagePolicy, StatePolicy
from visadapt.setups.policy_file import save_policy
from visadapt.systems import CartPole

RIG = Path(__file__).parents[3] / "shared" / "recordings" / "physical-cartpole"
RIG_PARAMETERS = (
    "[parameters]\ncart_mass = 0.230\npole_mass = 0.087\npole_half_length = 0.1975\nmax_force = 1.77\ngravity = 9.81\n"
)
OWN_EFFECT = """
from visadapt.effects import Parameter
from visadapt.effects.forces import CartForce

class {name}(CartForce):
    name = "{effect}"
    equation = "F = strength"
    source = "a test"
    table = (Parameter("strength", "N", -1.0, 1.0, 0.0),)

    def push(self, time, state, system):
        return self.value("strength", state).expand_as(time)
"""


@pytest.fixture
def recording(tmp_path):
    """A cart that is pushed to and fro, as a file."""
    time = np.arange(200) * 0.05
    columns = {
        "time": time,
        "x": 0.3 * np.sin(2 * time),
        "theta": 0.01 * np.sin(5 * time),
        "command": 0.5 * np.sin(7 * time),
    }
    path = tmp_path / "run.csv"
    np.savetxt(path, np.column_stack(list(columns.values())), delimiter=",", header=",".join(columns), comments="")
    return path


@pytest.fixture
def stub(monkeypatch):
    """A diagnosis that is there at once, and what it was asked."""
    asked: dict = {}

    def diagnose(
        recording, world, catalogue=None, seed=0, jobs=1, progress=None, policy=None, announce=None, renderer=None
    ):
        asked.update(recording=recording, world=world, seed=seed, jobs=jobs, policy=policy)
        announce("400 rows of 2 channels, 24 effects: about 9 s on 1 core")
        progress("fitting", 1, 1, 0.5)
        print("chatter")
        return a_diagnosis("identified", warnings=recording.warnings)

    monkeypatch.setattr(diagnosis, "diagnose", diagnose, raising=False)
    return asked


def run(*arguments):
    return cli.main(["diagnose", *map(str, arguments), "--system", "cartpole"])


class TestCommand:
    def test_the_verdict_and_nothing_else_on_stdout(self, recording, stub, capsys):
        assert run(recording) == 0
        printed = capsys.readouterr()
        assert printed.out.startswith("identified: Friction patch (start")
        assert "chatter" not in printed.out
        assert "fitting" in printed.err
        assert "about 9 s on 1 core" in printed.err

    def test_what_the_diagnosis_is_asked(self, recording, stub):
        other = recording.with_name("other.csv")
        other.write_text("\n".join(recording.read_text().splitlines()[:-1]))
        assert run(recording, other, "--seed", 3, "--jobs", 2) == 0
        assert (stub["seed"], stub["jobs"]) == (3, 2)
        assert len(stub["recording"].episodes) == 2
        assert stub["world"].period == pytest.approx(0.05)
        assert stub["world"].system == CartPole()

    def test_a_rig_of_one_s_own(self, recording, stub, tmp_path):
        rig = tmp_path / "rig.toml"
        rig.write_text(RIG_PARAMETERS)
        assert run(recording, "--params", rig) == 0
        assert stub["world"].system == CartPole(0.23, 0.087, 0.1975, 1.77, 9.81)

    def test_columns(self, recording, stub):
        recording.write_text(recording.read_text().replace("theta", "phi").replace("command", "volts"))
        assert run(recording, "--columns", "theta=phi", "--columns", " x=x, command=volts") == 0
        assert stub["recording"].measured == ("x", "theta")

    def test_json_and_report(self, recording, stub, tmp_path):
        json_path, page = tmp_path / "out" / "a.json", tmp_path / "out" / "a.html"
        assert run(recording, "--json", json_path, "--report", page, "--seed", 7) == 0
        jsonschema.Draft202012Validator(SCHEMA).validate(json.loads(json_path.read_text()))
        text = page.read_text()
        assert text.startswith("<!doctype html>")
        for setting in (str(recording), "CartPole(cart_mass=1.0", "<td>7</td>", f"torch {torch.__version__}"):
            assert setting in text

    def test_equal_diagnoses_write_equal_files(self, recording, stub, tmp_path, monkeypatch):
        written = []
        for clock in (iter(range(1000)), iter(range(0, 10**6, 1000))):
            monkeypatch.setattr("time.perf_counter", lambda clock=clock: float(next(clock)))
            assert run(recording, "--json", tmp_path / "a.json", "--report", tmp_path / "a.html") == 0
            written.append([(tmp_path / name).read_bytes() for name in ("a.json", "a.html")])
        assert written[0] == written[1]

    def test_whoever_stops_reading_the_verdict_still_gets_the_files(self, recording, stub, tmp_path, monkeypatch):
        reading, writing = os.pipe()
        os.close(reading)
        files = [tmp_path / "found.json", tmp_path / "found.html"]
        with os.fdopen(writing, "w", buffering=1) as closed, monkeypatch.context() as patched:
            patched.setattr(sys, "stdout", closed)
            assert run(recording, "--json", files[0], "--report", files[1]) == 0
        assert all(file.exists() for file in files)

    def test_a_name_that_the_terminal_s_encoding_lacks_is_escaped(self, recording, stub, tmp_path, monkeypatch):
        terminal = io.TextIOWrapper(io.BytesIO(), encoding="cp1252")
        with monkeypatch.context() as patched:
            patched.setattr(sys, "stdout", terminal)
            assert run(recording, "--plan", tmp_path / "θ.csv") == 0
        assert rb"\u03b8.csv was not written" in terminal.buffer.getvalue()

    def test_a_plan_where_nothing_is_open(self, recording, stub, tmp_path, capsys):
        path = tmp_path / "plan.csv"
        assert run(recording, "--plan", path) == 0
        assert "--plan: nothing to settle, the verdict is identified" in capsys.readouterr().out
        assert not path.exists()

    def test_a_plan_for_a_pole_that_falls_needs_the_policy(self, recording, monkeypatch, tmp_path, capsys):
        monkeypatch.setattr(diagnosis, "diagnose", lambda *given, **asked: a_diagnosis("ambiguous"))
        path = tmp_path / "plan.csv"
        assert run(recording, "--plan", path) == 0
        said = capsys.readouterr().out
        assert "under every excitation: give the policy of the rig; " in said
        assert f"{path} was not written" in said
        assert not path.exists()

    def test_effects_of_one_s_own(self, recording, stub, tmp_path):
        path = tmp_path / "mine.py"
        path.write_text(OWN_EFFECT.format(name="Mine", effect="test_cli_mine"))
        try:
            assert run(recording, "--effects", path) == 0
            assert EFFECTS["test_cli_mine"].__module__ in sys.modules
        finally:
            EFFECTS.pop("test_cli_mine", None)

    @pytest.mark.parametrize("with_history", [False, True])
    def test_a_policy(self, recording, stub, tmp_path, with_history):
        policy, path = StatePolicy(4, with_history=with_history), tmp_path / "policy.safetensors"
        save_policy(path, policy)
        assert run(recording, "--policy", path) == 0
        assert stub["policy"].with_history == with_history
        assert all(torch.equal(a, b) for a, b in zip(stub["policy"].parameters(), policy.parameters(), strict=True))

    def test_a_policy_of_another_period_is_refused(self, recording, stub, tmp_path, capsys):
        policy, path = StatePolicy(4), tmp_path / "policy.safetensors"
        policy.trained_in = {"period": 0.02}
        save_policy(path, policy)
        assert run(recording, "--policy", path) == 2
        said = capsys.readouterr().err
        assert "policy.safetensors was trained for 0.02 s between commands, the recording has 0.05 s" in said

    def test_as_a_program(self, tmp_path):
        command = [sys.executable, "-c", "import sys; from visadapt.cli.main import main; sys.exit(main())"]
        answer = subprocess.run(
            [*command, "diagnose", str(tmp_path / "none.csv"), "--system", "cartpole"],
            capture_output=True,
            text=True,
            cwd=Path(__file__).parents[2],
            check=False,
        )
        assert answer.returncode == 2
        assert answer.stdout == ""
        assert answer.stderr == f"visadapt: {tmp_path / 'none.csv'}: there is no such file or folder\n"


class TestBadInput:
    def refuses(self, capsys, message, *arguments):
        assert run(*arguments) == 2
        printed = capsys.readouterr()
        assert printed.out == ""
        assert message in printed.err
        assert printed.err.startswith("visadapt: ")
        assert printed.err.count("\n") == 1

    def test_recordings(self, recording, stub, capsys, tmp_path):
        self.refuses(capsys, "run.csv: has no column 'y' for x", recording, "--columns", "x=y")
        torn = tmp_path / "torn"
        torn.mkdir()
        (torn / "a.csv").write_text(recording.read_text())
        (torn / "b.csv").write_text(recording.read_text()[:-70])
        self.refuses(capsys, "b.csv: row 200 (line 201) is cut short", torn)

    def test_rigs(self, recording, stub, capsys, tmp_path):
        rig = tmp_path / "rig.toml"
        rig.write_text("[parameters]\ncart_mass = -1.0\n")
        self.refuses(capsys, "rig.toml: cartpole: cart_mass must be positive, got -1.0", recording, "--params", rig)
        rig.write_text("[parameters]\nmass = 1.0\n")
        self.refuses(capsys, "rig.toml: unknown key 'mass'", recording, "--params", rig)

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("x = (", "mine.py: line 1: SyntaxError: '(' was never closed"),
            ("import visadapt\n\n1 / 0\n", "mine.py: line 3: ZeroDivisionError: division by zero"),
            ("open('/nowhere/at/all')\n", "mine.py: line 1: FileNotFoundError"),
            (OWN_EFFECT.format(name="Mine", effect="constant_force"), "the effect name 'constant_force' is taken"),
        ],
    )
    def test_effects(self, recording, stub, capsys, tmp_path, text, message):
        path = tmp_path / "mine.py"
        path.write_text(text)
        self.refuses(capsys, message, recording, "--effects", path)

    def test_no_effects_file(self, recording, stub, capsys, tmp_path):
        self.refuses(capsys, "none.py: there is no such file", recording, "--effects", tmp_path / "none.py")
        self.refuses(capsys, "a name that ends in .py is right", recording, "--effects", recording)

    def test_policies(self, recording, stub, capsys, tmp_path):
        path = tmp_path / "policy.safetensors"
        self.refuses(capsys, "policy.safetensors: there is no such checkpoint", recording, "--policy", path)
        path.write_bytes(b"torn")
        self.refuses(capsys, "policy.safetensors: not a complete safetensors file", recording, "--policy", path)
        save_policy(path, ImagePolicy(torch.zeros(100, 120), 1.0))
        self.refuses(
            capsys, "is shown the frame of a target; a policy on states alone is needed", recording, "--policy", path
        )
        save_policy(path, StatePolicy(7))
        self.refuses(
            capsys,
            "policy.safetensors: a policy of 7 states and 1 commands; a cartpole has 4 and 1",
            recording,
            "--policy",
            path,
        )

    def test_where_nothing_can_be_written(self, recording, stub, tmp_path, capsys):
        blocked = tmp_path / "file"
        blocked.write_text("")
        assert run(recording, "--json", blocked / "a.json") == 2
        assert capsys.readouterr().err.splitlines()[-1].startswith("visadapt: ")

    @pytest.mark.parametrize(
        "arguments",
        [
            ["--columns", "x"],
            ["--columns", "x=a,x=b"],
            ["--columns", "=a"],
            ["--jobs", "0"],
            ["--jobs", "many"],
            ["--seed", "a"],
            ["--seed", "9" * 30],
            ["--jobs", "9" * 5000],
            ["--system", "unicycle"],
        ],
    )
    def test_arguments(self, recording, stub, capsys, arguments):
        with pytest.raises(SystemExit) as caught:
            cli.main(["diagnose", str(recording), "--system", "cartpole", *arguments])
        assert caught.value.code == 2
        assert f"argument {arguments[0]}" in capsys.readouterr().err


class TestDiagnosis:
    @pytest.mark.skipif(not RIG.is_dir(), reason="the recordings of the real rig are not here")
    def test_the_real_rig(self, tmp_path, capsys):
        rig, out, page = tmp_path / "rig.toml", tmp_path / "a.json", tmp_path / "a.html"
        rig.write_text(RIG_PARAMETERS)
        whole = min((RIG / "train").glob("*.csv"))
        part = tmp_path / "part.csv"  # 2 s: the search takes minutes on all
        part.write_text("".join(whole.read_text().splitlines(keepends=True)[:102]))
        assert run(part, "--params", rig, "--json", out, "--report", page) == 0
        content = json.loads(out.read_text())
        jsonschema.Draft202012Validator(SCHEMA).validate(content)
        assert content["verdict"] != "no_gap"
        assert capsys.readouterr().out.startswith(content["verdict"])
        assert page.read_text().startswith("<!doctype html>")
