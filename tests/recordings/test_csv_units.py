import re
from dataclasses import replace

import numpy as np
import pytest

from tests.diagnosis.test_diagnosis_flights import record as a_flight
from tests.own_systems import Winch
from tests.recorded import a_run, a_table, load, refuses, write
from visadapt.recordings import Episode, RecordingError, load_recording, write_recording
from visadapt.systems import FixedWing, Quadrotor

RIGHT_AND_DOWN = np.array([1, -1, -1, 1, -1, -1, 1, 1, -1, -1, 1, -1, -1])
"""Signs of a vehicle's states in axes north, east and down."""


class TestUnits:
    @pytest.mark.parametrize("columns", [("theta",), ("theta_dot",), ("theta", "theta_dot")])
    @pytest.mark.parametrize("start", [0.03, 0.2, 3.0])
    @pytest.mark.parametrize("noise", [1e-3, 9e-3])
    def test_degrees(self, file, columns, start, noise):
        table = a_run(start=start, noise=noise)
        for name in columns:
            table[name] = np.degrees(table[name])
        refuses("run.csv: .*theta.*radians are right", write(file, table))

    @pytest.mark.parametrize("start", [0.03, 0.2, 3.0])
    @pytest.mark.parametrize("noise", [1e-3, 9e-3])
    @pytest.mark.parametrize("rates", [False, True])
    def test_radians(self, file, start, noise, rates):
        for seed in range(5):
            table = a_run(start=start, noise=noise, seed=seed)
            if not rates:
                del table["x_dot"], table["theta_dot"]
            assert load(write(file, table)).warnings == ()

    @pytest.mark.parametrize("start", [0.03, 0.2, 3.0])
    @pytest.mark.parametrize("noise", [1e-3, 9e-3])
    def test_degrees_without_velocities(self, file, start, noise):
        table = a_run(start=start, noise=noise)
        table["theta"] = np.degrees(table["theta"])
        del table["x_dot"], table["theta_dot"]
        refuses("column 'theta' .*radians are right", write(file, table))

    @pytest.mark.parametrize("scale", [100, 1000])
    def test_lengths_in_smaller_units(self, file, scale):
        table = a_table(rows=200)
        table["x"] = table["x"] * scale
        refuses("column 'x' is .* metres are right", write(file, table))

    def test_a_pole_that_turns_over_is_unwrapped(self, file):
        table = a_table(rows=200)
        angle = np.pi * (1 + np.sin(1.5 * table["time"])) + 0.5
        table["theta"] = (angle + np.pi) % (2 * np.pi) - np.pi
        table["theta_dot"] = 1.5 * np.pi * np.cos(1.5 * table["time"])
        state = load(write(file, table)).episodes[0].state[:, 2]
        assert np.abs(np.diff(state)).max() < 1
        np.testing.assert_allclose(np.cos(state), np.cos(angle), atol=1e-12)

    def test_a_pole_that_was_swung_up_is_upright_at_0(self, file):
        table = a_table(rows=200)
        angle = -np.pi * (1.5 + 0.5 * np.tanh(table["time"] - 8))  # hangs for most of the time
        table["theta"] = (angle + np.pi) % (2 * np.pi) - np.pi
        del table["theta_dot"]
        state = load(write(file, table)).episodes[0].state[:, 2]
        assert abs(state[-1]) < 0.1

    def test_turns_that_the_physics_tell_apart_and_a_range_that_is_wider_downwards(self, file):
        time = np.arange(100) * 0.02
        drum = 30 - 20 * np.sin(time) ** 2
        table = {"time": time, "drum": drum, "speed": -20 * np.sin(2 * time), "torque": 0.1 * np.sin(9 * time)}
        state = load_recording(write(file, table), Winch()).episodes[0].state
        np.testing.assert_allclose(state[:, 0], drum, atol=1e-9)

    def test_a_joint_turns_on_while_rows_are_missing(self, file):
        table = a_table(rows=300, period=0.02)
        table["theta"], table["theta_dot"] = 9 * table["time"], np.full(300, 9.0)
        kept = (table["time"] < 2) | (table["time"] > 3)
        assert len(load(write(file, {name: values[kept] for name, values in table.items()})).episodes) == 2

    def test_an_angle_that_goes_round_several_times(self, file):
        table = a_table(rows=200)
        table["theta"], table["theta_dot"] = 3 * table["time"], np.full(200, 3.0)
        assert load(write(file, table)).samples == 199

    @pytest.mark.parametrize(("one", "other"), [("x", "theta"), ("x", "x_dot"), ("theta", "theta_dot")])
    def test_columns_that_changed_places(self, file, one, other):
        table = a_table(rows=200)
        table[one], table[other] = table[other], table[one]
        refuses(f"column '{one}' and column '{other}' are evidently exchanged", write(file, table))

    @pytest.mark.parametrize("start", [0.03, 0.2])
    @pytest.mark.parametrize("rates", [False, True])
    def test_columns_that_changed_places_together(self, file, start, rates):
        table = a_run(start=start, noise=1e-3)
        table["x"], table["theta"] = table["theta"], table["x"]
        table["x_dot"], table["theta_dot"] = table["theta_dot"], table["x_dot"]
        if not rates:
            del table["x_dot"], table["theta_dot"]
        refuses("column 'x' answers the command as theta should, and column 'theta' as x", write(file, table))

    @pytest.mark.parametrize("rows", [15, 30])
    @pytest.mark.parametrize(("one", "other"), [("x", "theta"), ("x", "x_dot"), ("theta", "theta_dot")])
    def test_short_episodes_are_judged_together(self, file, rows, one, other):
        table = a_run(start=0.1, noise=1e-3)
        count = len(table["time"])
        table["episode"] = np.arange(count) // rows
        assert load(write(file, table)).samples > 0
        swapped = {**table, one: table[other], other: table[one]}
        if (one, other) == ("x", "theta"):
            swapped["x_dot"], swapped["theta_dot"] = table["theta_dot"], table["x_dot"]
        refuses("are evidently exchanged|they are exchanged", write(file, swapped))
        degrees = {**table, "theta": np.degrees(table["theta"]), "theta_dot": np.degrees(table["theta_dot"])}
        refuses("radians are right", write(file, degrees))

    def test_an_episode_shorter_than_the_delays_that_are_tried_is_not_judged(self, file):
        table = a_run(start=0.1, noise=1e-4, rows=400, period=0.01)
        table["episode"] = (np.arange(400) >= 387).astype(int)  # the second one has 13 rows
        table["x"], table["theta"] = table["theta"], table["x"]
        del table["x_dot"], table["theta_dot"]
        refuses("column 'x' answers the command as theta should", write(file, table))

    def test_a_column_is_called_what_the_file_calls_it(self, file):
        table = a_run(start=0.1, noise=1e-3)
        table["pole_angle"] = np.degrees(table.pop("theta"))
        refuses(r"column 'pole_angle' \(theta\) .* radians are right", write(file, table))

    def test_metres_that_wrap(self, file):
        table = a_table(rows=200)
        angle = np.pi * np.sin(1.5 * table["time"]) + np.pi
        table["theta"], table["x"] = table["x"], (angle + np.pi) % (2 * np.pi) - np.pi
        del table["x_dot"], table["theta_dot"]
        refuses("column 'x' jumps by .*are two columns exchanged", write(file, table))

    @pytest.mark.parametrize("turn", [np.pi, -np.pi])
    @pytest.mark.parametrize("rates", [False, True])
    def test_an_angle_from_hanging(self, file, turn, rates):
        table = a_run(start=0.2, noise=1e-3)
        table["theta"] = table["theta"] + turn
        if not rates:
            del table["x_dot"], table["theta_dot"]
        refuses(
            "column 'theta' answers the command as it should half a turn further; 0 upright is right",
            write(file, table),
        )

    @pytest.mark.parametrize("start", [0.03, 0.2, 3.0])
    def test_the_other_sign_of_an_angle_is_not_half_a_turn(self, file, start):
        table = a_run(start=start, noise=1e-3)
        table["theta"], table["theta_dot"] = -table["theta"], -table["theta_dot"]
        load(write(file, table))

    @pytest.mark.parametrize(
        ("factor", "said"), [(100, "is 100 times"), (0.001, "is 1000 times"), (-1, "opposite sign")]
    )
    def test_a_speed_in_another_unit_or_of_the_other_sign(self, file, factor, said):
        table = a_table(rows=200)
        table["x"], table["x_dot"] = 0.05 * table["x"], 0.05 * factor * table["x_dot"]
        refuses(said, write(file, table))

    @pytest.mark.parametrize(
        ("change", "said"),
        [
            (lambda s: s * ([1] * 6 + [1.3] * 4 + [1] * 3), "quaternion's length is 1.3"),
            (lambda s: s[:, [0, 1, 2, 3, 4, 5, 7, 8, 9, 6, 10, 11, 12]], "in the order x, y, z, w; q_w, the scalar"),
            (
                lambda s: s[:, [*range(6), 9, 6, 7, 8, *range(10, 13)]] * [*[1] * 6, -1, 1, -1, *[1] * 4],
                "in another order than w, x, y, z; q_w, the scalar",
            ),
            (lambda s: s * ([1] * 7 + [-1] * 3 + [1] * 3), "rotates body into world axes is right"),
            (lambda s: s * ([1] * 10 + [180 / np.pi] * 3), "rad/s are right"),
            (lambda s: s * [1, 1, -1, 1, 1, -1, *[1] * 7], "column 'z' accelerates against the thrust"),
            (
                lambda s: s * RIGHT_AND_DOWN,
                "pointed north, east and down; .* right: y, y_dot, .*, z, z_dot with",
            ),
            (
                lambda s: s * RIGHT_AND_DOWN * [1, 1, -1, 1, 1, -1, *[1] * 7],
                "attitude's forward, right and down; .*: y, ",
            ),
            (lambda s: s[:, [1, 0, 2, 4, 3, *range(5, 13)]] * [-1, 1, 1, -1, *[1] * 9], "east and north, .*: y for x"),
        ],
    )
    def test_an_attitude_that_is_told_otherwise(self, file, change, said):
        recorded = a_flight(Quadrotor(), rows=60, episodes=1)
        (episode,) = recorded.episodes
        names = (*recorded.measured, *(action.name for action in Quadrotor.actions))

        def written(states):
            return write(file, dict(zip(("time", *names), (episode.time, *states.T, *episode.action.T), strict=True)))

        load_recording(written(episode.state), Quadrotor())
        with pytest.raises(RecordingError, match=said):
            load_recording(written(change(episode.state)), Quadrotor())

    @pytest.mark.parametrize(("least", "most"), [(0.0, 20.0), (7.0, 14.0)])
    def test_a_thrust_from_0_to_1_is_not_taken_for_a_weak_motor(self, file, least, most):
        # Commands from 0 to 1 give 0 to 20 m/s2, or, as half the range of a motor of 0.7 times the thrust, 7 to 14.
        system = Quadrotor(min_thrust=0.0, max_thrust=20.0)
        recorded = a_flight(replace(system, min_thrust=least, max_thrust=most), rows=60, episodes=1)
        (episode,) = recorded.episodes
        action = episode.action * [0.5, 1, 1, 1] + [0.5, 0, 0, 0]
        names = (*recorded.measured, *(action.name for action in Quadrotor.actions))
        path = write(file, dict(zip(("time", *names), (episode.time, *episode.state.T, *action.T), strict=True)))
        if least > 0:
            load_recording(path, system)
            return
        with pytest.raises(RecordingError, match=r"thrust is never negative, .* \(--columns thrust=COLUMN\*2-1\)"):
            load_recording(path, system)

    @pytest.mark.parametrize(
        ("system", "opposite"),
        [(Quadrotor, ("rate_x",)), (Quadrotor, ("rate_y", "rate_z")), (FixedWing, ("elevator",)), (FixedWing, ())],
    )
    @pytest.mark.parametrize("down", [False, True])
    def test_commands_that_turn_a_vehicle_the_other_way(self, file, system, opposite, down):
        (episode,) = (recorded := a_flight(system(), rows=60, episodes=1)).episodes
        names = (*recorded.measured, *(action.name for action in system.actions))
        states = episode.state * (RIGHT_AND_DOWN if down else 1)
        action = episode.action * [-1 if action.name in opposite else 1 for action in system.actions]
        path = write(file, dict(zip(("time", *names), (episode.time, *states.T, *action.T), strict=True)))
        if not opposite and not down:
            load_recording(path, system())
            return
        with pytest.raises(RecordingError, match="with the other sign" if down else "had the other sign") as refused:
            load_recording(path, system())
        assert [action.name for action in system.actions if action.name in str(refused.value)] == [*opposite]

    def test_noise_is_no_reason_to_refuse(self, file):
        load(write(file, a_table(rows=400, noise=9e-3)))


