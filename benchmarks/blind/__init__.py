"""The sealed check of the diagnosis."""
