"""Ways to damage a file: its bytes, its words and lines, the tree of values in it, and what formats are built of."""

from __future__ import annotations

import io
import json
import re
from random import Random
from typing import Any

import h5py
import numpy as np
import torch
from safetensors.torch import load as load_tensors, save as save_tensors

from renderers.tensor_file import sealed

WORDS = (
    *("nan", "inf", "-inf", "1e400", "-1e308", "1e-320", "0", "-0", "-1", "0.5", "9" * 400, "1_0", "0x1f", "true"),
    *("", " ", '"', "'", ",", ";", "\t", "#", "=", "[", "{", "}", "]", "\0", "\r", "\n", "\x1b[2J", "\ufeff", "\u0663"),
    *("time", "theta", "x,x", "episode", "../../etc/passwd", "z" * 200_000, "[" * 3000),
)
VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 3, 2**40, 10**400, 0.0, -0.5, 1e-320, 1e308, float("nan"), float("inf")),
    *("", "x", "nan", "1", "\0", "constant_force", "cartpole", [], {}, [None], {"": {}}, [[1, 2], [3]], "z" * 200_000),
)
ARRAYS = (
    *(np.zeros(0), np.float64(1), np.zeros((40, 0)), np.zeros((0, 4)), np.zeros((40, 4), ">f4"), np.ones(40, complex)),
    *(np.zeros((40, 4), "f2"), np.arange(40), np.zeros((40, 4), bool), np.full((40, 4), np.nan), np.ones((40, 1, 1))),
    *(np.full((40, 1), 1e300), -np.arange(40.0), np.zeros(40, [("a", "f8")]), np.zeros((40, 9, 9), "u1"), b"text"),
)


def damaged_bytes(content: bytes, other: bytes, rng: Random) -> bytes:
    """The content with bits flipped, bytes replaced, a part cut off, left out, repeated, or taken from another file."""
    out = bytearray(content)
    if not out:
        return other
    first, last = sorted(rng.randrange(len(out) + 1) for _ in range(2))
    kind = rng.randrange(6)
    if kind == 0:
        for _ in range(rng.choice((1, 1, 1, 2, 8, 64))):
            out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    elif kind == 1:
        place = rng.randrange(len(out))
        out[place : place + rng.choice((1, 2, 4, 8))] = rng.choice((b"\xff", b"\0")) * rng.choice((1, 2, 4, 8))
    elif kind == 2:
        del out[first:]
    elif kind == 3:
        del out[first : min(last, first + rng.choice((1, 8, 512)))]
    elif kind == 4:
        out[first:first] = out[first : min(last, first + rng.choice((1, 8, 512)))]
    else:
        start = rng.randrange(len(other) + 1)
        out[first:last] = other[start : start + rng.choice((1, 8, 64, last - first))]
    return bytes(out)


def damaged_text(content: bytes, other: bytes, rng: Random) -> bytes:
    """A text with a word exchanged for an odd one, put somewhere, or in a whole column; lines moved, lost, repeated."""
    text = content.decode(errors="replace")
    lines = text.splitlines()
    kind, odd = rng.randrange(5), rng.choice(WORDS)
    words = [*re.finditer(r"[^\s,;={}\[\]\"]+", text)]
    if kind == 0 and words:
        word = rng.choice(words)
        text = text[: word.start()] + odd + text[word.end() :]
    elif kind == 1:
        place = rng.randrange(len(text) + 1)
        text = text[:place] + odd + text[place:]
    elif kind == 2 and len(lines) > 1:
        column = rng.randrange(8)
        change = rng.choice((lambda cell: odd, lambda cell: cell + "0", lambda cell: "-" + cell, lambda cell: "1e9"))
        rows = [line.split(",") for line in lines]
        for row in rows[rng.choice((0, 1)) :: rng.choice((1, 1, 7))]:
            row[column : column + 1] = [change(cell) for cell in row[column : column + 1]]
        text = "\n".join(map(",".join, rows))
    elif kind == 3 and lines:
        place = rng.randrange(len(lines))
        line = lines[place]
        lines[place : place + 1] = rng.choice(([], [line] * 3, [rng.choice(lines)], [""], [line + ",1"]))
        text = "\n".join(lines)
    else:
        rng.shuffle(lines)
        text = rng.choice(("\n", "\r", "\r\n", "\n\n", "")).join(lines)
    return text.encode(errors="surrogatepass")


