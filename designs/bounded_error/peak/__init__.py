"""Guaranteed peak (l1) bounds of the errors of an unknown input observer."""
