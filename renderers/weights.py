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
FORMAT = 1
KEY = "renderers"


class RendererError(ValueError):
    """A file that holds no renderer, or not the one asked for; the message is one line that names the file."""


def save_renderer(path: Path, renderer: LayeredRenderer | MLPRenderer, training: Mapping[str, Any]) -> None:
    """Write a renderer; `training` is whatever JSON can hold on how it came about: seed, steps, versions."""
    kind = next(name for name, cls in KINDS.items() if type(renderer) is cls)
    header = {"format": FORMAT, "kind": kind, "arguments": renderer.arguments, "training": dict(training)}
    weights = {key: value.detach().contiguous() for key, value in renderer.state_dict().items()}
    save_file(weights, path, {KEY: json.dumps(header)})


def load_renderer(path: Path, size: tuple[int, int] | None = None) -> LayeredRenderer | MLPRenderer:
    """The renderer in a file, of the class that was saved, on the CPU; `size` is the (height, width) it must have.

    Raises:
        RendererError: there is no such file, it is torn or not a renderer's, its weights are another architecture's,
            or its frames have another size.
    """
    if not path.is_file():
        raise RendererError(f"{path}: there is no such renderer")
    try:
        with safe_open(path, framework="pt") as file:
            text = (file.metadata() or {}).get(KEY)
            weights = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise RendererError(f"{path}: not a whole safetensors file ({error})") from error
    if text is None:
        raise RendererError(f"{path}: a safetensors file, but not a renderer's")
    try:
        header = json.loads(text)
        if header["format"] != FORMAT:
            raise RendererError(f"{path}: format {header['format']}, this version reads {FORMAT}")
        renderer = KINDS[header["kind"]](**header["arguments"])
    except (KeyError, TypeError, json.JSONDecodeError) as error:
        raise RendererError(f"{path}: its header does not describe a renderer that is known here ({error})") from error
    for key, value in renderer.state_dict().items():
        if key not in weights:
            raise RendererError(f"{path}: made for another architecture: {key} is missing")
        if weights[key].shape != value.shape:
            raise RendererError(
                f"{path}: made for another architecture: {key} is {tuple(weights[key].shape)}, "
                f"this renderer needs {tuple(value.shape)}"
            )
    if extra := sorted(weights.keys() - renderer.state_dict().keys()):
        raise RendererError(f"{path}: made for another architecture: {extra[0]} is not in this renderer")
    if size is not None and renderer.size != size:
        raise RendererError(
            f"{path}: its frames are {renderer.size[1]} x {renderer.size[0]} px, {size[1]} x {size[0]} are needed"
        )
    renderer.load_state_dict(weights)
    return renderer
