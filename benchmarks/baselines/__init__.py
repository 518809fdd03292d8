"""What else one could use, beside ours: one module a baseline, all set the same problems (`problem.py`)."""
