"""Bounded-error unknown input observer (Buciakowski et al.): quadratic and peak bounds."""

from obsynth.designs.bounded_error.method import BoundedErrorUIO

__all__ = ["BoundedErrorUIO"]
