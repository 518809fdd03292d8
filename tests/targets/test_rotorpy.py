"""rotorpy's multirotor as a target.

All tests but those of the error lines need the extra `rotorpy`, which is neither in `dev` nor in CI: there they are
skipped. Run them where it is installed: pip install 'visadapt[rotorpy]'.
"""

import sys

import numpy as np
import pytest
import torch

from benchmarks.rotorpy_diagnosis import rows_of
from experiments.rotorpy_published import published
from tests.flying import PERIOD, seeded, straight, waves
from train.rotorpy_quadrotor import explain
from visadapt.recordings import Episode
from visadapt.systems.rigid_body import ATTITUDE, POSITION, RATES, VELOCITY
from visadapt.targets import TargetError, rotorpy as ours
from visadapt.targets.rotorpy import SOURCE, Air, RotorpyTarget
from visadapt.tasks.follow import Follow
from visadapt.tasks.references import Reference
from visadapt.world import World

STILL = Air()
DRAG = 4 * 5.09e-6 * 1632.4 / 0.044
"""1/s: rotorpy's k_d times the speed of four rotors at a hover, over the mass"""


@pytest.fixture
def rotorpy():
    for module in ("rotorpy", "torchdiffeq", "roma"):
        pytest.importorskip(module)


def level(speed=0.0, count=1):
    """References straight ahead along x at a steady speed."""
    velocity = torch.tensor([speed, 0.0, 0.0]).expand(count, 41, 3)
    position = velocity * PERIOD * torch.arange(41)[:, None]
    return Follow(Reference.of(torch.stack((position, velocity, 0 * position, 0 * position)), PERIOD))


def fly(target, commands, batch=1, seed=0):
    """States (K + 1, batch, 13) under commands (K, batch, 4)."""
    states = [target.reset(batch, seeded(seed)).state]
    states += [target.step(command).state for command in commands]
    return torch.stack(states)


def hovering(steps, batch=1):
    commands = torch.zeros(steps, batch, 4)
    commands[..., 0] = SOURCE.hover()
    return commands


def rough(steps, batch=1, size=0.5, seed=3):
    return size * (2 * torch.rand(steps, batch, 4, generator=seeded(seed)) - 1)


@pytest.mark.usefixtures("rotorpy")
def test_the_source_is_what_rotorpy_publishes():
    vehicle = RotorpyTarget(level()).vehicle
    assert vehicle["mass"] == SOURCE.mass
    assert vehicle["k_w"] == SOURCE.roll_gain == SOURCE.yaw_gain
    assert np.linalg.norm(vehicle["rotor_pos"]["r1"]) == pytest.approx(SOURCE.arm_length)
    assert vehicle["k_m"] / vehicle["k_eta"] == pytest.approx(SOURCE.torque_to_thrust)
    # The range of our commands is within that of its motors.
    assert SOURCE.mass * SOURCE.max_thrust < 4 * vehicle["k_eta"] * vehicle["rotor_speed_max"] ** 2


@pytest.mark.usefixtures("rotorpy")
def test_in_still_air_the_command_that_hovers_in_the_source_hovers():
    states = fly(RotorpyTarget(level(), air=STILL), hovering(20))
    # Its derivatives are in float32: of 10 m/s2, right to 1e-6, for 2 s.
    torch.testing.assert_close(states[-1], states[0], rtol=0, atol=1e-5)


@pytest.mark.usefixtures("rotorpy")
@pytest.mark.parametrize("command", [-0.7, 0.6])
def test_a_thrust_command_means_the_same_force_once_the_motors_have_followed(command):
    commands = hovering(15)
    commands[..., 0] = command
    states = fly(RotorpyTarget(level(), aero=False), commands)
    asked = float(SOURCE.thrust(commands[0])[0]) - 9.81
    # A second is 20 time constants of the motors.
    assert float(states[15, 0, 5] - states[10, 0, 5]) / 0.5 == pytest.approx(asked, abs=1e-4)


@pytest.mark.usefixtures("rotorpy")
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_rate_command_ends_at_the_same_rate(axis):
    commands = hovering(15)
    commands[..., 1 + axis] = 0.4
    rates = fly(RotorpyTarget(level(), aero=False), commands)[-1, 0, RATES]
    # Its loop is one of second order, nearly critically damped at 10 rad/s: done to 1e-4 after 1.5 s.
    wanted = [0.4 * SOURCE.max_rate * (axis == k) for k in range(3)]
    assert rates.tolist() == pytest.approx(wanted, abs=1e-3)


