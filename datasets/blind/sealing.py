"""Sealed recordings: the key is kept outside their folder, and its hash is printed before anything is written."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from pathlib import Path


def names(count: int, suffix: str = ".csv") -> list[str]:
    """File names of the recordings, in order."""
    return [f"{i:04d}{suffix}" for i in range(count)]


def as_csv(lines: Iterator[str]) -> bytes:
    """The content of a CSV of these lines."""
    return ("\n".join(lines) + "\n").encode()


def key_path(folder: Path, key: Path | None) -> Path:
    """File of the key: beside the folder of the recordings unless given.

    Raises:
        ValueError: it lies in that folder.
    """
    place = key or folder.with_name(folder.name + ".key.json")
    if folder.resolve() in place.resolve().parents:
        raise ValueError(f"{place}: the key must not lie in the folder of the recordings")
    return place


def seal(folder: Path, key: Path, text: str, recordings: Iterable[bytes], suffix: str = ".csv") -> None:
    """Print the SHA-256 of the key's text, then write the key, and the recordings, each given by its content."""
    print(f"SHA-256 of the key: {hashlib.sha256(text.encode()).hexdigest()}", flush=True)
    folder.mkdir(parents=True, exist_ok=True)
    key.parent.mkdir(parents=True, exist_ok=True)
    key.write_text(text, encoding="utf-8")
    drawn = list(recordings)
    for name, content in zip(names(len(drawn), suffix), drawn, strict=True):
        (folder / name).write_bytes(content)
    print(f"{folder}: {len(drawn)} recordings; key: {key}")
