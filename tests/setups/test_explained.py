from dataclasses import replace

import numpy as np
import pytest
import torch

import visadapt as va
from tests.creep import Creep
from tests.own_systems import Pendulum
from visadapt.diagnosis import excitations, planning
from visadapt.diagnosis.result import SCHEMA_VERSION
from visadapt.diagnosis.verdict import CLOSES_BUT
from visadapt.effects import EFFECTS
from visadapt.recordings import read_recording
from visadapt.setups.explained import explained
from visadapt.setups.nearest import kept_nearest
from visadapt.setups.target_checks import doubts
from visadapt.storage.run_folder import read_json, write_json
from visadapt.targets import TargetError, synthetic

NOISE = torch.tensor([0.005, 0.02, 0.009, 0.05])


class ReadingNoise(va.SensingEffect):
    """White noise on all readings, as sensors have it."""

    name = "reading_noise"
    table = ()

    def apply_to(self, measured, memory, period, generator):
        return measured + NOISE.to(measured) * torch.randn(measured.shape, generator=generator).to(measured), memory


EFFECTS.pop("reading_noise")  # no cause that a diagnosis may name


def rivals(folder):
    """What each cause that a diagnosis named cannot be told from."""
    causes = read_json(folder / "diagnosis.json")["causes"]
    return {cause["effect"]: cause["indistinguishable_from"] for cause in causes}


class Knee(Pendulum):
    name, loads = "knee_of_a_test", (va.Variable("knee", "N m", -1.0, 1.0),)


def test_what_a_file_names_on_a_system_of_ones_own_is_known_before_it_is_read(tmp_path):
    assert "knee.viscous_friction" not in EFFECTS
    values = {"coefficient": {"value": 0.1, "unit": "N m s/rad", "ci90": [0.09, 0.11]}}
    cause = {"effect": "knee.viscous_friction", "parameters": values, "indistinguishable_from": []}
    found = {"schema": SCHEMA_VERSION, "system": Knee.name, "verdict": "identified", "causes": [cause]}
    write_json(tmp_path / "found.json", found)
    (effect,) = va.load_effects(tmp_path / "found.json", Knee())
    assert effect.get_parameter("coefficient").item() == pytest.approx(0.1)
    with pytest.raises(ValueError, match=r"found.json: a diagnosis of a knee_of_a_test, where a cartpole is given"):
        va.load_effects(tmp_path / "found.json", va.CartPole())


class Ankle(Pendulum):
    name, loads = "ankle_of_a_test", (va.Variable("ankle", "N m", -1.0, 1.0),)


def test_the_nearest_effects_on_a_system_of_ones_own_are_known_before_they_are_read(tmp_path):
    assert "ankle.coulomb_friction" not in EFFECTS
    write_json(tmp_path / "nearest.json", {"ankle.coulomb_friction": {"torque": 0.1}})
    (effect,) = kept_nearest(tmp_path / "diagnosis.json", Ankle())
    assert effect.get_parameter("torque").item() == pytest.approx(0.1)
    with pytest.raises(ValueError, match=r"nearest\.json: names ankle\.coulomb_friction, which is not known here"):
        kept_nearest(tmp_path / "diagnosis.json", va.CartPole())


def test_an_angle_of_the_opposite_sign_is_refused_since_the_policy_would_drive_the_wrong_way(tmp_path, only_effects):
    only_effects("viscous_friction")
    policy, generator = va.load_policy(va.shipped("cartpole_states")), torch.Generator().manual_seed(0)
    (found,) = va.run(va.SyntheticTarget(), policy, 1, 150, generator, exploration=0.05)
    turned = replace(found.episode, state=found.episode.state * np.array([1, 1, -1, -1]))
    for name, episode in (("as it is", found.episode), ("turned", turned)):
        va.write_recording(tmp_path / f"{name}.h5", [episode])
    explain = explained(va.World(va.CartPole()))
    assert explain([tmp_path / "as it is.h5"], tmp_path / "as it is.json").verdict == "no_gap"
    with pytest.raises(TargetError, match=r"the angle of the target has the opposite sign .* scale = -1\.0"):
        explain([tmp_path / "turned.h5"], tmp_path / "turned.json")