def odd_tree(tree: Any, rng: Random) -> Any:
    """A tree of dicts and lists with a value exchanged for an odd one or another's, gone, or under another name."""
    nodes: list[tuple[Any, Any]] = []

    def collect(node: Any) -> None:
        for key in list(node) if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ():
            nodes.append((node, key))
            collect(node[key])

    root = [json.loads(json.dumps(tree))]
    collect(root)
    parent, key = rng.choice(nodes)
    kind = rng.randrange(4)
    if kind == 0 and parent is not root:
        del parent[key]
    elif kind == 1 and isinstance(parent, dict):
        parent[rng.choice(("", "x", "effect", "a" * 1000))] = parent.pop(key)
    elif kind == 2:
        other, name = rng.choice(nodes)
        parent[key] = json.loads(json.dumps(other[name]))
    else:
        parent[key] = rng.choice(VALUES)
    return root[0]


def odd_json(content: bytes, other: bytes, rng: Random) -> bytes:
    """JSON whose tree is odd."""
    return json.dumps(odd_tree(json.loads(content), rng)).encode()


def odd_hdf5(content: bytes, other: bytes, rng: Random) -> bytes:
    """HDF5 in which a group, a dataset or an attribute is another, of another kind or size, elsewhere, or gone."""
    stream = io.BytesIO(content)
    with h5py.File(stream, "r+") as file:
        if rng.random() < 0.7:
            file.attrs["version"] = 1  # of which values have no checksum
        places: list[str] = []
        file.visit(places.append)
        place, kind = rng.choice(places), rng.randrange(6)
        if kind == 0:
            del file[place]
        elif kind == 1:
            file.move(place, rng.choice(("state", "episode_00000/frame", "episode_00007", "x/y")))
        elif kind == 2:
            del file[place]
            file[place] = rng.choice((h5py.SoftLink("/"), h5py.ExternalLink("/etc/passwd", "/"), h5py.SoftLink("/no")))
        elif kind == 3:
            name = rng.choice(("format", "version", "state_names", "action_names"))
            file.attrs[name] = rng.choice((*ARRAYS, "x", 10**18, ["x"] * 4, ["time", "x", "theta", "command"]))
        elif isinstance(file[place], h5py.Dataset) and kind == 4:
            values = file[place][()]
            flat = values.reshape(-1)
            every = slice(rng.randrange(len(flat)), None, rng.choice((1, 7, 10**6)))
            with np.errstate(over="ignore", invalid="ignore"):  # a cell may not hold the number
                flat[every] = rng.choice((0, 1, 200, np.nan, 1e30, -1e300))
            file[place][()] = values
        else:
            del file[place]
            file[place] = rng.choice(ARRAYS)
    return stream.getvalue()


def odd_tensors(content: bytes, other: bytes, rng: Random) -> bytes:
    """Safetensors with a right checksum of odd values: a tensor of another size or kind, or the JSON beside them."""
    size = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + size])
    if rng.random() < 0.3:
        text = json.dumps(odd_tree(header, rng)).encode()
        return len(text).to_bytes(8, "little") + text + content[8 + size :]
    ((key, entry),) = header["__metadata__"].items()
    tree, tensors = json.loads(entry.partition(" ")[2]), load_tensors(content)
    if rng.random() < 0.7:
        tree = odd_tree(tree, rng)
    elif tensors:
        name = rng.choice(sorted(tensors))
        tensor = tensors.pop(name)
        odd = (tensor.double(), tensor[None], tensor.flatten()[:1], tensor * torch.nan, tensor > 0, tensor[:0])
        if rng.random() < 0.8 and tensor.dim():
            tensors[rng.choice((name, name, name, "0", "x"))] = rng.choice(odd).contiguous()
    return save_tensors(tensors, {key: sealed(json.dumps(tree), tensors)})
