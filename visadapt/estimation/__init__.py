"""States, noise and parameters from measurements: linearisation, Kalman filter and smoother, likelihood."""
