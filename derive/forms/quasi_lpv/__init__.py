"""Quasi-LPV forms: A(rho), B(rho) with scheduling ranges and an exact identity."""
