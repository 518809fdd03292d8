"""A diagnosis as JSON, after `schema.json`: the fields of its dataclasses in their order, as plain numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from numbers import Integral
from typing import Any

SCHEMA_VERSION = 1
"""Version of `schema.json`."""

KEYS = {"start": "from", "end": "to"}
"""JSON keys of fields whose names differ from them."""

NOT_IN_JSON = ("figures", "policy")
"""Fields that only the report shows."""

SHARES = ("probability", "share", "p_value", "stages", "states")
"""Fields with numbers from 0 to 1, which are rounded to 12 digits so that a rounding error does not exceed 1."""


def as_json(diagnosis: Any) -> dict[str, Any]:
    """What json.dumps takes, even with allow_nan=False: numbers that are not finite become None."""
    content = {"schema": SCHEMA_VERSION, **_plain(diagnosis)}
    content["where"]["pixels"] = None
    return content


def _plain(value: Any, is_share: bool = False) -> Any:
    if is_dataclass(value):
        names = [field.name for field in fields(value) if field.name not in NOT_IN_JSON]
        return {KEYS.get(name, name): _plain(getattr(value, name), name in SHARES) for name in names}
    if isinstance(value, Mapping):
        return {key: _plain(each, is_share) for key, each in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(each) for each in value]
    if isinstance(value, str):
        return value
    if isinstance(value, Integral):
        return int(value)
    number = float(value)
    if not math.isfinite(number):
        return None
    return round(number, 12) if is_share else number
