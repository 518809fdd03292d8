"""Logs of robots: the same motion as a bag of ROS 1, as one of ROS 2 and as ULog, each topic with its own stamps."""

import sqlite3
from contextlib import closing

import numpy as np
import pytest
from rosbags import rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tests.cli.commands import refused
from tests.logs import LATE, PERIOD, PX4, ROS, ROWS, START, motion, ros_bag, ulog
from visadapt.recordings import RecordingError, load_recording
from visadapt.systems import CartPole

LOGS = {
    "ROS 1": (lambda folder: ros_bag(folder / "run.bag", 1), ROS | {"command": "/motor/command.temperature"}),
    "ROS 2": (lambda folder: ros_bag(folder / "run", 2), ROS | {"command": "/motor/command.temperature"}),
    "ROS 2, a command without header": (lambda folder: ros_bag(folder / "run", 2, stamped=False), ROS),
    "ULog": (lambda folder: ulog(folder / "run.ulg"), PX4),
}


@pytest.mark.parametrize("kind", LOGS)
def test_readings_are_rows_and_commands_are_what_was_held_between_them(kind, tmp_path):
    make, columns = LOGS[kind]
    found = load_recording(make(tmp_path), CartPole(), columns)
    (episode,) = found.episodes
    # The first reading comes before any command, and the last one after all but one.
    state, _ = motion(PERIOD * np.arange(1, ROWS))
    commands = np.sin(7 * (PERIOD * np.arange(ROWS) + LATE - LATE))
    np.testing.assert_allclose(episode.state, state, atol=1e-9)
    np.testing.assert_allclose(episode.time, PERIOD * np.arange(ROWS - 1), atol=1e-6)
    share = LATE / PERIOD
    held = share * commands[:-1] + (1 - share) * commands[1:]
    np.testing.assert_allclose(episode.action[:-1, 0], held[: ROWS - 2], atol=1e-4)
    assert "rows are the readings of " in " ".join(found.warnings)


FIELDS = {"x": "/x.data", "theta": "/theta.data", "command": "/u.data"}


def numbers(path, stamps):
    """A bag of ROS 2 with a number at each of a topic's stamps, in s."""
    store = get_typestore(Stores.LATEST)
    number = store.types["std_msgs/msg/Float64"]
    with rosbag2.Writer(path, version=9) as writer:
        for topic, times in stamps.items():
            connection = writer.add_connection(topic, "std_msgs/msg/Float64", typestore=store)
            for time in times:
                # The angle passes the turn at 3 rad, as an encoder's does.
                angle = (2 * time + 3 + np.pi) % (2 * np.pi) - np.pi
                value = {"/x": time, "/theta": angle, "/u": 0.5 if time > -0.1 else np.nan}[topic]
                raw = store.serialize_cdr(number(value), "std_msgs/msg/Float64")
                writer.write(connection, int(1e9 * (START + time)), raw)
    return path


def test_a_slower_topic_gives_the_rows_and_the_others_are_interpolated(tmp_path):
    stamps = {"/x": np.arange(0, 3, 0.05), "/theta": np.arange(0, 3, 0.005), "/u": np.arange(0, 3, 0.05)}
    found = load_recording(numbers(tmp_path / "run", stamps), CartPole(), FIELDS)
    (episode,) = found.episodes
    turned = episode.state[:, 1] - 2 * episode.state[:, 0]
    np.testing.assert_allclose(turned, turned[0], atol=1e-5)
    np.testing.assert_allclose(episode.action, 0.5)
    assert "/theta is interpolated" in " ".join(found.warnings)


def test_fields_in_other_units_are_converted_before_they_are_interpolated(tmp_path):
    stamps = {"/x": np.arange(0, 4, 0.05), "/theta": np.arange(-0.02, 4.1, 0.013), "/u": np.arange(0, 4, 0.05)}
    path = numbers(tmp_path / "bag", stamps)
    (plain,) = load_recording(path, CartPole(), FIELDS).episodes
    given = {**FIELDS, "x": "/x.data*0.5", "theta": "/theta.data*-1", "command": "/u.data/2"}
    (found,) = load_recording(path, CartPole(), given).episodes
    np.testing.assert_allclose(found.state, plain.state * [0.5, -1], atol=1e-9)
    np.testing.assert_allclose(found.action, plain.action / 2)


def test_commands_before_the_first_row_count_for_nothing(tmp_path):
    steady = np.arange(0, 3, 0.05)  # an actuator that is not armed yet is commanded nan
    stamps = {"/x": steady, "/theta": steady, "/u": np.arange(-1, 3, 0.05)}
    (episode,) = load_recording(numbers(tmp_path / "run", stamps), CartPole(), FIELDS).episodes
    np.testing.assert_allclose(episode.action, 0.5)


@pytest.mark.parametrize("alone", [["/x"], ["/theta"], ["/x", "/theta"]])
def test_a_topic_with_a_single_reading_is_refused(alone, tmp_path):
    stamps = dict.fromkeys(["/x", "/theta", "/u"], np.arange(0, 3, 0.05)) | dict.fromkeys(alone, np.ones(1))
    with pytest.raises(RecordingError, match=r"run: /\w+ has a single message; readings all along are right"):
        load_recording(numbers(tmp_path / "run", stamps), CartPole(), FIELDS)


