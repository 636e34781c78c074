"""Which printed claims of the five papers hold: computed, not recited."""
