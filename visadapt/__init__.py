"""Adapts control policies from pixels to a machine whose dynamics differ from the simulator's."""

from visadapt.diagnosis import diagnose

__all__ = ["diagnose"]
