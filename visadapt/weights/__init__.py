"""The weights that come with the package."""

from __future__ import annotations

from pathlib import Path


def shipped(name: str) -> Path:
    """The file of a renderer or a source policy that comes with the package.

    Args:
        name: renderer (of the drawn cart-pole), cartpole_frames, cartpole_states, quadrotor or fixed_wing.

    Raises:
        ValueError: there is no such file.

    >>> import visadapt as va
    >>> va.shipped("quadrotor").name
    'quadrotor.safetensors'
    """
    there = {path.stem: path for path in sorted(Path(__file__).parent.glob("*.safetensors"))}
    if name not in there:
        raise ValueError(f"no weights {name!r} are shipped; there are {', '.join(there)}")
    return there[name]
