"""What the user says: plants, signals, equations, scenarios."""
