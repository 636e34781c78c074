"""Expressions rewritten before they are bounded: removable singularities, cancellations."""
