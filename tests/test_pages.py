"""README.md and docs/ say what results/, the registry and the code say, and link to what is there."""

import argparse
import ast
import importlib
import json
import re
import shlex
from dataclasses import asdict, fields
from pathlib import Path

import pytest
import torch
import tyro

import visadapt as va
import visadapt.diagnosis
from benchmarks.all import COMMANDS
from benchmarks.pages import BLOCK, GENERATED, PAGES, RESULTS_PAGES, TABLES, filled
from tests.own_systems import page_code
from visadapt.cli import main
from visadapt.effects import EFFECTS
from visadapt.history import History
from visadapt.systems import CartPole
from visadapt.systems.parameter_file import load_parameters
from visadapt.targets import Target
from visadapt.targets.env_map import EnvMap
from visadapt.targets.inverted_pendulum import MAP, SOURCE, START

ROOT = Path(__file__).parents[1]
NAMES = [page.name for page in PAGES]
MODULES = re.compile(r"(?:`|^ {4})python -m ([\w.]+)([^`#\n]*)", re.MULTILINE)

COMMAND_LINES = re.compile(r"^ {4}visadapt ([^#\n]+)", re.MULTILINE)
PYTHON = re.compile(r"```python\n(.*?)```", re.DOTALL)


@pytest.fixture(autouse=True)
def _at_the_root(monkeypatch):
    monkeypatch.chdir(ROOT)


def text_of(name):
    return next(page for page in PAGES if page.name == name).read_text()


