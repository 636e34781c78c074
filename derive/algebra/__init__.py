"""Exact symbolic algebra: zero tests, factors, secants, linear parts, identities."""
