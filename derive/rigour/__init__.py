"""Rigorous numbers: what is proved here is true of real numbers, every rounding counted.

The law of every kind of number stands in docs/proofs.md, and tests/derive/rigour holds it to that.
"""

from obsynth.derive.rigour.eigenvalues import finite as finite
from obsynth.derive.rigour.eigenvalues import largest_eigenvalue as largest_eigenvalue
from obsynth.derive.rigour.eigenvalues import perron_bound as perron_bound
from obsynth.derive.rigour.eigenvalues import rotate as rotate
from obsynth.derive.rigour.enclosure import Enclosure as Enclosure
from obsynth.derive.rigour.enclosure import ProofResult as ProofResult
from obsynth.derive.rigour.enclosure import prove_positive_definite as prove_positive_definite
from obsynth.derive.rigour.interval import TINY as TINY
from obsynth.derive.rigour.interval import UNIT as UNIT
from obsynth.derive.rigour.interval import UNIT_ROUNDOFF as UNIT_ROUNDOFF
from obsynth.derive.rigour.interval import Interval as Interval
from obsynth.derive.rigour.interval import add_up as add_up
from obsynth.derive.rigour.interval import allowance as allowance
from obsynth.derive.rigour.interval import down as down
from obsynth.derive.rigour.interval import enclose_number as enclose_number
from obsynth.derive.rigour.interval import gamma_bound as gamma_bound
from obsynth.derive.rigour.interval import inward as inward
from obsynth.derive.rigour.interval import lowered as lowered
from obsynth.derive.rigour.interval import middle_and_radius as middle_and_radius
from obsynth.derive.rigour.interval import outward as outward
from obsynth.derive.rigour.interval import product_up as product_up
from obsynth.derive.rigour.interval import raised as raised
from obsynth.derive.rigour.interval import rational as rational
from obsynth.derive.rigour.interval import round_number as round_number
from obsynth.derive.rigour.interval import smallest_above as smallest_above
from obsynth.derive.rigour.interval import substitute as substitute
from obsynth.derive.rigour.interval import up as up
from obsynth.derive.rigour.rationals import Exact as Exact
from obsynth.derive.rigour.rationals import ExactMatrix as ExactMatrix
from obsynth.derive.rigour.rationals import above as above
from obsynth.derive.rigour.rationals import exact as exact
from obsynth.derive.rigour.rationals import from_text as from_text
from obsynth.derive.rigour.rationals import image as image
from obsynth.derive.rigour.rationals import inverse as inverse
from obsynth.derive.rigour.rationals import is_positive_definite as is_positive_definite
from obsynth.derive.rigour.rationals import magnitude as magnitude
from obsynth.derive.rigour.rationals import nearest as nearest
from obsynth.derive.rigour.rationals import negative as negative
from obsynth.derive.rigour.rationals import positive as positive
from obsynth.derive.rigour.rationals import to_text as to_text
