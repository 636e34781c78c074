"""Polytopes of Jacobians: groups of scalars, half-spaces and vertices, fewer scalars."""

from obsynth.derive.polytopes.fewer import drop_scalars, principal_family
from obsynth.derive.polytopes.polytope import (
    Label,
    Polytope,
    polytope_from_halfspaces,
    polytope_from_vertices,
)
from obsynth.derive.polytopes.sampled import SampledHull, sampled_hull
from obsynth.derive.polytopes.support import Group, JacobianPolytope, jacobian_polytope

__all__ = [
    "Group",
    "JacobianPolytope",
    "Label",
    "Polytope",
    "SampledHull",
    "drop_scalars",
    "jacobian_polytope",
    "polytope_from_halfspaces",
    "polytope_from_vertices",
    "principal_family",
    "sampled_hull",
]
