"""Rigorous numbers: intervals, enclosures, exact matrices, rounding, definiteness."""
