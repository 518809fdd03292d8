"""Machines of which little is measured: poses of a robot on wheels, a motor's speed, a pendulum by its arm."""

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from experiments.furuta import Furuta
from tests.own_systems import Motor, Rover
from visadapt.diagnosis import diagnose
from visadapt.effects.catalogue import catalogue
from visadapt.recordings import Episode, Recording, load_recording
from visadapt.systems import System, Variable
from visadapt.world import World

PERIOD, ROWS = 0.05, 120
BY_NAME = {effect.name: effect for effect in catalogue(Rover())}
SEARCHED = [
    BY_NAME[name]
    for name in (
        *("left.actuator_gain", "right.actuator_gain", "mass.scale", "inertia.scale", "yaw.sensor_offset"),
        *(
            "x.drift",
            "y.drift",
            "x.sensor_scale",
            "forward.viscous_friction",
            "forward.coulomb_friction",
            "turn.coulomb_friction",
            "forward.added_inertia",
        ),
    )
]


@pytest.fixture
def recorded(tmp_path):
    """Writes and reads a recording of a rover with other values, integrated by scipy."""

    def of(left=1.0, mass=1.0, headings=None, drift=(0.0, 0.0)):
        """With headings at the start of each episode, these are not recorded."""
        generator, rover = np.random.default_rng(0), Rover()
        columns = ("x", "y", "yaw") if headings is None else ("x", "y")
        lines = [",".join(("episode", "time", *columns, "left", "right"))]
        for episode in range(2):
            state = np.zeros(5)
            state[2] = 0.0 if headings is None else headings[episode]
            for row in range(ROWS):
                t = row * PERIOD
                torques = 0.4 + 0.8 * math.sin(1.1 * t + episode), 0.4 + 0.8 * math.sin(1.7 * t + 2 * episode)
                seen = (state[:3] + 1e-3 * generator.normal(size=3))[: len(columns)]
                lines.append(",".join(str(one) for one in (episode, t, *seen, *torques)))
                forces = left * torques[0] / rover.radius, torques[1] / rover.radius

                def rates(_, s, forces=forces):
                    turning = rover.half_track * (forces[1] - forces[0] - rover.damping * rover.half_track * s[4])
                    forward = sum(forces) - rover.damping * s[3]
                    speeds = s[3] * math.cos(s[2]) + drift[0], s[3] * math.sin(s[2]) + drift[1], s[4]
                    return [*speeds, forward / (mass * rover.mass), turning / rover.inertia]

                state = solve_ivp(rates, (0, PERIOD), state, rtol=1e-6, atol=1e-8, method="LSODA").y[:, -1]
        path = tmp_path / "rover.csv"
        path.write_text("\n".join(lines))
        return load_recording(path, rover, None if headings is None else {"yaw": ""})

    return of


@pytest.mark.parametrize(
    ("target", "name", "value"),
    [
        ({"left": 0.7}, "left.actuator_gain", 0.7),
        ({}, "", 0.0),
    ],
)
def test_what_is_there_is_found_without_measured_velocities(recorded, target, name, value):
    recording = recorded(**target)
    assert recording.measured == ("x", "y", "yaw")
    found = diagnose(recording, World(Rover(), period=PERIOD), SEARCHED)
    assert found.verdict == ("identified" if name else "no_gap")
    assert [cause.effect for cause in found.causes if not cause.slight] == ([name] if name else [])
    if name:
        (estimate,) = found.causes[0].parameters.values()
        assert estimate.value == pytest.approx(value, rel=0.02)


@pytest.mark.parametrize(("left", "name"), [(1.0, ""), (0.7, "left.actuator_gain")])
def test_a_heading_without_a_sensor_may_start_anywhere(recorded, left, name):
    found = diagnose(recorded(left=left, headings=(2.5, -1.6)), World(Rover(), period=PERIOD), SEARCHED)
    assert found.verdict == ("identified" if name else "no_gap")
    assert [cause.effect for cause in found.causes if not cause.slight] == ([name] if name else [])
    if name:
        (estimate,) = found.causes[0].parameters.values()
        assert estimate.value == pytest.approx(left, rel=0.01)


