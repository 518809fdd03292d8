"""Adapts control policies from pixels to a machine whose dynamics differ from the simulator's."""