class TestCommands:
    def test_all_out_of_range(self, file):
        table = a_table()
        table["command"] = 30 * table["command"]
        refuses(r"row \d+ \(line \d+\), column 'command' is -?\d.*within \[-1, 1\] is right", write(file, table))

    def test_a_hint_is_one_that_helps(self, file):
        table = a_table()
        table["command"] = 30 * table["command"]
        refuses(r"is right \(name a column in N 'force'\)", write(file, table))
        flight = {state.name: np.zeros(41) for state in Quadrotor.states} | {"time": table["time"], "q_w": np.ones(41)}
        flight |= {action.name: np.full(41, 5.0) for action in Quadrotor.actions}
        with pytest.raises(RecordingError, match=r"within \[-1, 1\] is right$"):
            load(write(file, flight), system=Quadrotor())

    def test_a_little_out_of_range(self, file):
        table = a_table()
        table["command"] = 1.1 * table["command"]
        (warning,) = load(write(file, table)).warnings
        assert "of command lie outside, " in warning
        assert "the farthest; within [-1, 1] is right" in warning

    def test_never_changing(self, file):
        table = a_table()
        table["command"] = np.zeros(41)
        (warning,) = load(write(file, table)).warnings
        assert "command never changes" in warning
        assert "cannot be identified" in warning


