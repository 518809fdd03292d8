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
from visadapt.systems import CartPole, Quadrotor

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


def numbers(path, stamps, command=lambda time: 0.5 if time > -0.1 else np.nan, unknown=()):
    """A bag of ROS 2 with a number at each of a topic's stamps, in s; those of x at the `unknown` ones are NaN."""
    store = get_typestore(Stores.LATEST)
    number = store.types["std_msgs/msg/Float64"]
    with rosbag2.Writer(path, version=9) as writer:
        for topic, times in stamps.items():
            connection = writer.add_connection(topic, "std_msgs/msg/Float64", typestore=store)
            for time in times:
                # The angle passes the turn at 3 rad, as an encoder's does.
                angle = (2 * time + 3 + np.pi) % (2 * np.pi) - np.pi
                place = np.nan if np.isclose(time, unknown).any() else time
                value = {"/x": place, "/theta": angle, "/u": command(time)}[topic]
                raw = store.serialize_cdr(number(value), "std_msgs/msg/Float64")
                writer.write(connection, int(1e9 * (START + time)), raw)
    return path


def test_a_slower_topic_gives_the_rows_and_the_others_are_interpolated(tmp_path):
    stamps = {"/x": np.arange(0, 3, 0.02), "/theta": np.arange(0, 3, 0.005), "/u": np.arange(0, 3, 0.05)}
    found = load_recording(numbers(tmp_path / "run", stamps), CartPole(), FIELDS)
    (episode,) = found.episodes
    assert not found.usable
    turned = episode.state[:, 1] - 2 * episode.state[:, 0]
    np.testing.assert_allclose(turned, turned[0], atol=1e-5)
    np.testing.assert_allclose(episode.action, 0.5)
    assert "/theta is interpolated" in " ".join(found.warnings)


def test_a_topic_that_is_much_slower_has_rows_of_its_own(tmp_path):
    stamps = {"/x": np.arange(0.003, 6, 0.2), "/theta": np.arange(0, 6, 0.02), "/u": np.arange(0, 6, 0.05)}
    found = load_recording(numbers(tmp_path / "run", stamps), CartPole(), FIELDS)
    (episode,), (usable,) = found.episodes, found.usable
    assert "/x, which is slower, has rows of its own" in " ".join(found.warnings)
    x, angle = usable.T  # as a GPS receiver's and a gyro's, each at its own instants
    assert (x != angle).all()
    assert x.sum() == len(stamps["/x"])
    assert angle.sum() == len(stamps["/theta"])
    np.testing.assert_allclose(
        episode.state[x, 0] - episode.time[x], episode.state[x, 0][0] - episode.time[x][0], atol=1e-6
    )
    np.testing.assert_allclose(np.diff(episode.state[angle, 1]), 0.04, atol=1e-6)


def test_a_slow_topic_s_unknown_numbers_cost_no_rows_of_the_others(tmp_path):
    stamps = {"/x": np.arange(0.003, 6, 0.2), "/theta": np.arange(0, 6, 0.02), "/u": np.arange(0, 6, 0.05)}
    path = numbers(tmp_path / "run", stamps, unknown=(1.003, 1.203, 3.403))
    (usable,) = load_recording(path, CartPole(), FIELDS).usable
    x, angle = usable.T
    assert x.sum() == 27
    assert angle.sum() == len(stamps["/theta"])


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


def of_commands(path, received):
    """A recording of a bag whose command is received at these times, 0.05 s apart on average, and counts them."""
    steady = np.arange(0, 3, 0.05)
    stamps = {"/x": steady, "/theta": steady, "/u": received}
    return load_recording(numbers(path, stamps, lambda time: np.floor((time + 0.01) / 0.05) / 100), CartPole(), FIELDS)


def test_commands_of_a_steady_clock_act_when_it_sent_them(tmp_path):
    sent = np.delete(np.arange(0, 3, 0.05) - 0.01, [20, 41])  # two were lost
    late = np.random.default_rng(0).uniform(0.0005, 0.02, len(sent))
    found, prompt = (of_commands(tmp_path / f"{k}", sent + each) for k, each in enumerate((late, late.min())))
    assert [said for said in found.warnings if "/u: sent by a steady clock and received up to 0.0" in said]
    assert not [said for said in prompt.warnings if "steady clock" in said]
    rows = min(len(found.episodes[0].time), len(prompt.episodes[0].time))
    np.testing.assert_allclose(found.episodes[0].action[-rows:], prompt.episodes[0].action[-rows:], atol=1e-3)


def test_the_stamps_of_a_loop_that_sleeps_between_commands_are_kept(tmp_path):
    steps = 0.05 + np.random.default_rng(0).uniform(0, 0.005, 54)
    found = of_commands(tmp_path / "run", np.cumsum(steps) - 0.06)
    assert not [said for said in found.warnings if "steady clock" in said]


