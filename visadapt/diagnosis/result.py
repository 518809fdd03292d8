"""The result of a diagnosis as numbers, and the data that the report plots.

Shares and probabilities are from 0 to 1 (the gap closed may be negative), parameters in their effects' units; what
could not be determined is NaN, null in the JSON.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from numbers import Integral
from pathlib import PurePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from visadapt.diagnosis.explanations import preferred
from visadapt.effects import EFFECTS, Effect
from visadapt.effects.own import is_own, own_effects
from visadapt.systems.base import NAMED

IDENTIFIED, AMBIGUOUS, UNEXPLAINED, NO_GAP = "identified", "ambiguous", "unexplained", "no_gap"
VERDICTS = (IDENTIFIED, AMBIGUOUS, UNEXPLAINED, NO_GAP)

SCHEMA_VERSION = 2  # Version of `schema.json`

KEYS = {"start": "from", "end": "to"}
"""JSON keys of fields that have another name there."""
NOT_IN_JSON = ("figures", "policy", "partial")
"""Fields that the report alone shows."""
SHARES = ("probability", "share", "p_value", "stages", "states")
"""Fields of numbers from 0 to 1: rounded to 12 digits, so that no rounding error lifts them above 1."""


@dataclass(frozen=True)
class Region:
    """An interval of one variable: a state, an action, `time` in s since the episode started, or `episode`."""

    variable: str
    start: float  # the JSON's "from", in the variable's unit
    end: float  # the JSON's "to", in the variable's unit
    share: float  # of the gap that lies in it
    p_value: (
        float  # probability that chance concentrates as much of the gap in any interval; NaN where a cause names it
    )


@dataclass(frozen=True)
class Push:
    """A passing load on one joint, or along or about one axis of a vehicle, that no function of state and command
    explains; several may act in a recording."""

    episode: int
    load: str  # the load that it adds to
    start: float  # the JSON's "from", s since the episode started, where it rises above 5 % of its peak
    end: float  # the JSON's "to"
    size: float  # its peak, signed
    unit: str  # of the size; that of the impulse is this times s
    impulse: float
    ci90: tuple[float, float]  # 90 % confidence interval of the impulse
    p_value: float  # probability that errors alone look as much like a push anywhere in the recording

    def overlaps(self, other: Push) -> bool:
        """Whether both act in the same episode, at one time at least."""
        return self.episode == other.episode and self.start <= other.end and other.start <= self.end


@dataclass(frozen=True)
class Box:
    """A box of the frame, in px; right and bottom are the first ones outside."""

    left: int
    top: int
    right: int
    bottom: int
    share: float  # of what is unexplained in the whole frame


@dataclass(frozen=True)
class Pixels:
    """What neither renderer nor camera explains in a film's frames, noise left aside."""

    error: float  # its root mean square, in grey levels of 255
    usual: float  # the same of the renderer by itself, where nothing is wrong
    unexplained: bool  # whether that is too much for the renderer
    boxes: tuple[Box, ...] = ()  # where it stands out, the largest share first; empty where it is not unexplained


@dataclass(frozen=True)
class Where:
    """Shares of the gap by stage and by state, the regions where it is concentrated, and pushes."""

    stages: Mapping[str, float]  # of the explained gap: actuation, dynamics, sensing, camera
    states: Mapping[str, float]  # every state of the system; NaN where it was not measured
    regions: tuple[Region, ...] = ()  # fitted regions of causes first, then lowest p-value first
    pushes: tuple[Push, ...] = ()  # in the order of time
    pixels: Pixels | None = None  # of a film


@dataclass(frozen=True)
class Estimate:
    """One parameter of an effect."""

    value: float
    unit: str
    ci90: tuple[float, float]  # 90 % confidence interval; NaN on a side on which it is open


@dataclass(frozen=True)
class Cause:
    """One effect that explains the gap, or part of it."""

    effect: str
    parameters: Mapping[str, Estimate]
    probability: float
    gap_closed: float  # by this cause alone, on held-out episodes
    gap_reopened: float = math.nan  # share of the gap that opens again without it, on held-out episodes
    slight: bool = False  # whether that is too little for the verdict to rest on it
    indistinguishable_from: tuple[str, ...] = ()  # effects that fit this recording equally well


def without_slight(causes: Iterable[Cause]) -> list[Cause]:
    """The causes on which the verdict rests."""
    return [cause for cause in causes if not cause.slight]


@dataclass(frozen=True)
class Ranked:
    """One set of effects that was compared; the empty set is the source."""

    effects: tuple[str, ...]
    probability: float
    gap_closed: float  # by the set, on held-out episodes


