"""Adapts control policies from pixels to a machine whose dynamics differ from the simulator's."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from visadapt.diagnosis import diagnose

__all__ = ["diagnose"]


def __getattr__(name: str) -> object:
    # Only when asked for: whoever imports one module of the library need not wait for the diagnosis and torch.
    if name == "diagnose":
        from visadapt.diagnosis import diagnose

        return diagnose
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
