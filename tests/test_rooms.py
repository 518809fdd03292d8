"""Arrows between rooms go one way: renderers <- visadapt <- datasets, train, benchmarks."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MAY_IMPORT = {
    "renderers": set(),
    "visadapt": {"renderers"},
    "datasets": {"renderers", "visadapt"},
    "train": {"renderers", "visadapt", "datasets"},
    "benchmarks": {"renderers", "visadapt", "datasets"},
}


def imported(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield node.module.partition(".")[0]
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)


@pytest.mark.parametrize("room", MAY_IMPORT)
def test_a_room_imports_none_that_is_not_below_it(room):
    others = MAY_IMPORT.keys() - MAY_IMPORT[room] - {room}
    for path in (ROOT / room).rglob("*.py"):
        assert not others & set(imported(path)), path
