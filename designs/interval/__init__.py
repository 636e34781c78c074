"""Interval observer."""
