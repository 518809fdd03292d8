"""What a diagnosis says, as numbers: the JSON of the command, and the evidence that the report draws.

The JSON's schema is `schema.json` beside this file, version 1. Shares and probabilities are numbers from 0 to 1;
parameters are in the units that their effects state; whatever could not be determined is NaN here, null in the JSON.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from visadapt.effects import EFFECTS, Effect

SCHEMA_VERSION = 1

IDENTIFIED, AMBIGUOUS, UNEXPLAINED, NO_GAP = "identified", "ambiguous", "unexplained", "no_gap"
VERDICTS = (IDENTIFIED, AMBIGUOUS, UNEXPLAINED, NO_GAP)


@dataclass(frozen=True)
class Region:
    """A stretch of one variable (a state, an action, `time` in s since the episode began, or `episode`)."""

    variable: str
    start: float
    """the JSON's "from", in the variable's unit"""
    end: float
    """the JSON's "to", in the variable's unit"""
    share: float
    """of the gap that lies here"""
    p_value: float
    """of a gap like this by chance somewhere, all places looked at included"""


@dataclass(frozen=True)
class Where:
    """Shares of the gap by stage and by state, and the regions that stand out."""

    stages: Mapping[str, float]
    """of the explained gap: actuation, dynamics, sensing, camera"""
    states: Mapping[str, float]
    """every state of the system; NaN where it was not measured"""
    regions: tuple[Region, ...] = ()
    """the most certain first"""


@dataclass(frozen=True)
class Estimate:
    """One parameter of an effect."""

    value: float
    unit: str
    ci90: tuple[float, float]
    """90 % interval; NaN on a side on which it is open"""


@dataclass(frozen=True)
class Cause:
    """One effect that acts, as far as the data says."""

    effect: str
    parameters: Mapping[str, Estimate]
    probability: float
    gap_closed: float
    """by this cause alone, on held-out episodes"""
    indistinguishable_from: tuple[str, ...] = ()
    """effects that fit this recording as well"""


@dataclass(frozen=True)
class Ranked:
    """One set of effects that was weighed; the empty set is the source as it stands."""

    effects: tuple[str, ...]
    probability: float
    gap_closed: float
    """by the set, on held-out episodes"""


@dataclass(frozen=True)
class Gap:
    """The error of predictions several steps ahead on held-out episodes."""

    measure: str
    """what the other numbers are, in words and with the unit"""
    before: float
    """of the source"""
    after: float
    """of the source with the causes"""
    floor: float
    """what the measurement noise alone leaves"""
    black_box: float
    """of the source with a residual network"""
    closed: float
    """(before - after) / (before - floor)"""


@dataclass(frozen=True)
class RecordingSummary:
    """How much was recorded."""

    episodes: int
    samples: int
    """executed actions"""
    period: float
    """s between rows"""


@dataclass(frozen=True)
class Prediction:
    """One held-out window, predicted from its start with the actions that were commanded."""

    episode: int
    time: NDArray[np.floating]
    """(K,) s since the episode began"""
    measured: NDArray[np.floating]
    """(K, n_state); NaN in the columns of states that were not measured"""
    source: NDArray[np.floating]
    """(K, n_state), as the source predicts it"""
    corrected: NDArray[np.floating]
    """(K, n_state), as the source with the causes predicts it (without a cause: as `source`)"""


@dataclass(frozen=True)
class Profile:
    """The mean residual over one variable, in bins."""

    variable: str
    """a state, an action, `time` or `episode`"""
    variable_unit: str
    quantity: str
    """what is left over, say "force on the cart" """
    quantity_unit: str
    centres: NDArray[np.floating]
    """(N,) of the bins"""
    before: NDArray[np.floating]
    """(N,) mean under the source; NaN in empty bins"""
    before_error: NDArray[np.floating]
    """(N,) its standard error"""
    after: NDArray[np.floating]
    """(N,) mean with the causes"""
    after_error: NDArray[np.floating]
    """(N,) its standard error"""


@dataclass(frozen=True)
class Growth:
    """How the error grows with the horizon of prediction, all (K,); the same measure as `Gap`, but at one instant."""

    seconds: NDArray[np.floating]
    before: NDArray[np.floating]
    after: NDArray[np.floating]
    floor: NDArray[np.floating]
    black_box: NDArray[np.floating]


@dataclass(frozen=True)
class Spectrum:
    """Power spectral density of the residual, all (F,)."""

    quantity: str
    """what is left over, say "force on the cart" """
    unit: str
    """of the density, say "N2/Hz" """
    frequency: NDArray[np.floating]
    """Hz"""
    before: NDArray[np.floating]
    after: NDArray[np.floating]


@dataclass(frozen=True)
class PolicyTerms:
    """The terms of the paper's Theorem 1 for a given policy, a pair (before, after) each.

    Before, the model f_hat is the source; after, it is the source with the causes. Means are over the states of the
    recording, norms are Euclidean over one step's state in SI units (`theorem.py` says how they are found).
    """

    delta: tuple[float, float]
    """error of the model's step under the policy, E|f_hat(s, pi(s)) - f*(s, pi(s))| (equation 6)"""
    lipschitz: tuple[float, float]
    """L, by which the model's step follows a change of the action at most (equation 7), per unit of command"""
    action_gap: tuple[float, float]
    """distance of the policy's action from the one that is best in the model, E|pi(s) - pi_hat(s)|, in commands"""
    zeta: tuple[float, float]
    """distance from the reference that this best action leaves, E[zeta] (equation 5)"""

    @property
    def bound(self) -> tuple[float, float]:
        """On the policy's distance from the reference after a step of the machine (equation 8)."""
        terms = zip(self.delta, self.lipschitz, self.action_gap, self.zeta, strict=True)
        before, after = (delta + lipschitz * gap + zeta for delta, lipschitz, gap, zeta in terms)
        return before, after


