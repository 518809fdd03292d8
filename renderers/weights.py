"""Learnt renderers on disk: safetensors, with the class, its arguments and how it was trained as JSON in the header."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from renderers.learnt import LayeredRenderer, MLPRenderer

KINDS: dict[str, type[LayeredRenderer] | type[MLPRenderer]] = {"layered": LayeredRenderer, "mlp": MLPRenderer}
FORMAT_VERSION = 1
HEADER_KEY = "renderers"
"""Key of the JSON in the header of the safetensors file."""


class RendererError(ValueError):
    """A file that holds no renderer, or another one than needed; the message is one line that names the file."""


def save_renderer(path: Path, renderer: LayeredRenderer | MLPRenderer, training: Mapping[str, Any]) -> None:
    """Write a renderer; `training` documents its training (seed, steps, versions) as values that JSON can hold."""
    kind = next(name for name, cls in KINDS.items() if type(renderer) is cls)
    header = {"format": FORMAT_VERSION, "kind": kind, "arguments": renderer.arguments, "training": dict(training)}
    weights = {key: value.detach().contiguous() for key, value in renderer.state_dict().items()}
    save_file(weights, path, {HEADER_KEY: json.dumps(header)})


def load_renderer(path: Path, size: tuple[int, int] | None = None) -> LayeredRenderer | MLPRenderer:
    """The renderer in a file, of the class that was saved, on the CPU; `size` is the (height, width) it must have.

    Raises:
        RendererError: the file is missing, incomplete, or not a renderer's; or the renderer has another architecture
            or frame size.
    """
    if not path.is_file():
        raise RendererError(f"{path}: there is no such renderer")
    try:
        with safe_open(path, framework="pt") as file:
            text = (file.metadata() or {}).get(HEADER_KEY)
            weights = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise RendererError(f"{path}: not a complete safetensors file ({error})") from error
    if text is None:
        raise RendererError(f"{path}: a safetensors file, but not a renderer's")
    try:
        header = json.loads(text)
        if header["format"] != FORMAT_VERSION:
            raise RendererError(f"{path}: format {header['format']}, this version reads {FORMAT_VERSION}")
        renderer = KINDS[header["kind"]](**header["arguments"])
    except (KeyError, TypeError, json.JSONDecodeError) as error:
        raise RendererError(f"{path}: its header does not describe a known renderer ({error})") from error
    try:
        renderer.load_state_dict(weights)
    except RuntimeError as error:
        raise RendererError(f"{path}: made for another architecture: {' '.join(str(error).split())}") from error
    if size is not None and renderer.size != size:
        raise RendererError(
            f"{path}: its frames are {renderer.size[1]} x {renderer.size[0]} px, {size[1]} x {size[0]} are needed"
        )
    return renderer
