"""Films and plots of what was run."""