@dataclass(frozen=True)
class Evidence:
    """What the report draws and the JSON leaves out. Whatever is empty or None is not drawn."""

    predictions: tuple[Prediction, ...] = ()
    """a few held-out windows, the most telling first"""
    profiles: tuple[Profile, ...] = ()
    """the variables of `Where.regions` first"""
    growth: Growth | None = None
    spectrum: Spectrum | None = None
    policy: PolicyTerms | None = None


@dataclass(frozen=True)
class Diagnosis:
    """The whole result.

    Raises:
        ValueError: an unknown verdict, or causes where the verdict says that there are none.

    >>> import visadapt as va
    >>> from visadapt.diagnosis.result import Gap, RecordingSummary, Where
    >>> gap = Gap("error", before=1.0, after=1.0, floor=1.0, black_box=1.0, closed=0.0)
    >>> found = va.Diagnosis("cartpole", RecordingSummary(4, 240, 0.05), "no_gap", Where({}, {}), (), (), gap, "")
    >>> found.causes, found.gap.before
    ((), 1.0)
    """

    system: str
    recording: RecordingSummary
    verdict: str
    """one of VERDICTS"""
    where: Where
    causes: tuple[Cause, ...]
    """the likeliest first; empty for no_gap and unexplained. For ambiguous: those that fit equally well"""
    ranking: tuple[Ranked, ...]
    """the likeliest first, the runners-up too"""
    gap: Gap
    next_experiment: str
    """what to record to settle what is open; empty where nothing is"""
    warnings: tuple[str, ...] = ()
    """the recording's, and the diagnosis's own"""
    evidence: Evidence = Evidence()

    def __post_init__(self) -> None:
        if self.verdict not in VERDICTS:
            raise ValueError(f"the verdict is {self.verdict!r}; there are {', '.join(VERDICTS)}")
        if bool(self.causes) != (self.verdict in (IDENTIFIED, AMBIGUOUS)):
            raise ValueError(f"the verdict {self.verdict!r} does not go with {len(self.causes)} causes")

    def __str__(self) -> str:
        # Imported here: the report is written from this result.
        from visadapt.diagnosis.report.text import as_text

        return as_text(self)

    def effects(self) -> list[Effect]:
        """The causes as effects at their found values, for a `World` that explains the recording.

        Of effects that this recording cannot tell apart the first in `causes` is taken, which is the likeliest; the
        others are its `indistinguishable_from`.

        Raises:
            ValueError: the diagnosis named no cause (no_gap or unexplained), or a parameter has no finite value.

        >>> import visadapt as va
        >>> from visadapt.diagnosis.result import *
        >>> found = Diagnosis(
        ...     "cartpole", RecordingSummary(10, 1000, 0.05), "identified", Where({}, {}),
        ...     (Cause("viscous_friction", {"coefficient": Estimate(2.1, "N s/m", (1.9, 2.3))}, 0.98, 0.95),),
        ...     (), Gap("", 1.0, 0.1, 0.1, 0.1, 1.0), "",
        ... )
        >>> world = va.World(va.CartPole(), found.effects())
        >>> [(effect.name, round(effect.coefficient.item(), 2)) for effect in world.effects]
        [('viscous_friction', 2.1)]
        """
        if not self.causes:
            raise ValueError(
                f"the verdict is {self.verdict}: the diagnosis named no cause to put into a world; "
                + ("the source explains the recording as it is" if self.verdict == NO_GAP else "adapt with a residual")
            )
        taken: list[Cause] = []
        for cause in self.causes:
            if not any(cause.effect in (one.effect, *one.indistinguishable_from) for one in taken):
                taken.append(cause)
        return [_effect(cause) for cause in taken]

    def to_json(self) -> dict[str, Any]:
        """What json.dumps takes, strictly (null for what is not finite); keys and their order are the schema's."""
        return {
            "schema": SCHEMA_VERSION,
            "system": self.system,
            "recording": {
                "episodes": int(self.recording.episodes),
                "samples": int(self.recording.samples),
                "period": _number(self.recording.period),
            },
            "verdict": self.verdict,
            "where": {
                "stages": {name: _share(share) for name, share in self.where.stages.items()},
                "states": {name: _share(share) for name, share in self.where.states.items()},
                "regions": [_region(region) for region in self.where.regions],
                "pixels": None,
            },
            "causes": [_cause(cause) for cause in self.causes],
            "ranking": [
                {
                    "effects": list(ranked.effects),
                    "probability": _share(ranked.probability),
                    "gap_closed": _number(ranked.gap_closed),
                }
                for ranked in self.ranking
            ],
            "gap": {
                "measure": self.gap.measure,
                "before": _number(self.gap.before),
                "after": _number(self.gap.after),
                "floor": _number(self.gap.floor),
                "black_box": _number(self.gap.black_box),
                "closed": _number(self.gap.closed),
            },
            "next_experiment": self.next_experiment,
            "warnings": list(self.warnings),
        }


