import tyro

from benchmarks.all import COMMANDS, Command, described, folders, is_done, run_all, stamps
from tests.test_pages import script_of


def a_command(name, *arguments):
    return Command(name, "flight.csv", arguments, 1)


def test_what_is_done_at_a_commit_is_skipped(tmp_path):
    command, runs = a_command("tool", "json.tool", "--help"), tmp_path / "runs.json"
    assert run_all([command], tmp_path, "abc", runs) == []
    assert "usage" in (tmp_path / "tool.log").read_text()
    (tmp_path / "tool.log").unlink()
    assert is_done(command, "abc", runs)
    assert run_all([command], tmp_path, "abc", runs) == []
    assert not (tmp_path / "tool.log").exists()
    assert not is_done(command, "abd", runs)
    assert not is_done(a_command("tool", "json.tool"), "abc", runs)


def test_a_command_that_fails_leaves_no_stamp_and_the_next_one_runs(tmp_path):
    failing, fine = a_command("failing", "json.tool", "--no-such-option"), a_command("fine", "json.tool", "--help")
    runs = tmp_path / "runs.json"
    assert run_all([failing, fine], tmp_path, "abc", runs) == ["failing"]
    assert "no-such-option" in (tmp_path / "failing.log").read_text()
    assert [(name, stamp.commit) for name, stamp in stamps(runs).items()] == [("fine", "abc")]
    assert "done" in described(fine, "abc", runs)
    assert "last at abc" in described(fine, "abd", runs)


def test_commands_read_what_an_earlier_one_kept_at_the_same_commit(tmp_path):
    kept: dict = {}
    for command in COMMANDS:
        settings = script_of(command.arguments[0]).Settings
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
