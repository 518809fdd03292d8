"""The search: which effects explain a recording, how well, and where."""