def _effect(cause: Cause) -> Effect:
    values = {name: estimate.value for name, estimate in cause.parameters.items()}
    for name, value in values.items():
        if not math.isfinite(value):
            raise ValueError(f"{cause.effect}: the recording does not determine its {name}; record what does")
    return EFFECTS[cause.effect](**values)


def _region(region: Region) -> dict[str, Any]:
    return {
        "variable": region.variable,
        "from": _number(region.start),
        "to": _number(region.end),
        "share": _share(region.share),
        "p_value": _share(region.p_value),
    }


def _cause(cause: Cause) -> dict[str, Any]:
    return {
        "effect": cause.effect,
        "parameters": {
            name: {"value": _number(one.value), "unit": one.unit, "ci90": [_number(edge) for edge in one.ci90]}
            for name, one in cause.parameters.items()
        },
        "probability": _share(cause.probability),
        "gap_closed": _number(cause.gap_closed),
        "indistinguishable_from": list(cause.indistinguishable_from),
    }


def _number(value: float) -> float | None:
    """A plain float, whatever numpy or torch made it; None where JSON has no number for it."""
    plain = float(value)
    return plain if math.isfinite(plain) else None


def _share(value: float) -> float | None:
    """As `_number`, without the rounding errors by which sums of shares pass 1."""
    plain = _number(value)
    return None if plain is None else round(plain, 12)
