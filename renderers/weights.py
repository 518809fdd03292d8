"""Learnt renderers on disk: safetensors, with the class, its arguments and how it was trained as JSON in the header."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from renderers.learnt import LayeredRenderer, MLPRenderer
from renderers.tensor_file import read_tensors, unsealed, write_tensors

KINDS: dict[str, type[LayeredRenderer] | type[MLPRenderer]] = {"layered": LayeredRenderer, "mlp": MLPRenderer}
FORMAT_VERSION = 1
OF_ANY_CAMERA = {"stretch", "perspective", "distortion"}
"""Parameters that are 0 for a camera square to the plane of motion, without distortion."""
HEADER_KEY = "renderers"
"""Key of the JSON, after its checksum, in the header of the safetensors file."""


class RendererError(ValueError):
    """A file that holds no renderer, or another one than needed; the message is one line that names the file."""


def save_renderer(path: Path, renderer: LayeredRenderer | MLPRenderer, training: Mapping[str, Any]) -> None:
    """Write a renderer; `training` documents its training (seed, steps, versions) as values that JSON can hold.

    Its "error" is the renderer's `error`, where it was measured.
    """
    kind = next(name for name, cls in KINDS.items() if type(renderer) is cls)
    header = {"format": FORMAT_VERSION, "kind": kind, "arguments": renderer.arguments, "training": dict(training)}
    weights = {key: value.detach().contiguous() for key, value in renderer.state_dict().items()}
    write_tensors(path, weights, HEADER_KEY, json.dumps(header))


def load_renderer(path: str | Path, size: tuple[int, int] | None = None) -> LayeredRenderer | MLPRenderer:
    """The renderer in a file, of the class that was saved, on the CPU; `size` is the (height, width) it must have.

    Raises:
        RendererError: the file is missing, incomplete, or not a renderer's; or the renderer has another architecture
            or frame size.
    """
    metadata, weights = read_tensors(Path(path), "renderer", RendererError)
    entry = metadata.get(HEADER_KEY)
    if entry is None:
        raise RendererError(f"{path}: a safetensors file, but not a renderer's")
    if (text := unsealed(entry, weights)) is None:
        raise RendererError(f"{path}: is damaged: its checksum is not that of what it holds")
    try:
        header = json.loads(text)
        if header["format"] != FORMAT_VERSION:
            raise RendererError(f"{path}: format {header['format']}, this version reads {FORMAT_VERSION}")
        if min(header["arguments"]["height"], header["arguments"]["width"]) < 1:
            raise ValueError("frames without pixels")
        kind, arguments = KINDS[header["kind"]], header["arguments"]
        with torch.device("meta"):  # without memory: a damaged header may ask for more than there is
            sizes = kind(**arguments)
        error = _error(header["training"])
    except (LookupError, TypeError, AttributeError, ValueError, ArithmeticError, RuntimeError) as caught:
        if isinstance(caught, RendererError):
            raise
        what = " ".join(str(caught).split())
        raise RendererError(f"{path}: its header does not describe a known renderer ({what})") from caught
    if kind is LayeredRenderer and OF_ANY_CAMERA.isdisjoint(weights):  # Written before these were learnt
        weights |= {name: torch.zeros(size.shape) for name, size in sizes.named_parameters() if name in OF_ANY_CAMERA}
    try:
        sizes.load_state_dict(weights, assign=True)
    except RuntimeError as caught:
        raise RendererError(f"{path}: made for another architecture: {' '.join(str(caught).split())}") from caught
    renderer = kind(**arguments)
    renderer.load_state_dict(weights)
    renderer.error = error
    if size is not None and renderer.size != size:
        raise RendererError(
            f"{path}: its frames are {renderer.size[1]} x {renderer.size[0]} px, {size[1]} x {size[0]} are needed"
        )
    return renderer


def _error(training: dict[str, Any]) -> float | None:
    """A renderer's own error as its file gives it, a grey level in [0, 1]; None where it was not measured."""
    error = training.get("error")
    if error is not None and not 0 <= float(error) < 1:
        raise ValueError(f"an error of {error}, which must be within [0, 1)")
    return None if error is None else float(error)
