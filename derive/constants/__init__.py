"""Guaranteed constants: Lipschitz and one-sided constants, majorants, extreme eigenvalues."""
