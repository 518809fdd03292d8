"""The sets of causes that explain a recording equally well, of a diagnosis that is ambiguous."""

from __future__ import annotations

from collections.abc import Sequence

from visadapt.diagnosis.result import Cause, first_explanation


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
