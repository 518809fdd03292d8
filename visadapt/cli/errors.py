"""The error by which a subcommand refuses an argument."""

from __future__ import annotations


class InputError(ValueError):
    """An argument that cannot be used; the message is one line: what, where, and what would be right."""
