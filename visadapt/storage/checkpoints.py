"""Checkpoints: weights and training states as safetensors, never pickled.

A tree of dicts, lists, tuples, tensors and plain values is one file: the tensors by name, the rest as JSON in the
file's header.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from renderers.tensor_file import checksum, read_tensors, unsealed, write_tensors
from renderers.weights import HEADER_KEY
from visadapt.storage.atomic_files import replacing

TREE_KEY = "visadapt.tree"
"""Key of the JSON, after its checksum, in the header of the safetensors file."""


class CheckpointError(ValueError):
    """A checkpoint that cannot be read or does not fit; the message names the file, the key and what is wrong."""


def save_tree(path: Path, tree: Any) -> None:
    """Write a tree to `path`, atomically."""
    tensors: dict[str, Tensor] = {}
    skeleton = json.dumps(_strip(tree, tensors))
    with replacing(path) as temporary:
        write_tensors(temporary, tensors, TREE_KEY, skeleton)


def load_tree(path: Path) -> Any:
    """Read a tree; raises CheckpointError if the file is missing, damaged, or not written by `save_tree`."""
    metadata, tensors = read_tensors(path, "checkpoint", CheckpointError)
    entry = metadata.get(TREE_KEY)
    if entry is None:
        what = "holds a renderer" if HEADER_KEY in metadata else "a safetensors file that visadapt did not write"
        raise CheckpointError(f"{path}: {what}; a policy, or what a run kept, is needed")
    if (skeleton := unsealed(entry, tensors)) is None:
        raise CheckpointError(f"{path}: is damaged: its checksum is not that of what it holds")
    with fitting(path):
        return _restore(json.loads(skeleton), tensors)


@contextmanager
def fitting(path: Path) -> Iterator[None]:
    """Turn what a block raises where a checkpoint lacks something, or holds something else, into CheckpointError.

    >>> import pathlib
    >>> with fitting(pathlib.Path("a.safetensors")):
    ...     {"weights": 1}["settings"]
    Traceback (most recent call last):
    visadapt.storage.checkpoints.CheckpointError: a.safetensors: is incomplete or of another kind: has no 'settings'
    """
    try:
        yield
    except CheckpointError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RuntimeError) as error:
        what = " ".join(str(error).split())
        what = f"has no {what}" if isinstance(error, KeyError) else f"{type(error).__name__}: {what}"
        raise CheckpointError(f"{path}: is incomplete or of another kind: {what}") from error


def load_weights(module: nn.Module, weights: Mapping[str, Tensor], origin: Path) -> None:
    """Load weights into a module, all of them or none.

    Raises:
        CheckpointError: a key is missing or extra, or differs in shape or dtype; the message names it and `origin`.
    """
    check_sizes(module.state_dict(), weights, origin)
    module.load_state_dict(dict(weights))


def check_sizes(needed: Mapping[str, Tensor], found: Mapping[str, Tensor], origin: Path) -> None:
    """Raise CheckpointError, which names the key, where one is missing or extra, or differs in shape or dtype."""
    there = {key: f"{tuple(value.shape)} {value.dtype}" for key, value in found.items()}
    right = {key: f"{tuple(value.shape)} {value.dtype}" for key, value in needed.items()}
    for key in (*right, *sorted(there)):
        if there.get(key) != right.get(key):
            raise CheckpointError(
                f"{origin}: made for another architecture: {key} is {there.get(key, 'missing')}, "
                f"this network needs {right.get(key, 'none of that name')}"
            )


def weights_digest(network: nn.Module) -> str:
    """The SHA-256 of all weights and buffers of a network."""
    return checksum("", network.state_dict().items())


def save_network(path: Path, network: nn.Module, settings: Mapping[str, Any]) -> None:
    """Write a network's weights and buffers, which include its normalisers, and the settings of its training."""
    save_tree(path, {"class": type(network).__name__, "settings": dict(settings), "weights": network.state_dict()})


def load_network(path: Path, network: nn.Module) -> dict[str, Any]:
    """Load what `save_network` wrote into a network of the same class; returns the settings of its training.

    Raises:
        CheckpointError: the file is missing, incomplete, or holds another class or architecture.
    """
    tree = load_tree(path)
    if not isinstance(tree, dict) or tree.keys() != {"class", "settings", "weights"}:
        raise CheckpointError(f"{path}: a checkpoint, but not of a network")
    if tree["class"] != type(network).__name__:
        raise CheckpointError(f"{path}: holds a {tree['class']}, a {type(network).__name__} is needed")
    load_weights(network, tree["weights"], path)
    return tree["settings"]


def _strip(node: Any, tensors: dict[str, Tensor]) -> Any:
    if isinstance(node, Tensor):
        name = str(len(tensors))
        tensors[name] = node.detach().contiguous().clone()
        return {"tensor": name}
    if isinstance(node, Mapping):
        return {"dict": [[key, _strip(value, tensors)] for key, value in node.items()]}
    if isinstance(node, (list, tuple)):
        return {"list": [_strip(value, tensors) for value in node]}
    if node is None or isinstance(node, (bool, int, float, str)):
        return {"value": node}
    raise TypeError(f"a checkpoint holds tensors, dicts, lists and plain values, not {type(node).__name__}")


def _restore(node: Any, tensors: dict[str, Tensor]) -> Any:
    ((kind, content),) = node.items()
    if kind == "tensor":
        return tensors[content]
    if kind == "dict":
        return {key: _restore(value, tensors) for key, value in content}
    if kind == "list":
        return [_restore(value, tensors) for value in content]
    return content