@pytest.mark.parametrize(
    ("states", "commands", "headings", "named"),
    [
        ([1, 1, -1], [1, 1], None, "yaw"),
        ([1, 1, 1], [1, -1], None, "right"),
        ([1, 1, 1], [-1, -1], None, "every command"),
        # Without a heading, the machine in a mirror moves alike.
        ([1, -1], [1, 1], (2.5, -1.6), "every command, x or y"),
    ],
)
def test_what_has_the_other_sign_is_named_and_inverted(recorded, states, commands, headings, named):
    recording = recorded(headings=headings)
    turned = tuple(Episode(e.time, e.action * commands, e.state * states) for e in recording.episodes)
    found = diagnose(replace(recording, episodes=turned), World(Rover(), period=PERIOD), SEARCHED)
    assert found.verdict == "no_gap"
    assert f"{named} has the opposite sign of the source's; it was inverted" in found.warnings


def test_a_drift_is_none_of_the_sensors(recorded):
    found = diagnose(recorded(drift=(0.15, -0.05)), World(Rover(), period=PERIOD), SEARCHED)
    assert found.verdict == "identified"
    rates = {cause.effect: cause.parameters["rate"].value for cause in found.causes if not cause.slight}
    assert rates == pytest.approx({"x.drift": 0.15, "y.drift": -0.05}, abs=1e-3)


def test_a_larger_mass_and_added_inertia_are_told_apart_by_a_balance(recorded):
    found = diagnose(recorded(mass=1.5), World(Rover(), period=PERIOD), SEARCHED)
    assert found.verdict == "ambiguous"
    assert {cause.effect for cause in found.causes} == {"mass.scale", "forward.added_inertia"}
    assert found.next_experiment.endswith(
        "apart: no motion tells another mass from added inertia of forward: measure mass by itself."
    )


@pytest.mark.parametrize(
    ("name", "values"),
    [("hinge.viscous_friction", {"coefficient": 1e-4}), ("arm_axis.coulomb_friction", {"torque": 2e-3})],
)
def test_a_friction_is_found_by_the_arm_s_sensor_alone(name, values):
    rotary = Furuta()
    named = {effect.name: effect for effect in catalogue(rotary)}
    machine = World(rotary, [named[name](**values)], 0.02, substeps=10)
    machine.double().requires_grad_(False)
    generator, time = torch.Generator().manual_seed(0), 0.02 * np.arange(ROWS)
    episodes = []
    for episode in range(4):
        volts = 1.5 * np.sin((4 + episode) * time) + np.sin(11 * time + episode)
        at, arm = machine.start(torch.zeros(1, 4, dtype=torch.float64)), []
        for command in torch.from_numpy(volts)[:, None, None]:
            arm.append((at.state[0] + 1e-3 * torch.randn(4, generator=generator))[:1].numpy())
            at = machine.step(at, command)
        episodes.append(Episode(time, volts[:, None], np.array(arm)))
    recording = Recording(tuple(episodes), ("arm",), 0.02, ("one", "two", "three", "four"))
    searched = [
        named[f"{joint}.{kind}"]
        for joint in ("arm_axis", "hinge")
        for kind in ("viscous_friction", "coulomb_friction", "stribeck_friction")
    ]
    found = diagnose(recording, World(rotary, period=0.02), searched)
    assert (found.verdict, [cause.effect for cause in found.causes]) == ("identified", [name])
    ((parameter, value),) = values.items()
    assert found.causes[0].parameters[parameter].value == pytest.approx(value, rel=0.02)
    # Stribeck friction with a smaller breakaway is dry friction with two parameters more.
    assert found.causes[0].probability > 0.9


def test_a_delay_is_no_lag_and_of_one_sensor_it_is_that_of_all():
    """Commands act 6 ms late; rows are 10 to 12 ms apart, and the motor's encoder is read alone."""
    drive, generator = Drive(), np.random.default_rng(1)
    episodes = []
    for episode in range(3):
        state, before, time, rows, torques = np.zeros(4), 0.0, [0.0], [], []
        for _ in range(250):
            t = time[-1]
            rows.append([round(state[0] * 8192 / math.tau) * math.tau / 8192])
            torques.append(0.15 * math.sin((3 + episode) * t) + 0.15 * math.sin(11 * t + episode))
            step = 0.01 * (1 + 0.2 * generator.random())
            for torque, duration in ((before, 0.006), (torques[-1], step - 0.006)):
                state = drive.after(duration, state, torque)
            before = torques[-1]
            time.append(t + step)
        episodes.append(Episode(np.array(time[:-1]), np.array(torques)[:, None], np.array(rows)))
    recording = Recording(tuple(episodes), ("motor",), 0.011, ("one", "two", "three"))
    commands = [f"torque.actuator_{name}" for name in ("lag", "backlash", "gain", "delay")]
    late = ("sensors.measurement_delay", "motor.sensor_delay")
    scaled = [f"{name}.scale" for name in ("load_inertia", "motor_inertia", "stiffness", "friction")]
    pushed = ("motor_axis.push", "load_axis.push", "motor_axis.periodic_load")
    effects = [effect for effect in catalogue(drive) if effect.name in (*commands, *late, *scaled, *pushed)]
    found = diagnose(recording, World(drive, period=0.011), effects)
    assert (found.verdict, {cause.effect for cause in found.causes}) == (
        "ambiguous",
        {"torque.actuator_delay", "sensors.measurement_delay"},
    )
    assert found.causes[0].parameters["delay"].value == pytest.approx(0.006, rel=0.03)


