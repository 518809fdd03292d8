"""A diagnosis in words: the verdict in a sentence, the text for the terminal, and what the templates use."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import jinja2

from visadapt.diagnosis.explanations import explanations
from visadapt.diagnosis.result import (
    AMBIGUOUS,
    NO_GAP,
    Box,
    Cause,
    Diagnosis,
    Estimate,
    Noise,
    Push,
    RecordingSummary,
    Region,
    without_slight,
)
from visadapt.diagnosis.words import (
    BESIDE_PUSHES,
    BETWEEN_ROWS,
    CHANGES,
    CHANGES_BETWEEN,
    MISFIT,
    ONE_BY_ONE,
    OPPOSITE,
    chance,
    closed,
    estimate,
    interval,
    listed,
    number,
    percent,
    plain,
    with_unit,
)
from visadapt.effects import EFFECTS, CameraEffect
from visadapt.systems import system_named

REPEATED = "the readings that are repeated"


def unit_of(variable: str, system: str) -> str:
    """The unit of the variable of a region or a profile."""
    kind = system_named(system)
    known = {one.name: one.unit for one in (*kind.states, *kind.actions)}
    return {"time": "s", "episode": "1"}.get(variable) or known.get(variable, "1")


def region(one: Region, system: str) -> str:
    """Where a region lies: "x from 0.10 to 0.40 m"."""
    if one.variable == "episode":
        return f"episodes {one.start:.0f} to {one.end:.0f}" if one.end > one.start else f"episode {one.start:.0f}"
    start, end = (f"{at:.2f}" if one.variable == "time" else number(at, 2) for at in (one.start, one.end))
    span = with_unit(f"{start} to {end}", unit_of(one.variable, system))
    return f"{one.variable} from {span}"


def push(one: Push, recording: RecordingSummary) -> str:
    """A push in words: "shoulder pushed from 0.91 to 1.20 s of episode 0, up to 0.46 N m, impulse ..."."""
    impulse = Estimate(one.impulse, f"{one.unit} s", one.ci90)
    return (
        f"{plain(one.load)} pushed from {one.start:.2f} to {one.end:.2f} s of {recording.episode(one.episode)}, up to "
        f"{with_unit(number(one.size, 2), one.unit)}, impulse {estimate(impulse)} (90 %: {interval(impulse)})"
    )


def effects(names: Sequence[str]) -> str:
    """A set of effects in words; the empty set is the source."""
    return " + ".join(plain(name) for name in names) or "none: the unchanged simulator"


def sentence(diagnosis: Diagnosis) -> str:
    """The verdict in one plain sentence, with physical units, and one on signs that were inverted."""
    opposite = [warning.partition(OPPOSITE)[0] for warning in diagnosis.warnings if OPPOSITE in warning]
    if not opposite:
        return _sentence(diagnosis)
    return (
        f"{_sentence(diagnosis)} That holds with {listed(opposite)} inverted: as it is, with the opposite sign of the "
        "simulator's, a policy would drive the machine the wrong way."
    )


def _sentence(diagnosis: Diagnosis) -> str:
    gap = diagnosis.gap
    if diagnosis.verdict == NO_GAP and not math.isnan(gap.closed):
        return (
            f"No gap that an effect explains: predictions err by {number(gap.before)}, the noise alone by "
            f"{number(gap.floor)}, and nothing that was tried is clearly there."
        )
    if diagnosis.verdict == NO_GAP:
        return (
            f"No gap: the simulator predicts this recording as well as its noise allows "
            f"(error {number(gap.before)}, noise {number(gap.floor)})."
        )
    return _explained(diagnosis) if diagnosis.causes else _unexplained(diagnosis)


def _explained(diagnosis: Diagnosis) -> str:
    """The causes and what they close. A camera's are judged by pixels, the others by the motion that was predicted."""
    carrying = without_slight(diagnosis.causes)
    sets = explanations(carrying) if diagnosis.verdict == AMBIGUOUS else []
    camera = [cause for cause in carrying if _in_pixels(cause)]
    motion = [cause for cause in carrying if not _in_pixels(cause)]
    pixels = diagnosis.where.pixels
    if not camera or not motion or pixels is None:
        parts = [f"{_either_of(carrying, sets)} {_closes(diagnosis, carrying, sets)}"]
    elif diagnosis.gap.measure == MISFIT:
        parts = [
            f"{_either_of(camera, sets)} {_closes(diagnosis, camera)}",
            f"{_either_of(motion, sets)} {_verb('explain', motion)} {REPEATED}",
        ]
    else:
        left = f"the pixels to within {number(pixels.error, 2)} grey levels"
        parts = [
            f"{_either_of(camera, sets)} {_verb('explain', camera)} {left}",
            f"{_either_of(motion, sets)} {_closes(diagnosis, motion, sets)}",
        ]
    undecided = ["this recording cannot tell which"] if diagnosis.verdict == AMBIGUOUS else []
    return f"{_capitalised('; '.join([*parts, *undecided]))}."


