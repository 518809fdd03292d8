"""The weights that come with the package."""

from __future__ import annotations

from importlib import resources
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
    folder = Path(str(resources.files("visadapt.weights")))
    path = folder / f"{name}.safetensors"
    if not path.is_file():
        raise ValueError(f"no weights {name!r} are shipped; there are {', '.join(sorted(_names(folder)))}")
    return path


def _names(folder: Path) -> list[str]:
    return [path.stem for path in folder.glob("*.safetensors")]
