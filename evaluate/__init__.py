"""What it is worth: simulation, coverage, plots, report."""
