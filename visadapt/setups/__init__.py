"""The pieces of one control problem put together: source, task, policy, residual."""