@pytest.mark.parametrize("sent", [[0.0], [0.0, 0.01, 0.02, 1.0]])
def test_a_command_that_is_sent_when_it_changes_holds_to_the_end(sent, tmp_path):
    steady = np.arange(0, 3, 0.05)
    stamps = {"/x": steady, "/theta": steady, "/u": np.array(sent)}
    (episode,) = load_recording(numbers(tmp_path / "run", stamps), CartPole(), FIELDS).episodes
    assert len(episode.time) == len(steady)
    np.testing.assert_allclose(episode.action, 0.5)


def test_rows_before_the_first_command_that_is_a_number_are_left_out(tmp_path):
    early = np.arange(-1, 3, 0.05)
    found = load_recording(numbers(tmp_path / "run", dict.fromkeys(["/x", "/theta", "/u"], early)), CartPole(), FIELDS)
    (episode,) = found.episodes
    assert episode.time[0] == 0
    assert episode.state[0, 0] == pytest.approx(-0.1, abs=1e-6)
    assert "18 rows before the first or after the last whole set of numbers are left out" in " ".join(found.warnings)


@pytest.mark.parametrize("turned", [False, True])
def test_a_bag_and_the_file_in_it_count_once(turned, tmp_path):
    path = ros_bag(tmp_path / "run", 2, stamped=False)
    found = load_recording([path, next(path.glob("*.db3"))][:: -1 if turned else 1], CartPole(), ROS)
    assert len(found.episodes) == 1
    assert "holds the same as" in " ".join(found.warnings)


def test_the_slower_topic_is_not_the_one_that_ends_first_and_what_is_cut_off_is_said(tmp_path):
    stamps = {"/x": np.arange(0, 10, 0.05), "/theta": np.arange(0, 1.5, 0.01), "/u": np.arange(0.5, 10, 0.05)}
    found = load_recording(numbers(tmp_path / "run", stamps), CartPole(), FIELDS)
    assert found.period == pytest.approx(0.05)
    said = " ".join(found.warnings)
    assert "10 rows before the first message of /u are left out" in said
    assert "170 rows after the last message of /theta are left out" in said


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"x": "/joints.position[0]"}, "has no topic '/joints'; it has /joint_states, /motor/command"),
        ({"x": "/joint_states.place[0]"}, "'place' there are effort, header, name, position, velocity"),
        ({"x": "/joint_states.position[7]"}, r"no 'position\[7\]': at '\[7\]' there are 2 values"),
        ({"x": "/joint_states.name[0]"}, "is no number but a str"),
        ({"x": "/joint_states.position[0][1]"}, r"no 'position\[0\]\[1\]': at '\[1\]' there is a float"),
        ({"x": "position"}, "the column 'position' is not of the form TOPIC.FIELD"),
        ({"speed": "/joint_states.velocity[0]"}, "cartpole has no 'speed'"),
    ],
)
def test_what_a_bag_does_not_have(changed, says, tmp_path):
    path = ros_bag(tmp_path / "run", 2, stamped=False)
    with pytest.raises(RecordingError, match=says):
        load_recording(path, CartPole(), ROS | changed)


def test_a_bag_without_the_definition_of_its_messages(tmp_path):
    path, store = tmp_path / "run", get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg("float64 place\n", "rig_msgs/msg/Cart"))
    with rosbag2.Writer(path, version=8) as writer:
        cart = writer.add_connection("/cart", "rig_msgs/msg/Cart", typestore=store)
        writer.write(cart, int(1e9 * START), store.serialize_cdr(store.types["rig_msgs/msg/Cart"](0.1), cart.msgtype))
    (storage,) = path.glob("*.db3")
    with closing(sqlite3.connect(storage)) as table, table:
        table.execute("DELETE FROM message_definitions")
    says = "run: the bag does not define rig_msgs/msg/Cart, the type of /cart; a bag of ROS 2 Iron or later"
    with pytest.raises(RecordingError, match=says):
        load_recording(path, CartPole(), dict.fromkeys(FIELDS, "/cart.place"))


def test_columns_that_are_not_given_and_damaged_logs_are_one_line(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ulog(tmp_path / "run.ulg")
    assert "run.ulg: say where x, theta, command are" in refused(capsys, "diagnose", "run.ulg", "--system", "cartpole")
    columns = ",".join(f"{name}={place}" for name, place in PX4.items())
    content = (tmp_path / "run.ulg").read_bytes()
    for name, damaged in (("torn.bag", b"#ROSBAG V2.0\n"), ("torn.ulg", content[:20]), ("torn.mcap", b"\x89MCAP0\r\n")):
        (tmp_path / name).write_bytes(damaged)
        said = refused(capsys, "diagnose", name, "--system", "cartpole", "--columns", columns)
        assert said.startswith(f"visadapt: {name}: ") or f"{name}: " in said
