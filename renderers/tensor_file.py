"""Safetensors files with JSON in the header that says what the tensors are, after a checksum of both."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, uint8


def sealed(text: str, tensors: Mapping[str, Tensor]) -> str:
    """The JSON that says what tensors are, after a checksum of both.

    One entry of a header, since safetensors writes several in an order that changes from run to run.
    """
    return f"{checksum(text, sorted(tensors.items()))} {text}"


def unsealed(entry: str, tensors: Mapping[str, Tensor]) -> str | None:
    """The JSON of what `sealed` gave; None where the checksum does not fit. Older files have none."""
    if entry.startswith("{"):
        return entry
    written, _, text = entry.partition(" ")
    return text if written == checksum(text, sorted(tensors.items())) else None


def write_tensors(path: Path, tensors: Mapping[str, Tensor], key: str, text: str) -> None:
    """Write tensors, with the JSON that says what they are under a key of the header.

    Not by `safetensors.torch.save_file`, which writes a file of another name first: a process that is killed meanwhile
    leaves it.
    """
    path.write_bytes(save(dict(tensors), {key: sealed(text, tensors)}))


def read_tensors(path: Path, kind: str, error: type[ValueError]) -> tuple[dict[str, str], dict[str, Tensor]]:
    """The header's entries and the tensors of a file; raises `error`, in one line, where it cannot be read.

    `kind` is what the file should hold, in words.
    """
    try:
        path.open("rb").close()  # since safetensors reports any failure to open as a missing file
        with safe_open(path, framework="pt") as file:
            return file.metadata() or {}, {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    except FileNotFoundError as caught:
        raise error(f"{path}: there is no such {kind}") from caught
    except OSError as caught:
        raise error(f"{path}: cannot be read: {caught.strerror or caught}") from caught
    except SafetensorError as caught:
        raise error(f"{path}: not a complete safetensors file ({caught})") from caught


def checksum(text: str, tensors: Iterable[tuple[str, Tensor]]) -> str:
    """The SHA-256 of a text and, in this order, of tensors with their names."""
    found = hashlib.sha256(text.encode())
    for name, values in tensors:
        found.update(f"{name} {values.dtype} {tuple(values.shape)}".encode())
        found.update(values.detach().cpu().contiguous().reshape(-1).view(uint8).numpy().tobytes())
    return found.hexdigest()
