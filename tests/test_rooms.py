"""Arrows between rooms go one way: renderers <- visadapt <- datasets, experiments <- train, benchmarks."""

import ast
import re
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


def test_each_room_of_the_library_imports_only_rooms_above_it_in_the_architecture():
    page = (ROOT / "docs" / "architecture.md").read_text()
    lines = re.search(r"each\nline imports only from those above it:\n\n((?:    .*\n)+)", page)
    assert lines is not None
    order = {room: place for place, line in enumerate(lines[1].splitlines()) for room in line.split()}
    for path in (ROOT / "visadapt").rglob("*.py"):
        room = path.relative_to(ROOT / "visadapt").with_suffix("").parts[0]
        if room != "__init__":
            names = {name.split(".")[1] for name in modules(path) if name.startswith("visadapt.")} - {room}
            assert not [name for name in names if order[name] >= order[room]], path


def test_the_report_is_written_from_the_result_and_imported_by_the_command_alone():
    diagnosis = ROOT / "visadapt" / "diagnosis"
    report = "visadapt.diagnosis.report"
    for path in (diagnosis / "report").rglob("*.py"):
        of_diagnosis = {name.split(".")[2] for name in modules(path) if name.startswith("visadapt.diagnosis.")}
        assert of_diagnosis <= {"explanations", "report", "result", "words"}, path
    users = {
        path for path in (ROOT / "visadapt").rglob("*.py") if any(name.startswith(report) for name in modules(path))
    }
    outside = {path for path in users if path.parent != diagnosis / "report"}
    assert outside == {diagnosis / "result.py", ROOT / "visadapt" / "cli" / "diagnose.py"}