def _in_pixels(cause: Cause) -> bool:
    """Whether it is an effect of the camera that a single frame shows."""
    effect = EFFECTS.get(cause.effect)
    return effect is not None and issubclass(effect, CameraEffect) and effect.in_one_frame


def _either_of(causes: Sequence[Cause], sets: Sequence[Sequence[Cause]]) -> str:
    """The causes in words; of several `sets` of them that explain the recording, those that are alternatives."""
    if not sets:
        return listed([_described(cause) for cause in causes])
    return listed([_either(group, sets) for group in _alternatives(causes)])


def _verb(verb: str, causes: Sequence[Cause]) -> str:
    """The verb, of which alternatives are one subject."""
    return verb if len(_alternatives(causes)) > 1 else f"{verb}s"


def _alternatives(causes: Sequence[Cause]) -> list[list[Cause]]:
    """Causes grouped with those that they cannot be told from; the smallest groups first."""
    groups: list[list[Cause]] = []
    for cause in causes:
        alike = [group for group in groups if any(cause.effect in other.indistinguishable_from for other in group)]
        rest = [group for group in groups if group not in alike]
        groups = [*rest, [*(other for group in alike for other in group), cause]]
    return sorted(groups, key=len)


def _either(group: Sequence[Cause], sets: Sequence[Sequence[Cause]]) -> str:
    """A group of alternatives: "either a or b"; where one of them stands for two, "either a, or b and c"."""
    options: list[list[Cause]] = []
    for each in sets:
        option = [cause for cause in each if cause in group]
        if option not in options:
            options.append(option)
    texts = [listed([_described(cause) for cause in option]) for option in options]
    either = "either " if len(options) > 1 else ""
    return either + (", or ".join(texts) if len(group) > len(options) else listed(texts, "or"))


def box(one: Box) -> str:
    """A box of the frame: "columns 10 to 30 and rows 5 to 20"."""
    return f"columns {one.left} to {one.right} and rows {one.top} to {one.bottom}"


def _unexplained(diagnosis: Diagnosis) -> str:
    gap, pixels = diagnosis.gap, diagnosis.where.pixels
    if pixels is not None and pixels.unexplained:
        most = f", most at {box(pixels.boxes[0])}" if pixels.boxes else ""
        return (
            "The frames show what neither the renderer nor a known effect of the camera explains: "
            f"{number(pixels.error, 2)} grey levels{most}; its own errors are {number(pixels.usual, 2)}."
        )
    if BESIDE_PUSHES in diagnosis.warnings:
        return (
            "Something passes that no known effect explains: a push, a gust, or an effect that acts now and then. "
            f"Beside it there is no gap (error {number(gap.before)}, noise {number(gap.floor)})."
        )
    if any(warning.startswith(ONE_BY_ONE) for warning in diagnosis.warnings):
        return f"{_capitalised(ONE_BY_ONE)}: the machine, or a sensor, was changed between them (see the warning)."
    if any(warning.startswith(CHANGES_BETWEEN) for warning in diagnosis.warnings):
        return f"{_capitalised(CHANGES_BETWEEN)} (see the warning)."
    if any(warning.startswith(CHANGES) for warning in diagnosis.warnings):
        return (
            f"{_capitalised(CHANGES)}, as where a battery runs down, a bearing warms up or a load is dropped (see the "
            "warning)."
        )
    if math.isnan(gap.closed):
        return (
            "The simulator predicts as well as the fitted noise allows, but a gap hides, or may hide, in that noise: "
            "see what to record next."
        )
    best = gap.closed
    black_box = (gap.before - gap.black_box) / (gap.before - gap.floor) if gap.before != gap.floor else math.nan
    text, most = "Something acts that no known effect explains: ", "the most probable of them"
    none = "none closes any of the gap"
    if BETWEEN_ROWS in diagnosis.warnings:
        text, most = "The recording lacks commands that were sent between its rows: ", "the most probable effects"
        none = f"{most} close none of the gap"
    if best <= 0:
        text += none
    elif closed(black_box) != closed(best) and black_box > best:
        text += f"{most} close {closed(best)} of the gap, with a black box {closed(black_box)}"
    else:
        text += f"{most} close {closed(best)} of the gap, and what is left is not noise"
    if diagnosis.where.regions:
        text += f"; it shows most at {region(diagnosis.where.regions[0], diagnosis.system)}"
    return f"{text}."


