"""Scores of hand-made answers, and the baselines on a case that anyone solves."""

import json
import math

import numpy as np
import pytest

from benchmarks.blind import diagnosis as blind_diagnosis
from benchmarks.blind.baselines import afternoon, chance
from benchmarks.blind.diagnosis import Settings, diagnose_one, read_log, run_one, write
from benchmarks.blind.scoring import Truth, classes, matches, region_of, score, sizes
from benchmarks.blind.tables import Row, confusion, label, tabulate
from experiments.result_tables import read_rows
from visadapt.confidence import wilson
from visadapt.effects.catalogue import catalogue


def cause(effect, alike=(), **parameters):
    return {
        "effect": effect,
        "parameters": {n: {"value": v, "unit": "1", "ci90": ci} for n, (v, ci) in parameters.items()},
        "probability": 1.0,
        "indistinguishable_from": list(alike),
    }


def answer(verdict, *causes, regions=(), ranking=None, closed=0.9):
    first = [c["effect"] for c in causes]
    return {
        "schema": 2,
        "verdict": verdict,
        "where": {"regions": list(regions)},
        "causes": list(causes),
        "ranking": [{"effects": first, "probability": 0.8}] if ranking is None else ranking,
        "gap": {"closed": closed},
    }


def truth(kind, **effects):
    return Truth(kind, effects, dict.fromkeys(effects, 2.0))


FRICTION = truth("single", viscous_friction={"coefficient": 2.0})


def test_a_single_that_is_named():
    s = score(FRICTION, answer("identified", cause("viscous_friction", coefficient=(2.2, [1.9, 2.5]))))
    assert (s.found, s.exact, s.top3, s.first_right) == (True, True, True, True)
    assert s.errors == [pytest.approx(0.1)]
    assert s.covered == [True]
    assert (s.closed, s.strength, s.probability) == (0.9, 2.0, 0.8)


def test_a_single_named_among_others():
    s = score(FRICTION, answer("identified", cause("viscous_friction"), cause("gust")))
    assert (s.found, s.exact, s.top3, s.first_right) == (True, False, False, False)


def test_a_single_that_is_missed():
    for said in (answer("identified", cause("gust")), answer("no_gap"), answer("unexplained")):
        s = score(FRICTION, said)
        assert (s.found, s.exact, s.top3, s.errors) == (False, False, False, [])


def test_classes_count_up_to_three_and_only_where_ambiguous():
    alike = cause("quadratic_drag", ["viscous_friction", "coulomb_friction"])
    s = score(FRICTION, answer("ambiguous", alike))
    assert (s.found, s.exact, s.top3, s.first_right, s.closed) == (True, True, False, True, None)
    assert not score(FRICTION, answer("identified", alike)).found
    large = cause("quadratic_drag", ["viscous_friction", "coulomb_friction", "pole_damping"])
    assert not score(FRICTION, answer("ambiguous", large)).found


def test_a_slight_cause_is_not_one_too_many_and_counts_where_it_is_true():
    slight = cause("actuator_delay", ["measurement_delay"]) | {"slight": True}
    s = score(FRICTION, answer("identified", cause("viscous_friction"), slight))
    assert (s.found, s.exact) == (True, True)
    assert not score(FRICTION, answer("identified", cause("viscous_friction"), cause("actuator_delay"))).exact
    both = truth("pair", viscous_friction={"coefficient": 1.0}, measurement_delay={"delay": 0.01})
    assert score(both, answer("identified", cause("viscous_friction"), slight)).exact


def test_what_was_foreign_and_has_joined_the_catalogue_is_to_be_found():
    effect = {"effect": "stribeck_friction", "parameters": {"force": 2.0, "speed": 0.1}, "strength": 3.0}
    known = Truth.of({"kind": "foreign", "effects": [effect]})
    assert (known.kind, known.effects["stribeck_friction"]["breakaway"]) == ("single", 2.0)
    cable = {"effect": "pivot_cable", "parameters": {"torque": 0.1}, "strength": 3.0}
    assert Truth.of({"kind": "foreign", "effects": [cable]}).kind == "foreign"


def test_alternatives_that_are_listed_as_causes_are_one_class():
    said = answer("ambiguous", cause("actuator_bias", ["constant_force"]), cause("constant_force", ["actuator_bias"]))
    assert classes(said) == [{"actuator_bias", "constant_force"}]
    assert score(truth("single", constant_force={"force": 1.0}), said).exact
    assert label(said) == "actuator_bias/constant_force"


def test_pairs_and_triples_need_a_class_each():
    pair = truth("pair", gust={"start": 1.0, "end": 2.0, "force": 1.0}, spring={"stiffness": 1.0, "rest": 0.0})
    assert score(pair, answer("identified", cause("spring"), cause("gust"))).exact
    more = score(pair, answer("identified", cause("spring"), cause("gust"), cause("dropout")))
    assert (more.found, more.exact) == (True, False)
    assert not score(pair, answer("identified", cause("spring"))).found
    # One class cannot stand for two.
    assert not score(pair, answer("ambiguous", cause("spring", ["gust"]))).found
    assert matches({"a", "b", "c"}, [{"a", "b"}, {"a"}, {"c"}])
    assert not matches({"a", "b", "c"}, [{"a", "b"}, {"c"}])


