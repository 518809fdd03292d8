"""gymnasium's InvertedPendulum-v5 (MuJoCo) as a target, and the source model that its published numbers give."""

from __future__ import annotations

from dataclasses import asdict

from visadapt.systems import CartPole
from visadapt.targets.env_map import Entry, EnvMap
from visadapt.targets.gymnasium import GymnasiumTarget
from visadapt.targets.synthetic import Start

REACH_M = 0.9
"""Largest |x| of the cart: rail and frame end at 1 m."""

START = Start()
"""The same as the synthetic target's, and wider than the environment's own +-0.01."""

MAP = EnvMap(
    states={"x": Entry(0), "theta": Entry(1), "x_dot": Entry(2), "theta_dot": Entry(3)},
    # Its control range is +-3 with a gear of 100: 300 N, or 19 m/s2 on cart and pole, too coarse for balancing. Our
    # command of 1 is a control of 1, 100 N.
    actions=(Entry(0, scale=1.0),),
    crop=(0, 0, 240, 200),
    # The only light is the one at the camera: the brightest pixels have a grey level of about 130.
    contrast=(0.0, 150.0),
    limits={"theta": 0.3, "x": REACH_M},
    start=asdict(START),
    options={
        "width": 240,
        "height": 200,
        # Looks along +y from a fixed point (body 0 is the world), so that +x is to the right.
        "default_camera_config": {
            "trackbodyid": 0,
            "distance": 2.0,
            "azimuth": 90.0,
            "elevation": 0.0,
            "lookat": (0.0, 0.0, 0.32),
        },
    },
)
"""The environment itself ends an episode already at |theta| > 0.2 rad."""

SOURCE = CartPole(
    cart_mass=10.471975511965976,
    pole_mass=5.018591641363306,
    pole_half_length=0.3,
    max_force=100.0,
    gravity=9.81,
)
"""The published values of its model: masses, the pole's length, gear, gravity; a uniform rod without friction."""


def inverted_pendulum() -> GymnasiumTarget:
    """InvertedPendulum-v5, 0.04 s between actions.

    Raises:
        TargetError: gymnasium or mujoco is not installed, or no off-screen renderer works.
    """
    return GymnasiumTarget("InvertedPendulum-v5", MAP)