def anchors(text):
    """The links to a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", re.sub(r"```.*?```", "", text, flags=re.DOTALL), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_every_page_is_there():
    assert {"README.md", "results.md", "diagnosis.md", "own_rig.md", "effects.md", "architecture.md"} <= set(NAMES)


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_what_a_page_shows_is_what_the_script_writes(page):
    assert page.read_text() == filled(page), f"{page} differs from results/ or the registry: python -m benchmarks.pages"


def test_every_table_is_on_a_page():
    there = {match["name"] for page in PAGES for match in BLOCK.finditer(page.read_text())}
    assert there == {*TABLES, *GENERATED}


def test_a_changed_number_is_put_right(tmp_path):
    page = tmp_path / "README.md"
    page.write_text(text_of("README.md").replace("± 0.", "± 9.", 1))
    assert filled(page) == text_of("README.md") != page.read_text()


def test_every_effect_of_the_library_is_in_the_catalogue():
    page = text_of("effects.md")
    missing = [
        name for name, effect in EFFECTS.items() if effect.__module__.startswith("visadapt.") and name not in page
    ]
    assert not missing


def test_results_state_command_date_and_commit_of_every_csv():
    text = "\n".join(text_of(page) for page in RESULTS_PAGES)
    for command in COMMANDS:
        lines = [line for line in text.splitlines() if line.startswith(f"- `results/{command.table}`")]
        assert any(f"`{command.shown}`" in line for line in lines), command.name
        assert all(re.search(r"run on [\d-]+ at commit \w+|not run yet", line) for line in lines)


def test_the_readme_has_at_most_150_lines():
    assert len(text_of("README.md").splitlines()) <= 150


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_links_and_pictures_exist(page):
    text = page.read_text()
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if link.startswith("http"):
            continue
        path, _, anchor = link.partition("#")
        there = (page.parent / path).resolve() if path else page.resolve()
        assert there.exists(), f"{page}: {link}"
        if anchor:
            assert anchor in anchors(there.read_text()), f"{page}: {link}"


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_files_named_in_a_page_exist(page):
    to_be_run = {f"results/{command.table}" for command in COMMANDS}
    for name in re.findall(
        r"`((?:visadapt|renderers|datasets|train|benchmarks|tests|assets|results)/[\w/.]+)`", page.read_text()
    ):
        assert (ROOT / name).exists() or name in to_be_run, f"{page}: {name}"


def script_of(module):
    """What `python -m` runs."""
    script = importlib.import_module(module)
    return importlib.import_module(f"{module}.__main__") if hasattr(script, "__path__") else script


def commands_in_pages():
    found = {match.groups() for page in PAGES for match in MODULES.finditer(page.read_text())}
    found |= {(command.arguments[0], shlex.join(command.arguments[1:])) for command in COMMANDS}
    return sorted((module, options.strip()) for module, options in found)


@pytest.mark.parametrize(("module", "options"), commands_in_pages())
def test_commands_take_the_options_that_pages_give(module, options):
    script = script_of(module)
    parts = ast.parse(Path(script.__file__).read_text()).body
    assert any(isinstance(part, ast.If) and "__main__" in ast.unparse(part.test) for part in parts)
    if hasattr(script, "Settings"):
        with pytest.raises(SystemExit) as ended:
            tyro.cli(script.Settings, args=[*shlex.split(options), "--help"])
        assert ended.value.code == 0
        if "..." not in options:
            tyro.cli(script.Settings, args=shlex.split(options))
    else:
        assert not options


def test_every_room_is_described():
    rooms = {path.parent.relative_to(ROOT).as_posix() for path in (ROOT / "visadapt").glob("*/*.py")}
    page = text_of("architecture.md")
    assert not [room for room in rooms if f"| `{room}` |" not in page]


def test_every_key_of_the_json_is_described():
    page = text_of("diagnosis.md")
    schema = json.loads((Path(visadapt.diagnosis.__file__).parent / "schema.json").read_text())
    keys = set()

    def collect(part):
        for key, inner in part.get("properties", {}).items():
            keys.add(key)
            collect(inner)
        for inner in (part.get("items"), part.get("additionalProperties")):
            if isinstance(inner, dict):
                collect(inner)

    collect({"properties": schema["properties"]})
    missing = sorted(key for key in keys if not re.search(rf"`(?:[\w\[\].]+\.)?{key}`", page))
    assert not missing
    assert f"Version {schema['properties']['schema']['const']}." in page


def test_the_effect_of_ones_own_works():
    (code,) = (block for block in PYTHON.findall(text_of("own_rig.md")) if "class Magnet" in block)
    scope: dict = {}
    exec(compile(code, "magnet.py", "exec"), scope)
    EFFECTS.pop("magnet")
    at = torch.tensor([[0.15, 0, 0, 0], [0.2, 0, 0, 0], [0.25, 0, 0, 0]])
    force = scope["Magnet"](strength=10.0).load(torch.zeros(3), at, CartPole())[:, 0]
    assert force.sign().tolist() == [1, 0, -1]


@pytest.mark.parametrize("line", [line for page in PAGES for line in COMMAND_LINES.findall(page.read_text())])
def test_the_commands_that_pages_show_are_ones_that_the_command_line_takes(line, tmp_path, monkeypatch):
    (tmp_path / "furuta.py").write_text(page_code()[0])  # the files that must be there
    (tmp_path / "my_rig.py").write_text(page_code()[-1])
    monkeypatch.chdir(tmp_path)
    parser = argparse.ArgumentParser(exit_on_error=False)
    commands = parser.add_subparsers(required=True)
    for command in main.COMMANDS:
        command(commands.add_parser(command.__name__))
    parser.parse_args(shlex.split(line))


def test_the_rotary_pendulum_of_the_benchmarks_is_that_of_the_page():
    assert (ROOT / "experiments" / "furuta.py").read_text().partition("\n\n")[2] == page_code()[0]


def test_the_target_of_the_page_is_made():
    (code,) = (block for block in PYTHON.findall(text_of("own_rig.md")) if "def make" in block)
    scope: dict = {}
    exec(compile(code, "my_rig.py", "exec"), scope)
    assert isinstance(scope["make"](), Target)


def test_the_loop_of_the_page_balances_a_cart_pole(tmp_path):
    """As `visadapt.run` does, in a simulator of its own."""
    (code,) = (block for block in PYTHON.findall(text_of("own_rig.md")) if "def control" in block)
    scope: dict = {}
    exec(compile(code, "machine.py", "exec"), scope)
    va.export_policy(tmp_path / "policy.onnx", va.load_policy(va.shipped("cartpole_states")))
    world = va.World(CartPole())
    at = [world.start(torch.tensor([[0.2, 0.0, 0.1, 0.0]]))]

    def send(action):
        at.append(world.step(at[-1], torch.as_tensor(action)[None]))

    scope["control"](tmp_path / "policy.onnx", lambda: at[-1].state[0].numpy(), send, 200)
    assert len(at) == 201
    _, speed, angle, _ = at[-1].state[0].abs().tolist()
    assert speed < 0.01
    assert angle < 0.01


def test_the_loop_of_the_page_flies(tmp_path):
    (code,) = (block for block in PYTHON.findall(text_of("own_rig.md")) if "def control" in block)
    scope: dict = {}
    exec(compile(code, "machine.py", "exec"), scope)
    policy = va.load_policy(va.shipped("fixed_wing"))
    sent: list = []
    va.export_policy(tmp_path / "policy.onnx", policy)
    state = torch.tensor([[0.0, 0.0, 0.0, 12.0, 0.0, 0.0, 1.0, *6 * [0.0]]])
    shown = torch.cat((state, torch.tensor([[60.0, 1.0, 2.0]])), 1)
    scope["control"](tmp_path / "policy.onnx", lambda: shown[0].numpy(), sent.append, 2, commands=4)
    first = policy.act(History.start(shown, 4))[0].detach()
    assert torch.allclose(torch.as_tensor(sent[0]), first, atol=1e-5)


def test_the_rig_and_the_map_of_the_page_load(tmp_path):
    rig, mapping = re.findall(r"```toml\n(.*?)```", text_of("own_rig.md"), re.DOTALL)
    (tmp_path / "rig.toml").write_text(rig)
    for field in fields(CartPole):
        given, published = (
            getattr(rig_of, field.name) for rig_of in (load_parameters(tmp_path / "rig.toml", CartPole), SOURCE)
        )
        assert given == pytest.approx(published, rel=1e-4), field.name
    (tmp_path / "map.toml").write_text(mapping)
    shown = EnvMap.load(tmp_path / "map.toml")
    shown.check("the page's map", CartPole, n_observation=4, n_action=1)
    assert (shown.states, shown.actions, shown.crop, shown.contrast) == (
        MAP.states,
        MAP.actions,
        MAP.crop,
        MAP.contrast,
    )
    assert shown.start == asdict(START)
