"""Observer of process faults for QPV plants."""
