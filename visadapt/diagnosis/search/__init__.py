"""Which effects a recording speaks for, and where."""
