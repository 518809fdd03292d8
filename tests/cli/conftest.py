import json

import pytest

from tests.cli.commands import GUESS, MAP, RIG, run, write_frames


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty current directory with a module of targets and a map."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(__import__("sys").modules, "rig", raising=False)
    (tmp_path / "rig.py").write_text(RIG)
    (tmp_path / "map.toml").write_text(MAP)
    return tmp_path


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """A renderer, and policies on states and on frames, of hardly any training."""
    folder = tmp_path_factory.mktemp("trained")
    frames, renderer = write_frames(folder / "frames.h5"), folder / "renderer.safetensors"
    assert run("renderer", frames, *GUESS, "--iterations", 150, "--out", renderer) == 0
    cartpole = ("train", "--system", "cartpole", "--iterations", 3)
    assert run(*cartpole, "--out", folder / "states.safetensors") == 0
    seeing = ("--renderer", renderer, "--seeing", 3)
    assert run(*cartpole, *seeing, "--out", folder / "frames.safetensors") == 0
    return folder


@pytest.fixture
def diagnosis(tmp_path):
    """Writes what `visadapt diagnose --json` writes, with the verdict and causes that a test asks for."""

    def write(causes=(("viscous_friction", {"coefficient": 2.0}),), verdict="identified", system="cartpole"):
        path = tmp_path / "diagnosis.json"
        listed = [
            {
                "effect": effect,
                "parameters": {
                    name: {"value": value, "unit": "1", "ci90": [None, None]} for name, value in values.items()
                },
                "probability": 0.9,
                "gap_closed": 0.9,
                "gap_reopened": 0.9,
                "slight": False,
                "indistinguishable_from": [],
            }
            for effect, values in causes
        ]
        recording = {"episodes": 1, "samples": 100, "period": 0.05}
        content = {"schema": 2, "system": system, "recording": recording, "verdict": verdict, "causes": listed}
        path.write_text(json.dumps({**content, "next_experiment": ""}))
        return path

    return write
