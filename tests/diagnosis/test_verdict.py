"""What is said beside a verdict."""

import pytest

from visadapt.diagnosis.result import Cause, Gap
from visadapt.diagnosis.verdict import imitating

GAP = Gap("", 475.0, 8.3, 0.9, 8.3, 0.98)


def cause(effect, alone, alike=(), slight=False):
    return Cause(effect, {}, 1.0, alone, 0.02, slight, alike)


@pytest.mark.parametrize(
    ("found", "unexplained", "said"),
    [
        ([cause("actuator_deadzone", 0.96), cause("coulomb_friction", 0.95)], True, True),
        ([cause("actuator_deadzone", 0.96), cause("coulomb_friction", 0.95)], False, False),
        ([cause("actuator_deadzone", 0.96), cause("coulomb_friction", 0.7)], True, False),
        ([cause("actuator_deadzone", 0.96), cause("coulomb_friction", 0.95, slight=True)], True, False),
        # Two that fit as well are said to do so anyway.
        (
            [cause("actuator_deadzone", 0.96, ("play",)), cause("play", 0.96, ("actuator_deadzone",))],
            True,
            False,
        ),
    ],
)
def test_causes_that_each_close_the_gap_alone_may_imitate_each_other(found, unexplained, said):
    warnings = imitating(found, GAP, unexplained)
    assert bool(warnings) == said
    if said:
        assert warnings[0].startswith(
            "actuator deadzone and coulomb friction each close nearly as much alone (96 %, 95 %)"
        )
