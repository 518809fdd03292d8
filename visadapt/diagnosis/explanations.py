"""The sets of causes that explain a recording equally well, of a diagnosis that is ambiguous."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import TYPE_CHECKING

from visadapt.effects import EFFECTS, SensingEffect

if TYPE_CHECKING:
    from visadapt.diagnosis.result import Cause

CLEARLY_LESS = 0.5
"""Ratio of the probability that all sensors are right to that of a wrong one, among explanations that fit alike, down
to which the sensors are believed."""


def first_explanation(causes: Iterable[Cause]) -> list[Cause]:
    """The causes without those that an earlier one cannot be told from."""
    taken: list[Cause] = []
    for cause in causes:
        if not any(cause.effect in (one.effect, *one.indistinguishable_from) for one in taken):
            taken.append(cause)
    return taken


def explanations(causes: Sequence[Cause]) -> list[list[Cause]]:
    """The first explanation, then this with a cause exchanged for what fits the recording equally well.

    One cause may stand for two that act together, or two for one: two alternatives of the same cause act together if
    they are not alternatives of each other.

    >>> from visadapt.diagnosis.result import Cause
    >>> names = {"quadratic_drag": ("viscous_friction",), "viscous_friction": ("quadratic_drag",)}
    >>> causes = [Cause(name, {}, 0.5, 0.9, indistinguishable_from=others) for name, others in names.items()]
    >>> [[cause.effect for cause in each] for each in explanations(causes)]
    [['quadratic_drag'], ['viscous_friction']]
    """
    of_name = {cause.effect: cause for cause in causes}
    first = first_explanation(causes)
    exchanged: dict[frozenset[str], list[Cause]] = {}
    for cause in first:
        rivals = [name for name in cause.indistinguishable_from if name in of_name]
        for rival in rivals:
            together = [rival]
            for name in rivals:
                if all(name != one and name not in of_name[one].indistinguishable_from for one in together):
                    together.append(name)
            kept = [each for each in first if rival not in each.indistinguishable_from]
            exchanged.setdefault(frozenset(together), [*kept, *(of_name[name] for name in together)])
    return [first, *exchanged.values()]


def preferred(causes: Sequence[Cause], ranking: Iterable[tuple[Collection[str], float]]) -> list[list[Cause]]:
    """The explanations, the one to simulate and to tune a policy by first: the likeliest, or the likeliest in which all
    sensors are right, unless those in which one is wrong are clearly likelier together.

    By its readings a machine is judged: where the motor is weak, a policy that is tuned for a wrong sensor does worse
    by them than the source policy. `ranking` has sets of effects, by their names, and their probabilities, the most
    probable first.
    """
    sets = explanations(causes)
    probability: dict[frozenset[str], float] = {}
    for names, p in ranking:
        probability.setdefault(frozenset(names), p)
    odds = [probability.get(frozenset(cause.effect for cause in each), 0.0) for each in sets]
    wrong = [any(issubclass(EFFECTS[cause.effect], SensingEffect) for cause in each) for each in sets]
    believed = sum(p for p, is_wrong in zip(odds, wrong, strict=True) if not is_wrong)
    if not all(wrong) and believed > CLEARLY_LESS * (sum(odds) - believed):
        first = wrong.index(False)
        return [sets[first], *sets[:first], *sets[first + 1 :]]
    return sets
