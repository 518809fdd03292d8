import os

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.logs import ROS, ros_bag
from tests.recorded import HEADER, STATES, a_run, a_table, load, refuses, write
from visadapt.recordings import RecordingError, load_recording
from visadapt.systems import Quadrotor
from visadapt.systems.rigid_body import rotation


class TestColumns:
    def test_our_own_names(self, file):
        table = a_table()
        recording = load(write(file, table))
        assert recording.measured == STATES
        assert recording.period == pytest.approx(0.05)
        assert recording.samples == 40
        assert recording.warnings == ()
        episode = recording.episodes[0]
        np.testing.assert_array_equal(episode.state, np.column_stack([table[name] for name in STATES]))
        np.testing.assert_array_equal(episode.action[:, 0], table["command"])
        np.testing.assert_allclose(episode.time, table["time"], atol=1e-12)

    def test_any_order_and_case_and_columns_of_no_interest(self, file):
        table = a_table()
        shuffled = {"Note": ["ok"] * 41, **{name.upper(): table[name] for name in reversed(HEADER)}}
        np.testing.assert_array_equal(
            load(write(file, shuffled)).episodes[0].state, np.column_stack([table[name] for name in STATES])
        )

    @pytest.mark.parametrize(
        "names",
        [
            ("position", "positionD", "angle", "angleD", "Q"),
            ("cart_position", "cart_velocity", "pole_angle", "angular_velocity", "control"),
            ("s", "velocity", "ANGLE", "angled", "u"),
        ],
    )
    def test_well_known_names(self, file, names):
        table = a_table()
        foreign = dict(zip(("time", *names), table.values(), strict=True))
        assert load(write(file, foreign)).measured == STATES

    def test_our_own_name_comes_before_a_well_known_one(self, file):
        table = a_table()
        recording = load(write(file, table | {"position": np.zeros(41)}))
        np.testing.assert_array_equal(recording.episodes[0].state[:, 0], table["x"])

    def test_names_that_the_user_gives(self, file):
        table = a_table()
        foreign = {
            "when": table["time"],
            "a": table["x"],
            "b": table["theta"],
            "theta": table["x"],
            "c": table["command"],
        }
        recording = load(write(file, foreign), columns={"time": "when", "x": "a", "theta": "B", "command": "c"})
        assert recording.measured == ("x", "theta")
        np.testing.assert_array_equal(recording.episodes[0].state[:, 1], table["theta"])

    @pytest.mark.parametrize("missing", ["time", "x", "theta", "command"])
    def test_a_missing_column(self, file, missing):
        table = a_table()
        del table[missing]
        refuses(f"run.csv: column '{missing}' is missing; it has .*--columns {missing}=", write(file, table))

    def test_angles_of_an_attitude_are_to_be_made_a_quaternion(self, file):
        header = ["time", "x", "y", "z", "roll", "pitch", "yaw", "thrust", "omega_x_cmd", "omega_y_cmd", "omega_z_cmd"]
        path = write(file, {name: np.zeros(30) for name in header})
        made = r"q_x, q_y, q_z, q_w = .*from_euler\('ZYX', \[yaw, pitch, roll\]\).as_quat\(\), with angles in rad"
        for given in ({}, {"roll": "roll*pi/180"}):
            with pytest.raises(RecordingError, match=made):
                load_recording(path, Quadrotor(), given)
        roll, pitch, yaw = 0.2, -0.3, 0.5
        x, y, z, w = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_quat()
        ours = rotation(torch.tensor([[w, x, y, z]]))[0].numpy()
        forward = [np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)]
        np.testing.assert_allclose(ours[:, 0], forward, atol=1e-12)

    def test_states_that_were_not_measured(self, file):
        table = a_table()
        path = write(file, {name: table[name] for name in ("time", "theta", "theta_dot", "command")})
        refuses("column 'x' is missing; .*; if it was not measured: --columns x=$", path)
        recording = load(path, columns={"x": "", "theta_dot": ""})
        assert recording.measured == ("theta",)
        assert recording.warnings == (
            "x, theta_dot: not measured: estimated with the simulator from what was measured",
        )
        refuses("one of x, x_dot, theta, theta_dot at least must be measured", path, columns=dict.fromkeys(STATES, ""))
        refuses("--columns command=: command is needed; --columns command=... names it", path, columns={"command": ""})

    def test_what_the_user_names_is_not_there(self, file):
        write(file, a_table())
        refuses("no column 'pos' for x; it has time, x", file, columns={"x": "pos"})
        refuses("cartpole has no 'speed'; it has episode, time, x", file, columns={"speed": "x_dot"})

    @pytest.mark.parametrize("letter", ["T", "t"])
    def test_a_single_letter_in_the_other_case_is_another_quantity(self, file, letter):
        table = a_table()
        refused = {"T": "column 'time' is missing; it has T, x", "t": ""}[letter]
        path = write(file, {letter: table.pop("time"), **table})
        refuses(refused, path) if refused else load(path)

    def test_two_columns_that_could_be_one(self, file):
        table = a_table()
        table["angle"] = table["pole_angle"] = table.pop("theta")
        refuses("'angle', 'pole_angle' could each be theta; say which: --columns theta=", write(file, table))

    def test_names_that_differ_in_case_alone(self, file):
        table = a_table()
        table["X"] = table.pop("x_dot")
        assert load(write(file, table), columns={"x": "x", "x_dot": "X"}).measured == STATES

    def test_two_columns_of_one_name(self, file):
        write(file, a_table())
        header, *rows = file.read_text().splitlines()
        file.write_text("\n".join([f"{header},theta", *(f"{row},0" for row in rows)]))
        refuses("'theta', 'theta' could each be theta; give them different names", file)

    def test_velocities_may_be_missing(self, file):
        table = a_table()
        del table["x_dot"], table["theta_dot"]
        recording = load(write(file, table))
        assert recording.measured == ("x", "theta")
        assert recording.episodes[0].state.shape == (41, 2)

    def test_a_force_in_newton(self, file):
        table = a_table()
        table["force"] = 30 * table.pop("command")
        recording = load(write(file, table))
        np.testing.assert_allclose(recording.episodes[0].action[:, 0], table["force"] / 30)
        assert "divided by max_force, 30 N" in recording.warnings[0]

    def test_a_force_that_never_exceeds_one_is_the_command(self, file):
        table = a_table()
        table["force"] = table.pop("command")
        recording = load(write(file, table))
        np.testing.assert_array_equal(recording.episodes[0].action[:, 0], table["force"])
        (warning,) = recording.warnings
        assert "'force' stays within [-1, 1] and is taken to be a share of max_force" in warning

    def test_a_force_in_newton_that_is_small_is_told_by_what_it_does(self, file):
        table = a_run(start=0.003, noise=1e-5, push=0.01)
        table["force"] = 30 * table.pop("command")
        assert np.abs(table["force"]).max() < 1
        recording = load(write(file, table))
        np.testing.assert_allclose(recording.episodes[0].action[:, 0], table["force"] / 30)