def test_top_three_is_by_the_ranking():
    ranking = [
        {"effects": [e], "probability": p} for e, p in (("gust", 0.5), ("spring", 0.3), ("viscous_friction", 0.1))
    ]
    assert score(FRICTION, answer("identified", cause("gust"), ranking=ranking)).top3
    assert not score(FRICTION, answer("identified", cause("gust"), ranking=ranking[:2])).top3


def test_scales_are_judged_by_their_change_too():
    mass = truth("single", cart_mass={"scale": 1.2})
    s = score(mass, answer("identified", cause("cart_mass", scale=(1.1, [1.0, 1.15]))))
    assert s.errors == [pytest.approx(0.1 / 1.2)]
    assert s.deviations == [pytest.approx(0.5)]
    assert s.covered == [False]


def test_the_scale_that_is_off_counts():
    scale = truth("single", sensor_scale={"position": 1.0, "angle": 0.8})
    s = score(scale, answer("identified", cause("sensor_scale", position=(1.0, [1, 1]), angle=(0.88, [0.7, 0.9]))))
    assert s.errors == [pytest.approx(0.1)]
    assert s.covered == [True, True]


def test_a_phase_is_covered_modulo_a_turn():
    wave = {"amplitude": 1.0, "frequency": 1.0, "phase": -3.1, "offset": 0.0}
    s = score(
        truth("single", periodic_force=wave), answer("identified", cause("periodic_force", phase=(3.1, [3.0, 3.3])))
    )
    assert s.covered == [True]


def test_regions_are_compared_by_intersection_over_union():
    patch = truth("single", friction_patch={"start": 0.0, "end": 0.4, "coefficient": 5.0})
    regions = [
        {"variable": "x", "from": 0.1, "to": 0.5, "share": 0.7},
        {"variable": "x", "from": 0.0, "to": 0.4, "share": 0.2},
        {"variable": "time", "from": 0.0, "to": 0.4, "share": 0.9},
    ]
    assert score(patch, answer("identified", cause("friction_patch"), regions=regions)).overlaps == [pytest.approx(0.6)]
    assert score(patch, answer("no_gap")).overlaps == [0.0]


def test_a_push_is_told_of_wrongly_where_nobody_pushed():
    said = answer("identified", cause("viscous_friction"))
    said["where"]["pushes"] = [{"load": "cart_force"}]
    gust = truth("single", gust={"start": 1.0, "end": 2.0, "force": 4.0})
    told = [score(one, said).pushed for one in (FRICTION, truth("none"), gust, truth("foreign", kicks={"force": 1.0}))]
    assert told == [True, True, None, None]
    assert score(FRICTION, answer("no_gap")).pushed is False


def test_tables_hold_shares_with_their_intervals():
    none, foreign = truth("none"), truth("foreign", kicks={"force": 1.0})
    right = answer("identified", cause("viscous_friction", coefficient=(2.0, [1.9, 2.1])))
    pairs = [
        (FRICTION, right),
        (FRICTION, answer("identified", cause("gust"))),
        (none, answer("no_gap", ranking=[{"effects": [], "probability": 0.9}])),
        (none, answer("identified", cause("gust"))),
        (foreign, answer("unexplained")),
    ]
    rows = {r.measure: r for r in tabulate("hard", "someone", [score(t, a) for t, a in pairs], [1.0, 2.0, 9.0])}
    assert rows["single: named, nothing else"].value == 0.5
    assert (rows["single: named, nothing else"].low, rows["single: named, nothing else"].high) == wilson(1, 2)
    assert rows["none: no_gap"].value == 0.5
    assert rows["none: something named"].value == 0.5
    assert rows["foreign: unexplained"].value == 1.0
    assert rows["coverage of 90 % intervals"].n == 1
    assert rows["seconds"].value == 2.0
    # 0.8 right, 0.8 wrong twice, 0.9 right; the foreign one has no right set.
    assert rows["Brier score"].value == pytest.approx((0.04 + 0.64 + 0.01 + 0.64) / 4)
    assert rows["Brier score"].n == 4
    assert rows["expected calibration error"].value == pytest.approx((abs(2.4 - 1) + abs(0.9 - 1)) / 4)
    assert rows["single: named, nothing else, strength 1.5 to 2.5"].n == 2
    taken = {(line["truth"], line["answer"]): line["count"] for line in confusion("hard", "someone", pairs)}
    assert taken == {
        ("viscous_friction", "viscous_friction"): 1,
        ("viscous_friction", "gust"): 1,
        ("nothing", "no_gap"): 1,
        ("nothing", "gust"): 1,
        ("foreign: kicks", "unexplained"): 1,
    }


def test_wilsons_interval():
    # Newcombe (1998), table I: 81 of 263.
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert wilson(0, 10)[0] == 0.0
    assert all(math.isnan(end) for end in wilson(0, 0))


