"""Systems of one's own: a driven pendulum, and the one of docs/own_system.md."""

import re
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import torch

from visadapt.systems import System, Variable

PAGE = Path(__file__).parents[1] / "docs" / "own_system.md"


@dataclass(frozen=True)
class Pendulum(System):
    """A pendulum on a motor that is commanded a torque in N m; 0 hangs down."""

    inertia: float | torch.Tensor = 0.05  # kg m2
    moment: float | torch.Tensor = 0.1  # kg m
    gravity: float | torch.Tensor = 9.81

    name = "pendulum"
    states: ClassVar[tuple[Variable, ...]] = (
        Variable("angle", "rad", -3.0, 3.0),
        Variable("rate", "rad/s", -12.0, 12.0),
    )
    actions: ClassVar[tuple[Variable, ...]] = (Variable("torque", "N m", -2.0, 2.0),)
    loads = (Variable("joint", "N m", -1.0, 1.0),)
    coordinates = ((0, 1),)

    def derivative(self, state, command, load):
        angle, rate = state.unbind(-1)
        (push,) = load.unbind(-1)
        weight = self.moment * self.gravity * angle.sin()
        return torch.stack((rate, (command[:, 0] + push - weight) / self.inertia), -1)


def page_code() -> tuple[str, str]:
    """The class and the script of the page."""
    one, other = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    return one, other


@cache
def furuta() -> Any:
    """The page's class."""
    module = sys.modules["furuta_of_the_page"] = ModuleType("furuta_of_the_page")
    exec(compile(page_code()[0], "furuta.py", "exec"), vars(module))
    return module.Furuta
