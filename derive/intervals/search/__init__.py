"""Branch and bound over boxes."""