def test_every_named_kind_can_be_scored():
    own = [effect for effect in catalogue() if effect.__module__.startswith("visadapt.")]
    for effect in own:
        assert sizes(effect.name) or region_of(effect.name)
    assert sizes("wind") == {"velocity_x": 0.0, "velocity_y": 0.0, "velocity_z": 0.0}
    assert sizes("sensor_scale") == {"position": 1.0, "angle": 1.0}
    assert sizes("friction_patch") == {"coefficient": 0.0}
    assert sizes("frozen_zone") == {}
    regions = {effect.name: region_of(effect.name) for effect in own if region_of(effect.name)}
    assert {name: region[0] for name, region in regions.items()} == {
        "friction_patch": "x",
        "gust": "time",
        "frozen_zone": "theta",
    }


def test_what_no_recording_shows_is_rightly_no_gap():
    hidden = truth("none", position_offset={"offset": 0.1})
    s = score(hidden, answer("no_gap", ranking=[{"effects": [], "probability": 0.9}]))
    assert (s.found, s.first_right, s.errors) == (None, True, [])
    named = score(hidden, answer("identified", cause("spring")))
    assert (named.found, named.first_right) == (None, False)


@pytest.fixture
def pushed(tmp_path):
    """Two episodes of a source with a constant force of 3 N, nearly without noise."""
    from datasets.blind.plant import MAX_FORCE, nominal

    rng, lines = np.random.default_rng(0), ["episode,time,x,x_dot,theta,theta_dot,command"]
    for episode in range(2):
        plant, state = nominal(1), np.array([[0.0], [0.0], [0.05], [0.0]])
        for row in range(60):
            u = float(np.clip(0.8 * state[2, 0] + 0.15 * state[3, 0] + 0.05 * rng.normal() - 0.1, -1, 1))
            seen = state[:, 0] + rng.normal(size=4) * [1e-3, 5e-3, 1e-3, 5e-3]
            lines.append(f"{episode},{row * 0.05:.2f}," + ",".join(f"{v:.6f}" for v in seen) + f",{u:.6f}")
            for _ in range(50):
                state = plant.step(0.0, state, np.array([MAX_FORCE * u + 3.0]), 1e-3)
    path = tmp_path / "0000.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_the_afternoons_method_names_a_large_force(pushed):
    said = afternoon(pushed)
    assert classes(said) == [{"constant_force", "actuator_bias"}]
    (value,) = [c["parameters"] for c in said["causes"]]
    estimate = value.get("force") or value["offset"]
    assert estimate["value"] * (1 if "force" in value else 30) == pytest.approx(3.0, abs=0.1)
    json.dumps(said)


def test_chance_repeats(pushed):
    assert chance(pushed) == chance(pushed)


def test_a_log_is_taken_up_again(tmp_path, pushed, monkeypatch):
    calls = []

    def count(path):
        calls.append(path.name)
        if path.name == "0001.csv" and len(calls) == 2:
            raise ValueError("no")
        return answer("no_gap")

    monkeypatch.setitem(blind_diagnosis.DIAGNOSERS, "count", count)
    other = tmp_path / "0001.csv"
    other.write_text(pushed.read_text())
    log = tmp_path / "log.jsonl"
    first = run_one("count", [pushed, other], log, jobs=1)
    assert first["0001.csv"]["error"] == "ValueError: no"
    log.write_text(log.read_text() + '{"file": "00')
    second = run_one("count", [pushed, other], log, jobs=1)
    # The error was tried again, the torn line forgotten, the answer kept.
    assert calls == ["0000.csv", "0001.csv", "0001.csv"]
    assert set(read_log(log)) == set(second) == {"0000.csv", "0001.csv"}
    other.write_text(other.read_text() + "\n")
    run_one("count", [pushed, other], log, jobs=1)
    assert calls[3:] == ["0001.csv"]


def test_a_diagnoser_whose_package_is_missing_is_skipped(pushed, monkeypatch):
    def missing(path):
        raise ModuleNotFoundError("No module named 'pysindy'")

    monkeypatch.setitem(blind_diagnosis.DIAGNOSERS, "pysindy", missing)
    with pytest.raises(blind_diagnosis.Skipped, match="pysindy: skipped, No module named 'pysindy'"):
        diagnose_one("pysindy", pushed)


def test_other_lines_of_a_table_stay(tmp_path):
    out = tmp_path / "table.csv"
    write(out, [Row("hard", "a", "m", 0.5, 0.1, 0.9, 4)], [])
    write(out, [Row("hard", "b", "m", 0.25, math.nan, math.nan, 4)], [])
    assert read_rows(out) == [
        {"kind": "hard", "diagnoser": "a", "measure": "m", "value": "0.5", "low": "0.1", "high": "0.9", "n": "4"},
        {"kind": "hard", "diagnoser": "b", "measure": "m", "value": "0.25", "low": "", "high": "", "n": "4"},
    ]


def test_unknown_diagnosers_are_named():
    with pytest.raises(SystemExit, match="no such diagnoser: nobody; there are ours, afternoon"):
        blind_diagnosis.main(Settings(diagnosers=("nobody",)))
