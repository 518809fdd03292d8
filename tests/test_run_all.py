import importlib
import json

import tyro

from benchmarks.all import COMMANDS, Command, Stamp, described, folders, is_done, run_all


def a_command(name, *arguments):
    return Command(name, "flight.csv", arguments, 1)


def test_what_is_done_at_a_commit_is_skipped(tmp_path):
    command = a_command("tool", "json.tool", "--help")
    assert run_all([command], tmp_path, "abc") == []
    assert "usage" in (tmp_path / "tool.log").read_text()
    (tmp_path / "tool.log").unlink()
    assert is_done(command, tmp_path, "abc")
    assert run_all([command], tmp_path, "abc") == []
    assert not (tmp_path / "tool.log").exists()
    assert not is_done(command, tmp_path, "abd")
    assert not is_done(a_command("tool", "json.tool"), tmp_path, "abc")


def test_a_command_that_fails_leaves_no_stamp_and_the_next_one_runs(tmp_path):
    failing, fine = a_command("failing", "json.tool", "--no-such-option"), a_command("fine", "json.tool", "--help")
    assert run_all([failing, fine], tmp_path, "abc") == ["failing"]
    assert not (tmp_path / "failing.json").exists()
    assert "no-such-option" in (tmp_path / "failing.log").read_text()
    assert Stamp(**json.loads((tmp_path / "fine.json").read_text())).commit == "abc"
    assert "done" in described(fine, tmp_path, "abc")
    assert "last at abc" in described(fine, tmp_path, "abd")


def test_commands_read_what_an_earlier_one_kept_at_the_same_commit(tmp_path):
    kept: dict = {}
    for command in COMMANDS:
        settings = importlib.import_module(command.arguments[0]).Settings
        given = tyro.cli(settings, args=[*command.arguments[1:], *folders(command, tmp_path, "abc")])
        for option, name in command.reads:
            assert getattr(given, option.removeprefix("--")) == kept[name]
        if command.work:
            kept[command.name] = getattr(given, command.work.removeprefix("--"))
            assert kept[command.name].is_relative_to(tmp_path / "abc")
    assert len(kept) == len(set(kept.values()))


def test_every_command_has_a_name_of_its_own():
    names = [command.name for command in COMMANDS]
    assert len(set(names)) == len(names)