class TestConversions:
    """What a user says with --columns of numbers in other units."""

    def test_numbers_in_other_units_become_ours(self, file):
        table = a_run(start=0.2, noise=1e-3)
        theirs = {
            "stamp": 1000 * table["time"] + 5e9,
            "counts": (table["theta"] + np.pi) * 4096 / (2 * np.pi),
            "deg/s": -np.degrees(table["theta_dot"]),
            "mm": 1000 * table["x"],
            "u-1": table["command"],
        }
        given = {
            "time": "stamp/1000",
            "theta": "counts * 2*pi/4096 - pi",
            "theta_dot": "deg/s*-1*pi/180",
            "x": "mm*1e-3",
            "command": "u-1",
        }
        (expected,), (found,) = (
            load(write(file, one), columns=columns).episodes
            for one, columns in (({n: v for n, v in table.items() if n != "x_dot"}, None), (theirs, given))
        )
        np.testing.assert_allclose(found.state, expected.state, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(found.time, expected.time, atol=1e-6)
        np.testing.assert_array_equal(found.action, expected.action)

    @pytest.mark.parametrize(
        ("name", "theirs"),
        [
            ("theta", np.degrees),
            ("theta", lambda values: values + np.pi),
            ("theta_dot", np.degrees),
            ("theta_dot", lambda values: -values),
            ("x", lambda values: 1000 * values),
            ("time", lambda values: values / 60),
        ],
        ids=["degrees", "from hanging", "degrees/s", "a rate's sign", "mm", "minutes"],
    )
    def test_what_a_refusal_says_converts_them(self, file, name, theirs):
        table = a_run(start=0.2, noise=1e-3)
        (expected,) = load(write(file, table)).episodes
        with pytest.raises(RecordingError, match=f"; --columns {name}={name}.* converts") as refused:
            load(write(file, {**table, name: theirs(table[name])}))
        said = re.findall(r"--columns (\w+)=(\S+)", str(refused.value))
        (found,) = load(file, columns=dict(said)).episodes
        np.testing.assert_allclose(found.state, expected.state, atol=1e-9)
        np.testing.assert_allclose(found.time, expected.time, atol=1e-9)

    def test_what_a_refusal_says_goes_behind_what_was_given(self, file):
        table = a_run(start=0.2, noise=1e-3)
        theirs = {**table, "V*": -np.degrees(table["theta_dot"])}
        del theirs["theta_dot"]
        with pytest.raises(RecordingError, match=r"; --columns theta_dot=V\*\*pi/180\*-1 converts"):
            load(write(file, theirs), columns={"theta_dot": "V**pi/180"})
        assert load(file, columns={"theta_dot": "V**pi/180*-1"}).warnings == ()

    def test_the_longest_name_of_the_file_is_taken(self, file):
        table = a_run(start=0.2, noise=1e-3)
        table["Joint-1"] = table.pop("theta") / 2
        load(write(file, table), columns={"theta": "joint-1*2"})
        refuses(
            "no column '5-joint' for theta; .*; a conversion is COLUMN\\*FACTOR\\+OFFSET, as in time\\*2",
            file,
            columns={"theta": "5-joint-1"},
        )

    @pytest.mark.parametrize(("text", "says"), [("angle*0", "times 0 plus 0"), ("angle/0", "times inf plus 0")])
    def test_a_factor_that_is_no_factor(self, file, text, says):
        refuses(
            f"^--columns ...=angle.0: {says}; finite numbers, the factor not 0, are right$",
            write(file, a_table()),
            columns={"theta": text},
        )

    def test_of_hdf5_too(self, tmp_path):
        path, table = tmp_path / "run.h5", a_run(start=0.2, noise=1e-3)
        state = np.column_stack([1000 * table["x"], table["x_dot"], table["theta"], table["theta_dot"]])
        episode = Episode(1000 * table["time"], -table["command"][:, None], state)
        write_recording(path, [episode], ["x", "x_dot", "theta", "theta_dot"], ["command"])
        given = {"time": "time/1000", "x": "x/1000", "command": "command*-1"}
        (found,) = load(path, columns=given).episodes
        np.testing.assert_allclose(found.state[:, 0], table["x"])
        np.testing.assert_allclose(found.action[:, 0], table["command"])