@pytest.mark.usefixtures("rotorpy")
def test_without_air_and_with_fast_motors_it_flies_as_the_source(monkeypatch):
    commands = rough(12)
    world = World(SOURCE, period=PERIOD, substeps=20)
    at = world.start(level().states_on(torch.tensor([0]), torch.tensor([0])))
    expected = [at.state]
    for command in commands:
        at = world.step(at, command)
        expected.append(at.state)

    def away(h):
        """Largest errors of position, velocity and rates; the rate loop's period and the motors' lag are both `h` s."""
        monkeypatch.setattr(ours, "RATE_LOOP_PERIOD_S", h)
        states = fly(RotorpyTarget(level(), aero=False, changes={"tau_m": h}), commands)
        off = (states - torch.stack(expected)).abs()
        return [float(off[..., part].max()) for part in (POSITION, VELOCITY, RATES)]

    coarse, fine = away(0.01), away(0.005)
    # Thrusts come h late: at h = 5 ms a velocity lacks h times what the thrust now has over a hover's, here 3.8 m/s2 at
    # most. Rates come 1.5 h late, half a period of the rate loop included: a jump by 0.5 rad/s, which turns at
    # 2.6 rad/s2 at first.
    assert fine[1] < 0.02
    assert fine[2] < 0.02
    assert fine[0] < 0.02 * 1.2
    # Nothing else separates the two: with half the lateness, half the difference is left.
    np.testing.assert_allclose(np.array(coarse) / fine, 2, atol=0.4)


@pytest.mark.usefixtures("rotorpy")
def test_drag_slows_it_as_the_rotors_drag_says():
    states = fly(RotorpyTarget(level(speed=2.0), air=STILL), hovering(10))
    # Upright, all that acts along x; lift across the rotors makes it climb, by 0.1 v^2 at first.
    assert float(states[-1, 0, 3]) == pytest.approx(2.0 * np.exp(-DRAG), rel=0.01)
    assert 0.05 < float(states[-1, 0, 5]) < 0.4
    free = fly(RotorpyTarget(level(speed=2.0), aero=False), hovering(10))
    assert float(free[-1, 0, 3]) == pytest.approx(2.0, abs=1e-5)


@pytest.mark.usefixtures("rotorpy")
def test_wind_pushes_it_towards_its_own_velocity():
    states = fly(RotorpyTarget(level(), air=Air(steady=(0.0, -1.5, 0.0))), hovering(10))
    assert float(states[-1, 0, 4]) == pytest.approx(-1.5 * (1 - np.exp(-DRAG)), rel=0.02)
    assert float(states[-1, 0, 3]) == pytest.approx(0.0, abs=1e-4)


@pytest.mark.usefixtures("rotorpy")
def test_each_flight_has_its_own_gusts_and_the_same_seed_the_same():
    target = RotorpyTarget(level(count=3), air=Air(amplitude=(1.0, 1.0, 0.0)))
    first, again, other = (fly(target, hovering(5, 3), 3, seed)[-1, :, VELOCITY] for seed in (0, 0, 1))
    assert first.equal(again)
    assert (first - other).abs().max() > 0.05
    assert (first[0] - first[1]).abs().max() > 0.05


@pytest.mark.usefixtures("rotorpy")
def test_states_are_in_our_order_and_the_quaternion_is_continuous():
    task = Follow(waves(3))
    target = RotorpyTarget(task)
    commands = rough(30, 3, size=1.0)
    commands[:, :, 3] = 1.0  # it turns about z by more than half a turn, where one sign of the quaternion would jump
    commands[:, :, 0] = SOURCE.hover()
    commands = torch.cat((commands, commands, commands))
    states = fly(target, commands, 3)
    torch.testing.assert_close(states[0], task.evaluation_start(3, seeded())[0])
    attitude = states[..., ATTITUDE]
    torch.testing.assert_close(attitude.norm(dim=-1), torch.ones(states.shape[:2]))
    # Never faster than 2 rad/s: within 0.1 s, by 0.2 rad at most.
    assert (attitude[1:] * attitude[:-1]).sum(-1).min() > np.cos(0.1)
    assert attitude[..., 0].min() < -0.5
    assert (states[:, :, POSITION].diff(dim=0) - PERIOD * states[1:, :, VELOCITY]).abs().max() < 0.1


@pytest.mark.usefixtures("rotorpy")
def test_the_batch_flies_as_rotorpys_multirotors_do_one_at_a_time():
    quad_params = pytest.importorskip("rotorpy.vehicles.crazyfliebrushless_params").quad_params
    multirotor = pytest.importorskip("rotorpy.vehicles.multirotor")
    commands, wind = rough(10, 2), (1.5, -1.0, 0.5)
    task = Follow(straight())
    states = fly(RotorpyTarget(task, air=Air(steady=wind)), commands, 2)
    start = states[0].double().numpy()
    exact = {"rtol": 1e-8, "atol": 1e-10}
    vehicle = multirotor.Multirotor(quad_params, control_abstraction="cmd_ctbr", integrator_kwargs=exact)
    for k in range(2):
        x, v, w = start[k, :3], start[k, 3:6], start[k, 10:]
        state = {"x": x, "v": v, "q": np.roll(start[k, 6:10], -1), "w": w, "wind": np.array(wind)}
        state["rotor_speeds"] = np.full(4, np.sqrt(quad_params["mass"] * 9.81 / 4 / quad_params["k_eta"]))
        for command in commands[:, k].double():
            asked = {"cmd_thrust": 0.044 * (9.76 + 7.55 * float(command[0])), "cmd_w": command[1:].numpy()}
            for _ in range(10):
                state = vehicle.step(state, asked, 0.01)
        alone = np.concatenate((state["x"], state["v"], np.roll(state["q"], 1), state["w"]))
        np.testing.assert_allclose(states[-1, k], alone, atol=1e-4)