def test_dry_friction_stops_it_where_the_closed_form_does():
    rover, force, start, period = Rover(), 2.0, 0.5, 0.01
    friction = BY_NAME["forward.coulomb_friction"](force=force)
    world = World(rover, [friction], period).double().requires_grad_(False)
    at = world.start(torch.tensor([[0.0, 0.0, 0.0, start, 0.0]], dtype=torch.float64))
    rate, slowest = rover.damping / rover.mass, force / rover.damping
    stops = math.log1p(start / slowest) / rate
    way = (start + slowest) / rate * -math.expm1(-rate * stops) - slowest * stops
    for _ in range(math.ceil(stops / period)):
        at = world.step(at, torch.zeros(1, 2, dtype=torch.float64))
    assert at.state[0, 3] == 0
    assert at.state[0, 0].item() == pytest.approx(way, abs=1e-4)


def test_a_speed_without_a_position_has_no_spring_and_no_transmission():
    lacking = {"forward.spring", "forward.transmission_compliance"}
    assert not lacking & BY_NAME.keys()
    assert {one.replace("forward", "turn") for one in lacking} <= BY_NAME.keys()


@dataclass(frozen=True)
class Drive(System):
    """A motor and what it turns, on a shaft that twists."""

    motor_inertia: float = 0.002  # kg m2
    load_inertia: float = 0.004  # kg m2
    stiffness: float = 2.0  # N m/rad
    friction: float = 0.005  # N m s/rad, of the motor

    name = "drive_with_a_shaft"
    states: ClassVar[tuple[Variable, ...]] = (
        *(Variable(name, "rad", -20.0, 20.0) for name in ("motor", "load")),
        *(Variable(name, "rad/s", -30.0, 30.0) for name in ("motor_rate", "load_rate")),
    )
    actions: ClassVar[tuple[Variable, ...]] = (Variable("torque", "N m", -0.5, 0.5),)
    loads = (Variable("motor_axis", "N m", -0.2, 0.2), Variable("load_axis", "N m", -0.2, 0.2))
    coordinates = ((0, 2), (1, 3))

    def derivative(self, state, command, load):
        motor, turned, motor_rate, load_rate = state.unbind(-1)
        twist = self.stiffness * (motor - turned)
        on_motor = command[:, 0] + load[:, 0] - twist - self.friction * motor_rate
        return torch.stack(
            (motor_rate, load_rate, on_motor / self.motor_inertia, (load[:, 1] + twist) / self.load_inertia), -1
        )

    def after(self, duration, state, torque):
        """The state (4,) after `duration` s under a constant torque: exact, since the drive is linear."""
        command, load = torch.tensor([[torque]]).double(), torch.zeros(1, 2).double()
        zero = torch.zeros(1, 4).double()
        free = self.derivative(zero, command, load)[0].numpy()
        columns = [
            self.derivative(row[None], torch.zeros(1, 1).double(), load)[0].numpy() for row in torch.eye(4).double()
        ]
        whole = np.zeros((5, 5))
        whole[:4, :4], whole[:4, 4] = np.array(columns).T, free
        return (expm(duration * whole) @ np.append(state, 1.0))[:4]


