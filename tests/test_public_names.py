"""Every public name is listed once and documented with an example, which is run here."""

import doctest
import inspect
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import visadapt as va
from visadapt.storage.checkpoints import CheckpointError

ROOT = Path(__file__).parents[1]
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


@pytest.mark.parametrize("name", dir(va))
def test_the_example_of_every_public_name_runs(name):
    if name == "GymnasiumTarget":
        pytest.importorskip("mujoco")
    found = getattr(va, name)
    examples = doctest.DocTestFinder(recurse=inspect.isclass(found)).find(found, name, globs={})
    assert examples[0].examples or ">>>" in (found.__doc__ or ""), f"{name} has no example"
    for example in examples:
        report: list[str] = []
        doctest.DocTestRunner(optionflags=FLAGS).run(example, out=report.append)
        assert not report, "".join(report)


def test_the_package_itself_imports_neither_torch_nor_numpy():
    code = "import sys, visadapt; sys.exit(bool({'torch', 'numpy'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0


def test_a_name_that_is_not_there_is_an_attribute_error():
    name = "adopt"
    with pytest.raises(AttributeError, match="No visadapt attribute adopt"):
        getattr(va, name)


def test_the_names_of_the_effects_are_all_effects_and_what_states_them():
    from types import ModuleType

    from tests.effects.registry import LIBRARY

    names = {name: value for name, value in vars(va.effects).items() if not name.startswith("_")}
    exported = {name for name, value in names.items() if not isinstance(value, ModuleType)}
    effects = {name for name in exported if inspect.isclass(names[name]) and issubclass(names[name], va.Effect)}
    assert exported - effects == {"EFFECTS", "Parameter", "Role", "Stage"}
    assert {effect.__name__ for effect in LIBRARY.values()} <= effects
    modules = {name for name, value in names.items() if isinstance(value, ModuleType)}
    assert all(names[name].__name__ == f"visadapt.effects.{name}" for name in modules)


SHORTER = {
    "source.system), source)": "source.system), source, [va.effects.ConstantForce])",
    ", world)": ", world, iterations=30)",
    "va.score(policy, target)": "va.score(policy, target, episodes=10, steps=60)",
    '"film.mp4")': '"film.mp4", seconds=0.2)',
}
"""Arguments with which the README's script takes seconds: one effect to look for, fewer iterations and episodes."""


def test_the_script_of_the_readme_leads_from_a_diagnosis_to_a_better_policy(tmp_path, monkeypatch, capsys):
    import torch

    monkeypatch.chdir(tmp_path)
    script = (ROOT / "README.md").read_text().split("```python\n", 1)[1].split("```", 1)[0]
    for shown, shorter in SHORTER.items():
        assert script.count(shown) == 1, shown
        script = script.replace(shown, shorter)
    target, unadapted = va.SyntheticTarget(va.constant_force(2.0)), va.load_policy(va.shipped("cartpole_states"))
    runs = va.run(target, unadapted, 3, 40, torch.Generator().manual_seed(0), exploration=0.3)
    with Path("run.csv").open("w") as file:
        print("episode,time,x,x_dot,theta,theta_dot,command", file=file)
        for number, run in enumerate(runs):
            episode = run.episode
            for time, state, action in zip(episode.time, episode.state, episode.action, strict=True):
                print(number, time, *state, *action, sep=",", file=file)
    done: dict[str, Any] = {}
    exec(compile(script, "README.md", "exec"), done)
    assert "constant_force" in str(done["found"])
    assert next(done["world"].effects[0].parameters()).item() == pytest.approx(2.0, abs=0.1)
    before, after = (va.score(each, target, episodes=10, steps=60) for each in (unadapted, done["policy"]))
    assert after.mean_speed < 0.7 * before.mean_speed
    assert str(after) in capsys.readouterr().out
    assert Path("film.mp4").stat().st_size > 1000


@pytest.mark.parametrize(("verdict", "right"), [("no_gap", "the source explains"), ("unexplained", "adapt with a res")])
def test_a_diagnosis_that_named_nothing_has_no_effects_and_says_why(verdict, right):
    from visadapt.diagnosis.result import Gap, RecordingSummary, Where

    gap = Gap("error", 1.0, 1.0, 1.0, 1.0, 0.0)
    found = va.Diagnosis("cartpole", RecordingSummary(4, 240, 0.05), verdict, Where({}, {}), (), (), gap, "")
    with pytest.raises(ValueError, match=f"the verdict is {verdict}: .*; {right}") as caught:
        found.effects()
    assert "\n" not in str(caught.value)


def test_of_effects_that_fit_alike_the_first_is_taken():
    from visadapt.diagnosis.result import Cause, Estimate, Gap, RecordingSummary, Where

    def cause(name, parameter, *alike):
        return Cause(name, {parameter: Estimate(1.0, "", (0.5, 1.5))}, 0.5, 0.9, indistinguishable_from=alike)

    causes = (
        cause("viscous_friction", "coefficient", "quadratic_drag"),
        cause("quadratic_drag", "coefficient", "viscous_friction"),
        cause("constant_force", "force"),
    )
    gap = Gap("error", 1.0, 0.1, 0.1, 0.1, 1.0)
    found = va.Diagnosis("cartpole", RecordingSummary(4, 240, 0.05), "ambiguous", Where({}, {}), causes, (), gap, "")
    assert [effect.name for effect in found.effects()] == ["viscous_friction", "constant_force"]


class TestPolicyFiles:
    def test_an_adapted_policy_comes_back_with_the_residual_that_it_reads(self, tmp_path):
        import torch

        source = va.World(va.CartPole(), [va.effects.ViscousFriction(coefficient=0.0)])
        policy = va.load_policy(va.shipped("cartpole_states"))
        target = va.SyntheticTarget(va.constant_force(1.0))
        result = va.adapt(policy, source, target, samples=40, folder=tmp_path, iterations=2)
        again = va.load_policy(tmp_path / "policy.safetensors")
        for key, value in result.policy.state_dict().items():
            assert torch.equal(value, again.state_dict()[key]), key
        assert va.score(again, target, 3, steps=30) == va.score(result.policy, target, 3, steps=30)

    def test_what_is_no_policy_is_refused_in_one_line(self, tmp_path):
        with pytest.raises(CheckpointError, match=r"renderer\.safetensors: holds a renderer; a policy"):
            va.load_policy(va.shipped("renderer"))
        with pytest.raises(ValueError, match="no weights 'none' are shipped; there are cartpole_frames, "):
            va.shipped("none")


class TestRefusals:
    def test_a_target_of_another_period(self):
        policy, source = va.load_policy(va.shipped("cartpole_states")), va.World(va.CartPole())
        with pytest.raises(ValueError, match=r"has 0.02 s between actions, the source 0.05 s: make the source World"):
            va.adapt(policy, source, va.SyntheticTarget(period=0.02), samples=20)

    def test_a_policy_of_another_system(self):
        with pytest.raises(ValueError, match=r"the policy is a ReachPolicy .* a cartpole needs a StatePolicy"):
            va.adapt(va.load_policy(va.shipped("fixed_wing")), va.World(va.CartPole()))

    def test_a_quadrotor_without_references(self):
        with pytest.raises(ValueError, match="give some, by references= or --references"):
            va.train(va.World(va.Quadrotor(), period=0.1))
