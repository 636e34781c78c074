"""Which observer for this plant: every method tried in one run, beside a Kalman filter."""
