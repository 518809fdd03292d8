"""Arrows between rooms go one way: renderers <- visadapt <- datasets, experiments <- train, benchmarks."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MAY_IMPORT = {
    "renderers": set(),
    "visadapt": {"renderers"},
    "datasets": {"renderers", "visadapt"},
    "experiments": {"renderers", "visadapt"},
    "train": {"renderers", "visadapt", "datasets", "experiments"},
    "benchmarks": {"renderers", "visadapt", "datasets", "experiments"},
}


def modules(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def imported(path):
    return {name.partition(".")[0] for name in modules(path)}


@pytest.mark.parametrize("room", MAY_IMPORT)
def test_a_room_imports_none_that_is_not_below_it(room):
    others = MAY_IMPORT.keys() - MAY_IMPORT[room] - {room}
    for path in (ROOT / room).rglob("*.py"):
        assert not others & imported(path), path


def test_the_rooms_of_the_library_import_each_other_one_way():
    """Otherwise no order of the rooms exists in which a newcomer could read them."""
    below: dict[str, set[str]] = {}
    for path in (ROOT / "visadapt").rglob("*.py"):
        room = path.relative_to(ROOT / "visadapt").with_suffix("").parts[0]
        if room != "__init__":
            names = {name for name in modules(path) if name.startswith("visadapt.")}
            below.setdefault(room, set()).update({name.split(".")[1] for name in names} - {room})
    while below:
        lowest = {room for room in below if not below[room] & below.keys()}
        assert lowest, f"these rooms import each other: {', '.join(sorted(below))}"
        below = {room: below[room] for room in below.keys() - lowest}