@dataclass(frozen=True)
class Gap:
    """The error of predictions several steps ahead on held-out episodes."""

    measure: str  # what the other numbers are, in words, with the unit
    before: float  # of the source
    after: float  # of the source with the causes
    floor: float  # of the measurement noise alone
    black_box: float  # the best that a black box reaches beside the causes; at most `after`
    closed: float  # (before - after) / (before - floor); NaN where there is no gap to close

    def without_causes(self) -> Gap:
        """The gap where no cause is named."""
        return replace(self, after=self.before, black_box=min(self.before, self.black_box))


@dataclass(frozen=True)
class Noise:
    """Standard deviation of a sensor's noise."""

    value: float
    unit: str


@dataclass(frozen=True)
class RecordingSummary:
    """Size of the recording, and its noise."""

    episodes: int
    samples: int  # actions that were executed
    period: float  # s between rows
    sources: tuple[str, ...] = ()  # file, and number there, of each episode
    noise: Mapping[str, Noise] = field(default_factory=dict)  # of each state that was read, as the best model leaves it

    def episode(self, number: int) -> str:
        """An episode in words: its number, from 0, and where it comes from if there are several."""
        several = len(set(self.sources)) > 1
        return f"episode {number}" + (f" ({PurePath(self.sources[number]).name})" if several else "")


@dataclass(frozen=True)
class Prediction:
    """One window, predicted from its start with the actions that were commanded."""

    episode: int
    time: NDArray[np.floating]  # (K,) s since the episode started
    measured: NDArray[np.floating]  # (K, n_state); NaN in the columns of states that were not measured
    source: NDArray[np.floating]  # (K, n_state) prediction of the source
    corrected: NDArray[np.floating]  # (K, n_state) prediction of the source with the best set of effects


@dataclass(frozen=True)
class Curve:
    """One curve of a chart."""

    label: str
    values: NDArray[np.floating]  # (N,); NaN where there is none
    error: NDArray[np.floating] | None = None  # (N,) standard error of the values


@dataclass(frozen=True)
class Chart:
    """Curves over one variable: a mean residual, the error over the horizon, or a spectrum."""

    variable: str  # a state, an action, `time`, `episode`, or words
    variable_unit: str
    quantity: str  # in words, such as "force on the cart"
    quantity_unit: str
    x: NDArray[np.floating]  # (N,)
    curves: tuple[Curve, ...]  # source, then with the causes; of errors black box, noise


@dataclass(frozen=True)
class FilmFrames:
    """K frames of a film beside what the source with the best set of effects predicts for them."""

    filmed: NDArray[np.uint8]  # (K, H, W)
    predicted: NDArray[np.uint8]  # (K, H, W) drawn as the camera that was found would see them
    time: NDArray[np.floating]  # (K,) s since the episode started
    episode: NDArray[np.integer]  # (K,)
    ahead: float  # s, over which they are predicted
    left: NDArray[np.floating]  # (H, W) root mean square of what nothing explains, in grey levels of 255


@dataclass(frozen=True)
class PolicyTerms:
    """The terms of the paper's Theorem 1 for a given policy, each a pair (before, after).

    Before, the model f_hat is the source; after, it is the source with the best set of effects. Means are over the
    states of the recording, norms are Euclidean over one step's state in SI units; `policy_bound.py` computes them.
    """

    delta: tuple[float, float]
    """error of the model's step under the policy, E|f_hat(s, pi(s)) - f*(s, pi(s))| (equation 6)"""
    lipschitz: tuple[float, float]  # L, largest change of the model's step per unit of command (equation 7)
    action_gap: tuple[float, float]
    """distance of the policy's action from the model's best, E|pi(s) - pi_hat(s)|, in units of command"""
    zeta: tuple[float, float]  # distance from the reference under this best action, E[zeta] (equation 5)

    @property
    def bound(self) -> tuple[float, float]:
        """Upper bound of the distance from the reference after one step of the machine (equation 8)."""
        terms = zip(self.delta, self.lipschitz, self.action_gap, self.zeta, strict=True)
        before, after = (delta + lipschitz * gap + zeta for delta, lipschitz, gap, zeta in terms)
        return before, after


@dataclass(frozen=True)
class FigureData:
    """What the report plots; what is empty or None is not plotted."""

    predictions: tuple[Prediction, ...] = ()  # that of the source's largest error first
    profiles: tuple[Chart, ...] = ()
    """the mean residual over a variable, in bins; the variables of `Where.regions` first"""
    growth: Chart | None = None  # the errors of `Gap` by horizon
    spectrum: Chart | None = None  # power spectral density of the residual
    film: FilmFrames | None = None
    held_out: bool = True  # whether the predictions are of rows that were not fitted