@pytest.mark.usefixtures("rotorpy")
def test_what_explains_the_gap_is_what_rotorpy_has_in_its_parameters():
    target = RotorpyTarget(Follow(waves(8)), air=Air(steady=(1.5, -0.5, 0.0)))
    commands = 0.15 * torch.randn(40, 8, 4, generator=seeded(4)) + hovering(40, 8)
    states = fly(target, commands, 8)
    actions = torch.cat((commands, 0 * commands[:1])).clamp(-1, 1)
    clock = np.arange(41) * PERIOD
    found = explain([Episode(clock, actions[:, k].numpy(), states[:, k].numpy()) for k in range(8)])
    assert found["drag_x"] == pytest.approx(DRAG, rel=0.1)
    assert found["drag_y"] == pytest.approx(DRAG, rel=0.1)
    assert found["drag_z"] == pytest.approx(4 * 1.19e-5 * 1632.4 / 0.044, rel=0.1)
    assert found["wind_x"] == pytest.approx(1.5, abs=0.1)
    assert found["wind_y"] == pytest.approx(-0.5, abs=0.1)
    assert found["lag"] == pytest.approx(0.05, abs=0.01)
    assert found["lift"] == pytest.approx(4 * 1.11e-3 / 0.044, rel=0.3)
    assert found["explained"] > 0.9


@pytest.mark.usefixtures("rotorpy")
@pytest.mark.parametrize(("axis", "name"), list(enumerate("xyz")))
def test_a_turn_is_braked_as_published(axis, name):
    """With motors that hardly lag: what air leaves of a rate that is asked for."""
    commands = hovering(25)
    commands[..., 1 + axis] = 0.2
    target = RotorpyTarget(level(), air=STILL, changes={"tau_m": 0.011})
    rates = fly(target, commands)[-1, 0, RATES]
    gain = float(SOURCE.roll_gain)
    expected = 0.2 * SOURCE.max_rate * gain / (gain + published(target)[f"damping_{name}"])
    assert float(rates[axis]) == pytest.approx(expected, rel=0.03)


def test_what_was_diagnosed_stands_beside_what_is_published():
    """Drags add, by the mass; only a parameter that stands alone has its interval."""

    def found_at(value):
        return {"value": value, "ci90": [0.9 * value, 1.1 * value]}

    drag = {f"coefficient_{axis}": found_at(value) for axis, value in zip("xyz", (0.022, 0.022, 0.066), strict=True)}
    sizes = {
        "rotor_drag": drag,
        "wind": {"coefficient": found_at(0.011), "velocity_x": found_at(1.4), "velocity_y": found_at(0.1)},
    }
    answer = {"verdict": "unexplained", "ranking": [{"effects": ["wind", "rotor_drag"]}], "gap": {"closed": 0.9}}
    rows = {row["what"]: row for row in rows_of("steady wind", answer, sizes, {"drag_x": 0.755, "wind_x": 1.5})}
    said = [rows[name]["value"] for name in ("verdict", "most probable", "gap closed")]
    assert said == ["unexplained", "wind + rotor_drag", "0.9"]
    assert [rows["drag_x"][key] for key in ("value", "low", "high", "published")] == ["0.75", "", "", "0.755"]
    assert [rows["wind_x"][key] for key in ("value", "low", "high", "published")] == ["1.4", "1.26", "1.54", "1.5"]
    assert [rows["lag"][key] for key in ("value", "low", "high", "published")] == ["", "", "", "0"]


@pytest.mark.usefixtures("rotorpy")
def test_a_step_before_a_reset_is_an_error():
    with pytest.raises(TargetError, match="step before reset"):
        RotorpyTarget(level()).step(hovering(1)[0])


def test_a_missing_rotorpy_is_one_line_that_says_what_to_install(monkeypatch):
    for module in ("rotorpy", "rotorpy.vehicles.multirotor"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(TargetError, match=r"^rotorpy is not installed: pip install 'visadapt\[rotorpy\]'$"):
        RotorpyTarget(level())


@pytest.mark.usefixtures("rotorpy")
def test_what_its_batch_needs_is_named_too(monkeypatch):
    monkeypatch.setitem(sys.modules, "torchdiffeq", None)
    with pytest.raises(TargetError, match=r"^torchdiffeq is not installed: pip install 'visadapt\[rotorpy\]'$"):
        RotorpyTarget(level())
