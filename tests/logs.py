"""Logs of a robot for the tests: one motion of a cart-pole as bags of ROS 1 and 2, and as PX4's ULog."""

import struct

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

START = 1_700_000_000.0
"""s, of the first reading"""
PERIOD, ROWS, LATE = 0.02, 120, 0.005
"""s between readings of the joints, their number, and s by which the command follows each."""
JOINTS = {"x": "position[0]", "theta": "position[1]", "x_dot": "velocity[0]", "theta_dot": "velocity[1]"}
ROS = {name: f"/joint_states.{field}" for name, field in JOINTS.items()} | {"command": "/motor/command.data"}
PX4 = {name: f"joints.{field}" for name, field in JOINTS.items()} | {"command": "motor.data"}


def motion(time):
    """States (T, 4) and commands (T,) at times since the first reading."""
    state = [0.3 * np.sin(2 * time), 0.6 * np.cos(2 * time), 0.1 * np.sin(5 * time), 0.5 * np.cos(5 * time)]
    return np.column_stack(state), np.sin(7 * time)


def messages():
    """(topic, s since the first reading, values): a reading's are x, theta, x_dot and theta_dot."""
    for row in range(ROWS):
        state, command = motion(np.array([row * PERIOD]))
        yield "joints", row * PERIOD, state[0, [0, 2, 1, 3]]
        yield "motor", row * PERIOD + LATE, command


def ros_bag(path, version, stamped=True, plugin=rosbag2.StoragePlugin.SQLITE3):
    """Recorded a second after the stamps in the headers, where the messages have one."""
    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.LATEST)
    make = store.types
    with rosbag1.Writer(path) if version == 1 else rosbag2.Writer(path, version=9, storage_plugin=plugin) as writer:
        command = "std_msgs/msg/Float64" if not stamped else "sensor_msgs/msg/Temperature"
        topics = {"joints": ("/joint_states", "sensor_msgs/msg/JointState"), "motor": ("/motor/command", command)}
        connections = {name: writer.add_connection(*each, typestore=store) for name, each in topics.items()}

        def header(time):
            stamp = make["builtin_interfaces/msg/Time"](int(START + time), int(1e9 * ((START + time) % 1)))
            sequence = (0,) if version == 1 else ()
            return make["std_msgs/msg/Header"](*sequence, stamp, "")

        for name, time, values in messages():
            if name == "joints":
                joints = make["sensor_msgs/msg/JointState"]
                message = joints(header(time), ["cart", "pole"], values[:2], values[2:], np.zeros(0))
            elif stamped:
                message = make["sensor_msgs/msg/Temperature"](header(time), values[0], 0.0)
            else:
                message = make["std_msgs/msg/Float64"](values[0])
            kind = topics[name][1]
            raw = store.serialize_ros1(message, kind) if version == 1 else store.serialize_cdr(message, kind)
            writer.write(connections[name], int(1e9 * (START + time + 1.0)), raw)
    return path


def ulog(path):
    """The file format of PX4: a header, definitions of messages, subscriptions, data."""
    formats = {
        "joints": "uint64_t timestamp;double[2] position;double[2] velocity;",
        "motor": "uint64_t timestamp;double data;",
    }

    def message(kind, body):
        return struct.pack("<HB", len(body), ord(kind)) + body

    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0), message("B", bytes(40))]
    parts += [message("F", f"{name}:{fields}".encode()) for name, fields in formats.items()]
    parts += [message("A", struct.pack("<BH", 0, k) + name.encode()) for k, name in enumerate(formats)]
    for name, time, values in messages():
        stamp = round(1e6 * (1.0 + time))
        body = struct.pack(f"<HQ{len(values)}d", list(formats).index(name), stamp, *values)
        parts.append(message("D", body))
    path.write_bytes(b"".join(parts))
    return path