@pytest.mark.parametrize(
    ("damping", "verdict", "named"),
    [
        (0.002, "identified", {"resistance.scale"}),
        # Whatever divides the only acceleration that is left is the same.
        (0.0, "ambiguous", {"resistance.scale", "inertia.scale", "shaft.added_inertia"}),
    ],
)
def test_a_motor_whose_speed_alone_is_measured(damping, verdict, named):
    motor, resistance, volts = Motor(damping=damping), 1.4, 6.0
    # Under a constant voltage the speed approaches its end exponentially.
    slowing = motor.constant**2 / resistance + damping
    end, rate = volts * motor.constant / resistance / slowing, slowing / motor.inertia
    time = PERIOD * np.arange(ROWS)
    forth, back = end * -np.expm1(-rate * time), -end + 2 * end * np.exp(-rate * (time - 3))
    back -= end * np.exp(-rate * time)
    voltage, speed = np.where(time < 3, volts, -volts), np.where(time < 3, forth, back)
    generator = np.random.default_rng(0)
    episodes = tuple(
        Episode(time, voltage[:, None], (speed + 0.2 * generator.normal(size=ROWS))[:, None]) for _ in range(2)
    )
    found = diagnose(Recording(episodes, ("speed",), PERIOD, ("one", "two")), World(motor, period=PERIOD))
    causes = {cause.effect: cause.parameters for cause in found.causes if not cause.slight}
    assert (found.verdict, set(causes)) == (verdict, named)
    assert causes["resistance.scale"]["scale"].value == pytest.approx(resistance, rel=0.02)


@dataclass(frozen=True)
class Heater(System):
    """A block that is heated and loses heat to the room, whose temperature above that of the room is measured."""

    capacity: float = 30.0  # J/K
    loss: float = 0.5  # W/K

    name = "heated_block"
    states: ClassVar[tuple[Variable, ...]] = (Variable("temperature", "K", 0.0, 80.0),)
    actions: ClassVar[tuple[Variable, ...]] = (Variable("power", "W", 0.0, 40.0),)
    loads = (Variable("heat", "W", -10.0, 10.0),)
    coordinates = ((None, 0),)

    def derivative(self, state, command, load):
        heat = command[:, 0] + load[:, 0] - self.loss * state[:, 0]
        return torch.stack((heat / self.capacity,), -1)


def heated(loss=0.5, bias=0.0, noise=0.3):
    """The temperature under 20 W, then 5 W, by its closed form."""
    time = 0.16 * np.arange(480)
    power = np.where(time < 40, 20.0, 5.0)
    rate, change = loss / Heater().capacity, float(time[time >= 40][0])
    hot, warm = (20 + bias) / loss, (5 + bias) / loss
    there = hot * -math.expm1(-rate * change)
    later = warm + (there - warm) * np.exp(-rate * (time - change))
    temperature = np.where(time < change, hot * -np.expm1(-rate * time), later)
    read = temperature + noise * np.random.default_rng(0).normal(size=len(time))
    episode = Episode(time, power[:, None], read[:, None])
    return Recording((episode,), ("temperature",), 0.16, ("one",))


def test_a_gap_that_half_a_second_does_not_show_is_said():
    searched = [effect for effect in catalogue(Heater()) if effect.name in ("loss.scale", "heat.viscous_friction")]
    found = diagnose(heated(loss=0.7), World(Heater(), period=0.16), searched)
    assert found.verdict == "no_gap"
    assert any("explains whole episodes far better" in warning for warning in found.warnings)
    assert "what acts slowly in long runs under commands" in found.next_experiment
    same = diagnose(heated(), World(Heater(), period=0.16), searched)
    assert (same.verdict, same.warnings) == ("no_gap", found.warnings[:-1])


def test_a_cause_at_the_end_of_its_range_is_said_also_of_an_equivalent_one():
    names = ("power.actuator_bias", "heat.constant_load")
    searched = [effect for effect in catalogue(Heater()) if effect.name in names]
    found = diagnose(heated(bias=12.0, noise=0.02), World(Heater(), period=0.16), searched)
    assert {cause.effect for cause in found.causes} == set(names)
    assert any(warning.startswith("heat.constant_load: force is at 10 W, the end") for warning in found.warnings)


def test_a_damping_is_told_from_friction_by_no_motion():
    named = {effect.name: effect for effect in catalogue(Heater())}
    assert named["loss.scale"].settled_by["heat.viscous_friction"].endswith("measure loss by itself")
    assert "dry friction" in named["heat.viscous_friction"].settled_by["heat.coulomb_friction"]


def test_a_system_in_the_place_of_a_world_is_refused():
    with pytest.raises(TypeError, match=r"Heater is no World; World\(system, period=...\) is right"):
        diagnose(heated(), Heater())  # type: ignore[arg-type]