class TestPaths:
    def test_a_folder_several_files_and_one(self, tmp_path):
        for seed, name in enumerate("cab"):
            write(tmp_path / f"{name}.csv", a_table(seed=seed))
        (tmp_path / "README.md").write_text("not a recording")
        assert [source[-5:] for source in load(tmp_path).sources] == ["a.csv", "b.csv", "c.csv"]
        assert [s[-5:] for s in load(tmp_path / "b.csv", tmp_path / "a.csv").sources] == ["b.csv", "a.csv"]

    def test_a_column_is_not_taken_twice(self, tmp_path):
        path = write(tmp_path / "a.csv", a_table())
        refuses("column 'x' is taken for both x and theta", path, columns={"x": "x", "theta": "x"})
        write(path, {"episode": [0] * 41, **a_table()})
        refuses("column 'episode' is taken for both episode and command", path, columns={"command": "episode"})

    def test_hidden_files_of_a_folder_are_left_alone(self, tmp_path):
        write(tmp_path / "a.csv", a_table())
        (tmp_path / "._a.csv").write_bytes(b"\0\1\2")
        assert len(load(tmp_path).sources) == 1

    def test_a_file_is_used_once(self, tmp_path):
        path, copy = write(tmp_path / "a.csv", a_table()), write(tmp_path / "b.csv", a_table())
        recording = load(path, tmp_path / "." / "a.csv", copy, tmp_path)
        assert recording.sources == (str(path),)
        assert f"{path} and 3 more: holds the same as {path}, so it is not used twice" in recording.warnings

    def test_a_pipe_is_no_recording(self, tmp_path):
        os.mkfifo(tmp_path / "pipe")
        refuses("pipe: no regular file; a CSV or HDF5 file is right", tmp_path / "pipe")

    def test_a_folder_without_recordings(self, tmp_path):
        refuses("a folder without recordings; files that end in .csv", tmp_path)

    def test_what_is_not_read_of_a_folder_is_said(self, tmp_path):
        write(tmp_path / "a.csv", a_table())
        write(tmp_path / "b.txt", a_table())
        (tmp_path / "older").mkdir()
        (warning,) = load(tmp_path).warnings
        assert warning == f"{tmp_path / 'b.txt'} and 1 more: is not read: name it beside the folder"

    def test_a_folder_of_bags(self, tmp_path):
        for name, late in (("one", False), ("two", True)):
            ros_bag(tmp_path / name, 2, stamped=late)
        columns = ROS | {"command": "/motor/command.data"}
        refuses("two.* has no 'data'", tmp_path, columns=columns)

    def test_rows_of_episodes_in_turn(self, tmp_path):
        path = write(tmp_path / "a.csv", {"episode": [0, 1] * 20 + [0], **a_table()})
        refuses("a.csv: the rows of episodes are mixed, 0 and 1 in turn", path)

    def test_a_path_that_is_not_there(self, tmp_path):
        refuses("none.csv: there is no such file or folder", tmp_path / "none.csv")

    def test_a_folder_with_one_torn_file(self, tmp_path):
        for name in "abc":
            write(tmp_path / f"{name}.csv", a_table())
        torn = tmp_path / "b.csv"
        torn.write_text(torn.read_text()[:-30])
        refuses(r"b.csv: row 41 \(line 42\) is cut short", tmp_path)

    def test_a_state_that_only_some_files_have_is_not_used(self, tmp_path):
        whole, part = a_table(), a_table(seed=1)
        del part["x_dot"]
        recording = load(write(tmp_path / "a.csv", whole), write(tmp_path / "b.csv", part))
        assert recording.measured == ("x", "theta", "theta_dot")
        np.testing.assert_array_equal(recording.episodes[0].state[:, 1], whole["theta"])
        assert recording.warnings == (
            f"{tmp_path / 'b.csv'}: has no column 'x_dot', so that of the other files is not used",
        )
