"""How does the plant look as matrices that vary? Quasi-LPV and quadratic forms, with proof."""
