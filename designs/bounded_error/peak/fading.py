"""How the first error fades from the peak bounds: a nonnegative recursion, and its proof.

For the Jacobians that occur the error system is linear, so the responses to the disturbances
(within `PeakBound.b`) and to the first error add up. The latter obeys

    xi+ = (A0 + Bp Delta S Q) xi,   |Delta S Q xi| <= coupling |Q xi| ,

with Q the outputs. Let Y be any regular matrix, eta = Y xi, and mu_a = |eta_a|_2 over blocks of
one or two coordinates (two for a complex pair). The triangle inequality in each block gives

    mu+ <= G mu,    |Q xi| <= R mu,    mu_0 <= S |xi_0| ,
    G = |Y A0 Y^-1| + |Y Bp| coupling |Q Y^-1|,   R = |Q Y^-1|,   S = |Y| ,

where |.| of a block is its spectral norm. All three are nonnegative, so the recursion started at
``S xibar_0`` stays above whatever |xi_0| <= xibar_0 does, for every k >= 0 and every sequence of
Jacobians. At k = 0 it covers ``x - xhat = zeta + E W2 w`` too: the last part is within b.
Scaling the blocks changes neither R G^k S nor the spectral radius of G.

Where neither
eigenvectors nor a Schur basis make G contract, the exponential c lambda^k of `transient` serves,
G = lambda I, R = I. It is linear in the first error as well, so c(xibar) <= sum_j xibar_j
c(unit_j), and the columns of S are c(unit_j), at least unit_j for k = 0.
"""

from collections.abc import Iterator
from functools import partial

import numpy as np

from obsynth.derive.rigour import Enclosure, add_up, product_up
from obsynth.designs.bounded_error.peak.bound import PeakBound, channel_inputs
from obsynth.designs.bounded_error.peak.system import PeakSystem
from obsynth.designs.bounded_error.peak.transient import transient
from obsynth.designs.core.certificate import Claim
from obsynth.designs.general.modal import (
    SLACK,
    Recursion,
    block_norms,
    blocks_of,
    choose,
    enclosed_inverse,
    prove_recursion,
    proved_decay,
    single,
)
from obsynth.designs.general.record import Fading, Modes
from obsynth.symbolic.arrays import FloatArray


def fade(peak: PeakBound, widest: FloatArray) -> Fading:
    """Choose the recursion that settles first from ``|xi_0| <= widest``, shape (n + n_f,)."""
    system = peak.system
    found = choose(system.A0.mid, partial(recursion, system), peak.steady, widest)
    if found is not None:
        return found
    G, reach, start = exponential(peak, transient(peak, widest).decay)
    return Fading(G, reach, start * SLACK, proved_decay(G), None)


def exponential(peak: PeakBound, decay: float) -> Recursion:
    """Return G, R and S of the exponential with a given decay."""
    eye = np.eye(len(peak.steady))
    columns = [transient(peak, unit, decay=decay).c[: len(eye)] for unit in eye]
    return decay * eye, eye, np.maximum(np.column_stack(columns), eye)


def recursion(system: PeakSystem, modes: Modes, room: float = 1.0) -> Recursion | None:
    """Return G, R of the errors and S for a basis, rounded up; None where it is not regular.

    room: by what the radii of the enclosures are multiplied
    """
    inverse = enclosed_inverse(modes)
    if inverse is None:
        return None
    norms, blocks = partial(block_norms, room=room), blocks_of(modes)
    B, coupling = channel_inputs(system)
    Q, Y = Enclosure.of(system.outputs), Enclosure.of(modes.inverse)
    reach = norms(Q @ inverse, single(len(system.outputs)), blocks)
    through = product_up(norms(Y @ B, blocks, single(len(coupling))), coupling)
    G = add_up(norms(Y @ system.A0 @ inverse, blocks, blocks), product_up(through, reach))
    start = norms(Y, blocks, single(len(modes.inverse)))
    return G, reach[: start.shape[1]], start


def prove_fading(peak: PeakBound, fading: Fading) -> Iterator[Claim]:
    """Prove the stored recursion from the stored gains and family."""
    return prove_recursion(fading, partial(recursion, peak.system), partial(exponential, peak))