@dataclass(frozen=True)
class Diagnosis:
    """The whole result.

    Raises:
        ValueError: an unknown verdict, or causes that contradict the verdict.

    >>> import visadapt as va
    >>> from visadapt.diagnosis.result import Gap, RecordingSummary, Where
    >>> gap = Gap("error", before=1.0, after=1.0, floor=1.0, black_box=1.0, closed=0.0)
    >>> found = va.Diagnosis("cartpole", RecordingSummary(4, 240, 0.05), "no_gap", Where({}, {}), (), (), gap, "")
    >>> found.causes, found.gap.before
    ((), 1.0)
    """

    system: str
    recording: RecordingSummary
    verdict: str  # one of VERDICTS
    where: Where
    causes: tuple[Cause, ...]
    """those of a camera, those of repeated readings, then each effect of the most probable set, followed by those that
    fit as well in its place; empty for no_gap and unexplained"""
    ranking: tuple[Ranked, ...]  # all sets that were compared, the most probable first
    gap: Gap
    next_experiment: str  # what to record to settle open questions; empty where there are none
    warnings: tuple[str, ...] = ()  # of loading the recording, and of the diagnosis
    figures: FigureData = FigureData()
    policy: PolicyTerms | None = None  # terms of Theorem 1, where a policy was given
    partial: tuple[Cause, ...] = ()
    """where the verdict is unexplained, the effects of the most probable set, which explain a part of the gap: what
    else acts may have moved their values"""

    def __post_init__(self) -> None:
        if self.verdict not in VERDICTS:
            raise ValueError(f"the verdict is {self.verdict!r}; there are {', '.join(VERDICTS)}")
        if bool(self.causes) != (self.verdict in (IDENTIFIED, AMBIGUOUS)):
            raise ValueError(f"the verdict {self.verdict!r} does not go with {len(self.causes)} causes")

    def __str__(self) -> str:
        # Imported here: the report is above this module, and is written from it.
        from visadapt.diagnosis.report.text import as_text

        return as_text(self)

    def effects(self) -> list[Effect]:
        """The causes as effects at their found values, for a `World` that explains the recording.

        Of effects that this recording cannot tell apart the first in `causes` is taken: that of the most probable set,
        or a twin that does exactly the same. For an error of a sensor one that is none is taken instead, unless errors
        of sensors are clearly more probable. The others are its `indistinguishable_from`.

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
        if (kind := NAMED.get(self.system)) is not None and is_own(kind):
            own_effects(kind)  # two systems of one's own may have effects of the same name
        ranking = ((one.effects, one.probability) for one in self.ranking)
        return named_effects(self.verdict, preferred(self.causes, ranking)[0])

    def to_json(self) -> dict[str, Any]:
        """The result as json.dumps takes it; keys and their order are those of `schema.json`, NaN becomes None."""
        return {"schema": SCHEMA_VERSION, **_plain(self)}


def named_effects(verdict: str, causes: Sequence[Cause]) -> list[Effect]:
    """The causes of one explanation as effects; the verdict is for the message where there are none."""
    if not causes:
        raise ValueError(
            f"the verdict is {verdict}: the diagnosis named no cause to put into a world; "
            + ("the source explains the recording as it is" if verdict == NO_GAP else "adapt with a residual")
        )
    for cause in causes:
        for name, estimate in cause.parameters.items():
            if not math.isfinite(estimate.value):
                raise ValueError(
                    f"{cause.effect}: the recording does not determine its {name}; record motions that show it, or "
                    "pass the effect with a value of your own"
                )
    return [EFFECTS[cause.effect](**{name: one.value for name, one in cause.parameters.items()}) for cause in causes]


def _plain(value: Any, is_share: bool = False) -> Any:
    """The fields of dataclasses in their order, as plain numbers; what is not finite becomes None."""
    if is_dataclass(value):
        names = [field.name for field in fields(value) if field.name not in NOT_IN_JSON]
        return {KEYS.get(name, name): _plain(getattr(value, name), name in SHARES) for name in names}
    if isinstance(value, Mapping):
        return {key: _plain(each, is_share) for key, each in value.items()}
    if isinstance(value, tuple):
        return [_plain(each) for each in value]
    if value is None or isinstance(value, str):
        return value
    if isinstance(value, bool):
        return value
    if isinstance(value, Integral):
        return int(value)
    number = float(value)
    if not math.isfinite(number):
        return None
    return round(number, 12) if is_share else number