def test_rows_before_the_first_command_that_is_a_number_are_left_out(tmp_path):
    early = np.arange(-1, 3, 0.05)
    found = load_recording(numbers(tmp_path / "run", dict.fromkeys(["/x", "/theta", "/u"], early)), CartPole(), FIELDS)
    (episode,) = found.episodes
    assert episode.time[0] == 0
    assert episode.state[0, 0] == pytest.approx(-0.1, abs=1e-6)
    assert "18 rows in which a number is missing are left out" in " ".join(found.warnings)


def test_a_joint_is_found_by_its_name(tmp_path):
    path = ros_bag(tmp_path / "run", 2, stamped=False)
    names = {"x": "/joint_states.position[cart]", "theta": "/joint_states.position[pole]", "command": ROS["command"]}
    (by_number,), (by_name,) = (load_recording(path, CartPole(), given).episodes for given in (ROS, names))
    np.testing.assert_array_equal(by_number.state[:, [0, 2]], by_name.state)


def test_joints_in_another_order_are_told_by_name_alone(tmp_path):
    store = get_typestore(Stores.LATEST)
    make, kinds = store.types, {"/joints": "sensor_msgs/msg/JointState", "/u": "std_msgs/msg/Float64"}
    with rosbag2.Writer(tmp_path / "run", version=9) as writer:
        connections = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in kinds.items()}
        for row in range(60):
            time = make["builtin_interfaces/msg/Time"](1 + row // 20, 50_000_000 * (row % 20))
            names, values = ["cart", "pole"], np.array([0.01 * row, -0.02 * row])
            if row % 2:
                names, values = names[::-1], values[::-1].copy()
            header = make["std_msgs/msg/Header"](time, "")
            joints = make["sensor_msgs/msg/JointState"](header, names, values, np.zeros(0), np.zeros(0))
            for topic, message in (("/joints", joints), ("/u", make["std_msgs/msg/Float64"](0.1))):
                raw = store.serialize_cdr(message, kinds[topic])
                writer.write(connections[topic], 10**9 + 50_000_000 * row, raw)
    given = {"x": "/joints.position[cart]", "theta": "/joints.position[pole]", "command": "/u.data"}
    (episode,) = load_recording(tmp_path / "run", CartPole(), given).episodes
    np.testing.assert_allclose(episode.state[:, 1], -2 * episode.state[:, 0], atol=1e-12)
    with pytest.raises(
        RecordingError, match=r"/joints names the joints cart, pole, later pole, cart.*position\[cart\]"
    ):
        load_recording(tmp_path / "run", CartPole(), given | {"x": "/joints.position[0]"})


@pytest.mark.parametrize("turned", [False, True])
def test_a_bag_and_the_file_in_it_count_once(turned, tmp_path):
    path = ros_bag(tmp_path / "run", 2, stamped=False)
    found = load_recording([path, next(path.glob("*.db3"))][:: -1 if turned else 1], CartPole(), ROS)
    assert len(found.episodes) == 1
    assert "holds the same as" in " ".join(found.warnings)


def test_the_slower_topic_is_not_the_one_that_ends_first_and_what_is_cut_off_is_said(tmp_path):
    stamps = {"/x": np.arange(0, 10, 0.02), "/theta": np.arange(0, 1.5, 0.004), "/u": np.arange(0.5, 10, 0.02)}
    found = load_recording(numbers(tmp_path / "run", stamps), CartPole(), FIELDS)
    assert found.period == pytest.approx(0.02)
    said = " ".join(found.warnings)
    assert "rows before the first message of /u are left out: 25" in said
    assert "rows after the last message of /theta are left out: 425" in said


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"x": "/joints.position[0]"}, "has no topic '/joints'; it has /joint_states, /motor/command"),
        ({"x": "/joint_states.place[0]"}, "'place' there are effort, header, name, position, velocity"),
        ({"x": "/joint_states.position[7]"}, r"no 'position\[7\]': at '\[7\]' there are 2 values"),
        ({"x": "/joint_states.position[wheel]"}, r"no 'position\[wheel\]': its message names cart, pole"),
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


def headed(path, topics):
    """A bag of ROS 2 of topics {name: (type, stamps in s, values (N, F))} whose messages have headers; without a stamp
    where it is NaN."""
    store = get_typestore(Stores.LATEST)
    make = store.types
    with rosbag2.Writer(path, version=9) as writer:
        for topic, (kind, stamps, values) in topics.items():
            connection = writer.add_connection(topic, kind, typestore=store)
            now = 0.0
            for time, numbers in zip(stamps, values, strict=True):
                now = np.fmax(now + 1e-4, time)
                whole = 0.0 if np.isnan(time) else START + time
                stamp = make["builtin_interfaces/msg/Time"](int(whole), int(1e9 * (whole % 1)))
                inner = make[kind.replace("Stamped", "")](*numbers)
                message = make[kind](make["std_msgs/msg/Header"](stamp, ""), inner)
                raw = store.serialize_cdr(message, kind)
                writer.write(connection, int(1e9 * (START + now)), raw)
    return path


STEADY = 0.05 * np.arange(60)
CART = {"x": "/cart.point.x", "theta": "/cart.point.y", "command": "/motor.point.x"}