def _described(cause: Cause) -> str:
    values = ", ".join(f"{plain(name)} {estimate(one)}" for name, one in cause.parameters.items())
    return f"{plain(cause.effect)} ({values})" if values else plain(cause.effect)


def _closes(diagnosis: Diagnosis, causes: Sequence[Cause], sets: Sequence[Sequence[Cause]] = ()) -> str:
    """What causes close; of several `sets` of them that explain the recording, from the least to the most."""
    if math.isnan(diagnosis.gap.closed):  # beside the repeated readings the source predicts as well as the noise allows
        return f"{_verb('explain', causes)} {REPEATED}"
    named = [frozenset(cause.effect for cause in each) for each in sets]
    each = [one.gap_closed for one in diagnosis.ranking if frozenset(one.effects) in named]
    least, most = (end([diagnosis.gap.closed, *filter(math.isfinite, each)]) for end in (min, max))
    share = closed(most) if closed(least) == closed(most) else f"{round(100 * least)} to {closed(most)}"
    return f"{_verb('close', causes)} {share} of the gap to the simulator"


def alone(cause: Cause) -> str:
    """What a cause closes by itself, and what opens again without it, where that is known."""
    said, of = "", " of the pixels' misfit" if _in_pixels(cause) else ""
    if math.isfinite(cause.gap_closed):
        larger = round(cause.gap_closed, 2) < 0
        said += ", alone makes the gap larger" if larger else f", closes {closed(cause.gap_closed)}{of} alone"
    if math.isfinite(cause.gap_reopened):
        share = "more than the whole gap" if round(cause.gap_reopened, 2) > 1 else percent(cause.gap_reopened)
        said += f", without it {share if round(cause.gap_reopened, 2) > 0 else 'nothing'} opens again"
    return said


def _capitalised(text: str) -> str:
    return text[:1].upper() + text[1:]


def corrected(diagnosis: Diagnosis) -> str:
    """What the report calls the simulator with the effects that were found."""
    return "with the causes" if diagnosis.causes else "with the best known effects"


def policy_terms(diagnosis: Diagnosis) -> list[tuple[str, tuple[float, float]]]:
    """Theorem 1's terms, each with a description; empty where no policy was given."""
    terms = diagnosis.policy
    if terms is None:
        return []
    return [
        ("delta, error of the model's step under the policy", terms.delta),
        ("L, largest change of that step per unit of command", terms.lipschitz),
        ("E|pi - pi_hat|, distance of the policy's command from the model's best", terms.action_gap),
        ("E[zeta], distance from the reference under the best command", terms.zeta),
        ("delta + L E|pi - pi_hat| + E[zeta], bound on the policy's distance from the reference", terms.bound),
    ]


def shares(table: Mapping[str, float]) -> str:
    """Shares by name, without those that are 0 or unknown."""
    return ", ".join(f"{name} {percent(share)}" for name, share in table.items() if share > 0) or "none"


def noises(every: Mapping[str, Noise]) -> str:
    """Noise of the sensors in words, those with the same noise together: "x, y 0.012 m; z 0.020 m"."""
    by_text: dict[str, list[str]] = {}
    for name, one in every.items():
        by_text.setdefault(with_unit(number(one.value, 2), one.unit), []).append(name)
    return "; ".join(f"{', '.join(names)} {text}" for text, names in by_text.items())


def rendered(template: str, diagnosis: Diagnosis, **values: Any) -> str:
    """A template of this folder, filled with a diagnosis and further values."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("visadapt.diagnosis.report", "."),
        autoescape=template.endswith(".html"),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )
    for function in (plain, number, percent, closed, chance, estimate, interval, effects, shares, alone, noises):
        environment.filters[function.__name__] = function
    environment.filters["either"] = lambda names: listed(names, "or")
    environment.filters["push"] = lambda one: push(one, diagnosis.recording)
    environment.filters["region"] = lambda one: region(one, diagnosis.system)
    common = {"sentence": sentence(diagnosis), "corrected": corrected(diagnosis), "policy": policy_terms(diagnosis)}
    return environment.get_template(template).render(diagnosis=diagnosis, **common, **values)


def as_text(diagnosis: Diagnosis) -> str:
    """The diagnosis for the terminal."""
    return rendered("terminal.txt", diagnosis).rstrip("\n")