def test_a_command_of_the_opposite_sign_is_refused_where_no_episode_is_long_enough_to_diagnose(tmp_path):
    policy, source = va.load_policy(va.shipped("cartpole_states")), va.World(va.CartPole())

    class Turned(va.SyntheticTarget):
        def step(self, action):
            return super().step(-action)

    for name, target in (("right", va.SyntheticTarget()), ("turned", Turned())):
        runs = va.run(target, policy, 6, 8, torch.Generator().manual_seed(0), exploration=0.1)
        va.write_recording(tmp_path / f"{name}.h5", [run.episode for run in runs])
    explain = explained(source)
    found = explain([tmp_path / "right.h5"], tmp_path / "right.json")
    assert found.verdict == "48 of 48 samples are in episodes shorter than 0.5 s, not diagnosed"
    assert not found.complete
    with pytest.raises(TargetError, match=r"turned\.h5: command of the target has the opposite sign .* scale = -1\.0"):
        explain([tmp_path / "turned.h5"], tmp_path / "turned.json")


@pytest.mark.parametrize(("rows", "factors", "problem"), [
    (150, [1, 1, 180 / np.pi, 180 / np.pi], r"rad/s; radians are right \(these look like degrees\)"),
    (8, [1000, 1000, 1, 1], r"m/s; metres are right \(these look like centimetres or millimetres\)"),
])  # fmt: skip
def test_readings_in_another_unit_are_to_be_mended_in_the_target(tmp_path, rows, factors, problem):
    policy, generator = va.load_policy(va.shipped("cartpole_states")), torch.Generator().manual_seed(0)
    runs = va.run(va.SyntheticTarget(), policy, 2, rows, generator, exploration=0.3)
    episodes = [replace(run.episode, state=run.episode.state * np.array(factors)) for run in runs]
    va.write_recording(tmp_path / "run.h5", episodes, [state.name for state in va.CartPole.states], ["command"])
    source = va.World(va.CartPole())
    with pytest.raises(TargetError, match=problem) as refused:
        explained(source)([tmp_path / "run.h5"], tmp_path / "found.json")
    assert str(refused.value).endswith("mend it in the target, or its map, and begin in another folder")
    assert "--columns" not in str(refused.value)
    assert doubts([tmp_path / "run.h5"], episodes, source) == [str(refused.value)]


def test_a_velocity_of_a_dead_sensor_is_doubted(tmp_path):
    policy, source = va.load_policy(va.shipped("cartpole_states")), va.World(va.CartPole())
    (found,) = va.run(va.SyntheticTarget(), policy, 1, 150, torch.Generator().manual_seed(0), exploration=0.3)
    dead = replace(found.episode, state=found.episode.state * np.array([1, 0, 1, 1]))
    va.write_recording(tmp_path / "run.h5", [dead], [state.name for state in va.CartPole.states], ["command"])
    (doubt,) = doubts([tmp_path / "run.h5"], [dead], source)
    assert doubt.endswith("x_dot never changes although its position does: a dead sensor; it was left out")


def test_nothing_is_doubted_of_a_target_that_shows_what_the_source_has(tmp_path):
    policy, source = va.load_policy(va.shipped("cartpole_states")), va.World(va.CartPole())
    for rows in (8, 150):
        runs = va.run(va.SyntheticTarget(), policy, 2, rows, torch.Generator().manual_seed(0), exploration=0.3)
        episodes = [run.episode for run in runs]
        va.write_recording(tmp_path / f"{rows}.h5", episodes)
        assert doubts([tmp_path / f"{rows}.h5"], episodes, source) == []


def test_what_named_causes_leave_is_left_to_a_residual(tmp_path, only_effects):
    only_effects("viscous_friction")
    policy, path = va.load_policy(va.shipped("cartpole_states")), tmp_path / "found.json"
    target = va.SyntheticTarget(lambda batch, generator: [va.effects.ViscousFriction(coefficient=5.0)])
    runs = va.run(target, policy, 1, 60, torch.Generator().manual_seed(0), exploration=0.3)
    va.write_recording(tmp_path / "run.h5", [runs[0].episode])
    explain = explained(va.World(va.CartPole()))
    found = explain([tmp_path / "run.h5"], path)
    assert (found.verdict, found.complete) == ("identified", True)
    content = read_json(path)
    write_json(path, content | {"warnings": [f"{CLOSES_BUT}: an unexplained load depends on x"]})
    left = explain([tmp_path / "run.h5"], path)
    assert (left.verdict, left.complete) == ("identified", False)
    assert [effect.name for effect in left.effects] == ["viscous_friction"]


