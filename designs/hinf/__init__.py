"""H-infinity unknown input observer."""