def a_cart(stamps):
    """Its topics; the readings have these stamps (N,)."""
    point = "geometry_msgs/msg/PointStamped"
    known = np.where(np.isnan(stamps), STEADY[: len(stamps)], stamps)
    readings = np.column_stack((0.3 * np.sin(2 * known), 0.1 * np.sin(5 * known), 0 * known))
    commands = np.column_stack((np.sin(7 * STEADY), 0 * STEADY, 0 * STEADY))
    return {"/cart": (point, stamps, readings), "/motor": (point, STEADY, commands)}


def test_messages_that_a_network_exchanged_are_put_in_order(tmp_path):
    exchanged = STEADY[[*range(20), 21, 20, *range(22, 60)]]
    (plain,) = load_recording(headed(tmp_path / "plain", a_cart(STEADY)), CartPole(), CART).episodes
    found = load_recording(headed(tmp_path / "run", a_cart(exchanged)), CartPole(), CART)
    np.testing.assert_array_equal(found.episodes[0].state, plain.state)
    assert "/cart: 2 messages are put in the order of their stamps" in " ".join(found.warnings)


def test_a_clock_that_is_set_back_is_refused(tmp_path):
    back = np.concatenate((STEADY[:40], STEADY[:20]))
    says = "the clock of /cart runs backwards after its message 40; the log of one run"
    with pytest.raises(RecordingError, match=says):
        load_recording(headed(tmp_path / "run", a_cart(back)), CartPole(), CART)


def test_a_message_without_a_stamp_is_left_out(tmp_path):
    stamps = STEADY.copy()
    stamps[30] = np.nan
    found = load_recording(headed(tmp_path / "run", a_cart(stamps)), CartPole(), CART)
    said = " ".join(found.warnings)
    assert "/cart: 1 of its messages have no stamp: they are left out" in said
    assert "times at which its messages were recorded" not in said
    assert len(found.episodes) == 2  # a row is missing


def test_a_log_that_stamps_rows_late_lacks_none(tmp_path):
    late = 0.018 * np.random.default_rng(0).random(60)  # of 50 ms
    late[[15, 40]] = 0.045  # steps of up to 1.9 periods
    stamps = dict.fromkeys(["/x", "/theta", "/u"], STEADY + late)
    found = load_recording(numbers(tmp_path / "run", stamps), CartPole(), FIELDS)
    assert len(found.episodes) == 1
    said = " ".join(found.warnings)
    assert "/x: its stamps are the times at which its messages were recorded" in said
    assert "/x: sent by a steady clock and received up to 0.04" in said
    np.testing.assert_allclose(np.diff(found.episodes[0].time), 0.05, atol=0.001)


def test_rows_without_a_command_are_left_out(tmp_path):
    topics = a_cart(STEADY)
    topics["/motor"][2][30:35] = np.nan
    found = load_recording(headed(tmp_path / "run", topics), CartPole(), CART)
    assert "rows in which a number is missing are left out" in " ".join(found.warnings)
    assert [len(each.time) for each in found.episodes] == [30, 25]


QUADROTOR = {name: f"/pose.point.{name}" for name in "xyz"}
QUADROTOR |= {f"q_{name}": f"/attitude.quaternion.{name}" for name in "wxyz"}
QUADROTOR |= {f"omega_{name}": f"/rates.vector.{name}" for name in "xyz"}
QUADROTOR |= {f"rate_{name}": f"/motors.quaternion.{name}" for name in "xyz"} | {"thrust": "/motors.quaternion.w"}


def test_an_attitude_that_is_interpolated_is_converted_too(tmp_path):
    """Turns in axes that point forward, right and down, read in axes that point forward, left and up."""
    fast = 0.013 * np.arange(240)
    half, rate, nothing = 0.15 * np.sin(fast), 0.3 * np.cos(fast), 0 * fast
    rows, still = 0 * STEADY, 0 * STEADY + 0.01 * np.sin(3 * STEADY)
    stamped = "geometry_msgs/msg/{}Stamped".format
    topics = {
        "/pose": (stamped("Point"), STEADY, np.column_stack((still, still, still - 1))),
        "/attitude": (stamped("Quaternion"), fast, np.column_stack((nothing, nothing, np.sin(half), np.cos(half)))),
        "/rates": (stamped("Vector3"), fast, np.column_stack((nothing, nothing, rate))),
        "/motors": (stamped("Quaternion"), STEADY, np.column_stack((rows, rows, 0.6 * np.cos(STEADY), still))),
    }
    turned = ("y", "z", "q_y", "q_z", "omega_y", "omega_z", "rate_y", "rate_z")
    given = {name: f"{place}*-1" if name in turned else place for name, place in QUADROTOR.items()}
    found = load_recording(headed(tmp_path / "run", topics), Quadrotor(), given)
    (episode,) = found.episodes
    states = dict(zip(found.measured, episode.state.T, strict=True))
    np.testing.assert_allclose(states["q_z"], -np.sin(0.15 * np.sin(episode.time)), atol=1e-4)
    np.testing.assert_allclose(states["omega_z"], -0.3 * np.cos(episode.time), atol=1e-4)