def test_where_an_unexplained_gap_is_nearly_closed_a_residual_is_to_learn_the_rest_alone(tmp_path, only_effects):
    only_effects("coulomb_friction", "actuator_gain")
    policy, generator = va.load_policy(va.shipped("cartpole_states")), torch.Generator().manual_seed(0)
    target = va.SyntheticTarget(lambda batch, generator: [Creep(0.1)])
    va.write_recording(tmp_path / "a.h5", [va.run(target, policy, 1, 200, generator, exploration=0.3)[0].episode])
    explain, path = explained(va.World(va.CartPole())), tmp_path / "found.json"
    for explanation in (explain([tmp_path / "a.h5"], path), explain([tmp_path / "a.h5"], path)):
        (friction,) = explanation.effects
        assert (explanation.verdict, explanation.complete, friction.name) == ("unexplained", False, "coulomb_friction")
        assert friction.get_parameter("force").item() == pytest.approx(3.0, rel=0.2)


def test_of_explanations_that_fit_alike_one_with_right_sensors_is_taken_and_the_others_are_kept(tmp_path):
    policy, generator = va.load_policy(va.shipped("cartpole_states")), torch.Generator().manual_seed(0)
    va.write_recording(tmp_path / "a.h5", [va.run(va.SyntheticTarget(), policy, 1, 60, generator)[0].episode])
    values = {"angle_offset": {"offset": 0.02}, "constant_force": {"force": 1.0}}
    odds = {"angle_offset": 0.6, "constant_force": 0.4}
    causes = [
        {
            "effect": name,
            "parameters": {p: {"value": v, "unit": "", "ci90": [v, v]} for p, v in values[name].items()},
            "slight": False,
            "indistinguishable_from": [other for other in values if other != name],
        }
        for name in values
    ]
    ranking = [{"effects": [name], "probability": p, "gap_closed": 1.0} for name, p in odds.items()]
    found = {"verdict": "ambiguous", "causes": causes, "ranking": ranking, "warnings": []}
    write_json(tmp_path / "found.json", {"schema": SCHEMA_VERSION, "system": "cartpole", **found})
    explanation = explained(va.World(va.CartPole()))([tmp_path / "a.h5"], tmp_path / "found.json")
    assert [effect.name for effect in explanation.effects] == ["constant_force"]
    assert [[effect.name for effect in each] for each in explanation.others] == [["angle_offset"]]


def test_what_two_causes_explain_is_settled_by_an_experiment_in_the_next_round(tmp_path, monkeypatch, only_effects):
    only_effects("viscous_friction", "coulomb_friction", "actuator_gain")
    # Three excitations of one size, and coarser steps of the target, for the time they take.
    monkeypatch.setattr(excitations, "CYCLES", (0.4,))
    monkeypatch.setattr(excitations, "BIT_ROWS", ())
    monkeypatch.setattr(planning, "SIZES", (0.4,))
    monkeypatch.setattr(synthetic, "SMOOTH_STEP", 0.0125)
    effects = [va.effects.ViscousFriction(coefficient=0.3), ReadingNoise()]
    target = va.SyntheticTarget(lambda batch, generator: effects)
    policy, source = va.load_policy(va.shipped("cartpole_states")), va.World(va.CartPole())
    run = va.adapt(policy, source, target, 300, tmp_path, round_samples=150, iterations=1, diagnose=True)
    assert run.rounds[0].explanation.verdict == "ambiguous"
    assert rivals(tmp_path / "round-01")["viscous_friction"] == ["coulomb_friction"]
    assert "coulomb_friction" not in rivals(tmp_path / "round-02")["viscous_friction"]
    added = np.loadtxt(tmp_path / "round-01" / "plan.csv", delimiter=",", skiprows=1)[:, 1]
    (episode,) = read_recording(tmp_path / "round-02" / "recording.h5")
    assert np.corrcoef(added, episode.action[:-1, 0])[0, 1] > 0.5
    assert run.ledger.used == 300
