"""The CartPole from states: the paper's experiments without a camera (sections 3.2.1 and 3.2.2)."""

from __future__ import annotations

from visadapt.learning.joint import SetupSettings
from visadapt.learning.policy import TuneSettings
from visadapt.policies import StatePolicy
from visadapt.setups.base import Setup
from visadapt.setups.residuals import residual_for
from visadapt.systems import CartPole
from visadapt.tasks.balance import Balance
from visadapt.tasks.cost import PAPER_CARTPOLE
from visadapt.world import World

UNLIMITED = 1e9
"""m, of the cart's position: nothing depends on it, and no camera loses the cart."""

SETTINGS = SetupSettings(
    source=TuneSettings(
        Balance(PAPER_CARTPOLE, divergence=(UNLIMITED, 4.0, 0.5, 10.0)),
        iterations=3000,
        learning_rate=3e-3,
        observation_noise=0.0,
    ),
    tuning=TuneSettings(
        Balance(
            PAPER_CARTPOLE,
            start_spread=(0.3, 0.2, 0.1, 0.2),
            kick=(0.0, 0.0, 0.0, 0.0),
            divergence=(UNLIMITED, 2.0, 0.25, 3.0),
            first_divergence=0.4,
        ),
        iterations=400,
        learning_rate=2e-3,
        longest=25,
        recorded=0.8,
        observation_noise=0.0,
    ),
)


def cartpole_states(
    source: World | None = None, with_history: bool = False, settings: SetupSettings = SETTINGS
) -> Setup:
    """The cart-pole that is shown its states.

    Args:
        source: the physics known beforehand; without it, the paper's CartPole, 0.05 s between commands.
        with_history: whether policy and residual read 5 states and actions, or the last alone.
    """
    return Setup(
        source=source or World(CartPole()),
        policy=lambda: StatePolicy(n_state=4, with_history=with_history),
        residual=residual_for,
        settings=settings,
    )
