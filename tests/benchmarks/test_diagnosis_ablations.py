"""The diagnosis without one of its parts: which parts act is noted, and what is left out does not happen."""

import pytest

from benchmarks.blind.ablations import ALL_OF_THEM, PARTS, parts_of, watched, without
from benchmarks.blind.scoring import Truth
from benchmarks.diagnosis_ablations import WHOLE, _row
from tests.diagnosed import record
from visadapt import diagnose
from visadapt.effects import ActuatorGain, CartMass, PoleMass
from visadapt.systems import CartPole
from visadapt.world import World


def test_parts_that_act_are_noted_and_nothing_else_changes():
    recording, catalogue = record([CartMass(scale=1.5)], 2), [ActuatorGain, CartMass, PoleMass]
    alone = diagnose(recording, World(CartPole()), catalogue)
    with watched() as acting:
        found = diagnose(recording, World(CartPole()), catalogue)
    assert found.to_json() == alone.to_json()
    assert {"exchanges", "careful fits"} <= acting
    assert not acting & {"jumps", "coloured noise", "phases of episodes"}


@pytest.mark.parametrize("row", [*PARTS, ALL_OF_THEM])
def test_a_part_is_left_out_and_comes_back(row):
    parts = [PARTS[part] for part in parts_of(row)]
    whole = [getattr(part.owner, part.name) for part in parts]
    with without(row):
        assert all(getattr(part.owner, part.name) is part.without for part in parts)
    assert [getattr(part.owner, part.name) for part in parts] == whole


def test_where_a_part_does_not_act_the_answer_of_the_whole_counts():
    def line(verdict, seconds):
        return {"answer": {"verdict": verdict, "causes": [], "ranking": []}, "seconds": seconds}

    truths = {name: Truth("none", {}, {}) for name in ("one", "two", "three")}
    whole = {name: line("no_gap", 10.0) for name in truths}
    row = _row("hard", "exchanges", truths, whole, {"two": line("unexplained", 6.0)})
    assert (row["acts"], row["none_right"], row["none"]) == (1, 2, 3)
    assert (row["seconds"], row["seconds_whole"]) == (6.0, 10.0)
    assert _row("hard", WHOLE, truths, whole, whole)["none_right"] == 3
