"""Bounded-error unknown input observer."""
