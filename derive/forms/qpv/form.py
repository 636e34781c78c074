"""The quadratic parameter-varying form of a plant."""

from dataclasses import dataclass

import casadi as ca
import numpy as np
import sympy as sp
from numpy.typing import NDArray

from obsynth.derive.algebra.zero_test import FormProof
from obsynth.derive.errors import StructureError
from obsynth.derive.forms.qpv.augment import Augmented
from obsynth.derive.forms.qpv.display import qpv_html, qpv_latex, qpv_text
from obsynth.derive.forms.qpv.layout import QPVLayout
from obsynth.derive.forms.quasi_lpv.polytopic import family_of
from obsynth.derive.forms.quasi_lpv.scheduling import AffineSchedule, SchedulingVariable
from obsynth.derive.jacobian.family import AffineFamily
from obsynth.derive.rigour.numbers import round_number
from obsynth.symbolic.convert import to_sx
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.signals import Signal

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class QPVVertices:
    """The matrices of a quadratic form at the vertices of its scheduling variables.

    Attributes
    ----------
    family : AffineFamily
        The stacked matrix, affine in the scheduling variables; its radius bounds the rounding.
    layout : QPVLayout
        Where the matrices are.

    Notes
    -----
    The last scheduling variable changes fastest, the lower end comes first: (0, 0), (0, 1),
    (1, 0), (1, 1) for two of them.
    """

    family: AffineFamily
    layout: QPVLayout

    @property
    def count(self) -> int:
        """Number of vertices V."""
        return self.family.vertex_count

    @property
    def exact(self) -> bool:
        """True when the hull of the vertices is that of the matrices that occur."""
        return self.family.exact

    def _block(self, name: str, outputs: bool = False) -> Array:
        rows = self.layout.measurement if outputs else self.layout.dynamics
        return self.family.vertices()[:, rows, self.layout.columns(name)]

    @property
    def c(self) -> Array:
        """Constant part, shape (V, n)."""
        return self._block("c")[:, :, 0]

    @property
    def A(self) -> Array:
        """Linear part, shape (V, n, n)."""
        return self._block("A")

    @property
    def N(self) -> Array:
        """Quadratic part, shape (V, n, n, n): N[v, i] is N_i."""
        n = self.layout.states
        return self._block("N").reshape(-1, n, n, n)

    @property
    def M(self) -> Array:
        """State-by-input terms, shape (V, n_u, n, n): M[v, j] belongs to u_j."""
        n = self.layout.states
        blocks = self._block("M").reshape(-1, n, self.layout.inputs, n)
        return blocks.transpose(0, 2, 1, 3)

    @property
    def B(self) -> Array:
        """Input matrix, shape (V, n, n_u)."""
        return self._block("B")

    @property
    def D(self) -> Array:
        """Matrix of the unknown inputs, shape (V, n, n_d)."""
        return self._block("D")

    @property
    def B_f(self) -> Array:
        """Matrix of the faults that are no states, shape (V, n, n_f)."""
        return self._block("B_f")

    @property
    def G(self) -> Array:
        """Disturbances in the dynamics, shape (V, n, n_w)."""
        return self._block("G")

    @property
    def C(self) -> Array:
        """Output matrix, shape (V, m, n)."""
        return self._block("A", outputs=True)

    @property
    def H(self) -> Array:
        """Disturbances in the outputs, shape (V, m, n_w)."""
        return self._block("G", outputs=True)


@dataclass(frozen=True, eq=False, repr=False)
class QPV:
    """x' = c + A x + [x'N_i x] + sum_j u_j M_j x + B u + D d + B_f f + G w, y = C x + H w + ...

    Equations (5)-(6) of Rotondo, Buciakowski and Witczak for a plant with process faults: x is
    the augmented state, faults last. For a discrete plant x' stands for the next state. The
    matrices are functions of scheduling variables and uncertain parameters.

    Attributes
    ----------
    plant : Augmented
        Plant, augmented states, remaining faults.
    form_of_N : str
        ``"upper"`` or ``"symmetric"``: the same dynamics, different LMIs.
    matrix : sympy.Matrix
        All blocks stacked, exact.
    layout : QPVLayout
        Where the blocks are.
    schedule : AffineSchedule
        The same, affine in scheduling variables.
    proof : FormProof
        That the form is the plant.
    """

    plant: Augmented
    form_of_N: str
    matrix: sp.Matrix
    layout: QPVLayout
    schedule: AffineSchedule
    proof: FormProof

    @property
    def model(self) -> Plant:
        """The plant before augmentation."""
        return self.plant.model

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the augmented states."""
        return tuple(s.name for s in self.plant.states)

    @property
    def box(self) -> Array:
        """Ranges of the augmented states, shape (n, 2)."""
        return self.plant.box

    @property
    def scheduling(self) -> tuple[SchedulingVariable, ...]:
        """Scheduling variables with their ranges."""
        return self.schedule.variables

    def _block(self, name: str, outputs: bool = False) -> sp.Matrix:
        rows = self.layout.measurement if outputs else self.layout.dynamics
        return self.matrix[rows, self.layout.columns(name)]

    @property
    def c(self) -> sp.Matrix:
        """Constant part, shape (n, 1)."""
        return self._block("c")

    @property
    def A(self) -> sp.Matrix:
        """Linear part, shape (n, n)."""
        return self._block("A")

    @property
    def N(self) -> tuple[sp.Matrix, ...]:
        """Quadratic part: row i is x'N_i x."""
        n = self.layout.states
        rows = self._block("N")
        return tuple(sp.ImmutableMatrix(n, n, list(rows[i, :])) for i in range(n))

    @property
    def M(self) -> tuple[sp.Matrix, ...]:
        """State-by-input terms: the sum of u_j M_j x."""
        n = self.layout.states
        columns = self._block("M")
        return tuple(columns[:, j * n : (j + 1) * n] for j in range(self.layout.inputs))

    @property
    def B(self) -> sp.Matrix:
        """Input matrix, shape (n, n_u)."""
        return self._block("B")

    @property
    def D(self) -> sp.Matrix:
        """Matrix of the unknown inputs, shape (n, n_d)."""
        return self._block("D")

    @property
    def B_f(self) -> sp.Matrix:
        """Matrix of the faults that are no states, shape (n, n_f)."""
        return self._block("B_f")

    @property
    def G(self) -> sp.Matrix:
        """Disturbances in the dynamics, shape (n, n_w)."""
        return self._block("G")

    @property
    def C(self) -> sp.Matrix:
        """Output matrix, shape (m, n)."""
        return self._block("A", outputs=True)

    @property
    def feedthrough(self) -> sp.Matrix:
        """Inputs in the outputs, shape (m, n_u)."""
        return self._block("B", outputs=True)

    @property
    def D_f(self) -> sp.Matrix:
        """Remaining faults in the outputs, shape (m, n_f)."""
        return self._block("B_f", outputs=True)

    @property
    def H(self) -> sp.Matrix:
        """Disturbances in the outputs, shape (m, n_w)."""
        return self._block("G", outputs=True)

    @property
    def output_offset(self) -> sp.Matrix:
        """Constant part of the outputs, shape (m, 1)."""
        return self._block("c", outputs=True)

    def constant(self, name: str) -> Array:
        """Return a matrix that does not vary as doubles.

        Parameters
        ----------
        name : str
            ``"A"``, ``"B"``, ``"G"``, ``"C"``, ``"H"``, ...; ``"N"`` and ``"M"`` are stacked,
            shapes (n, n, n) and (n_u, n, n).

        Returns
        -------
        ndarray
            The nearest doubles.

        Raises
        ------
        StructureError
            An entry depends on scheduling variables or parameters; they are named.

        Examples
        --------
        >>> from obsynth.derive import qpv
        >>> from obsynth.symbolic.plants import qpv_example
        >>> qpv(qpv_example()).constant("N")[0, 0].tolist()
        [0.0, 0.0, 0.0, 1.0, 0.0, 0.0]
        """
        value = getattr(self, name)
        if isinstance(value, tuple):
            if not value:
                return np.zeros((0, self.layout.states, self.layout.states))
            return np.array([self._numbers(name, part) for part in value])
        return self._numbers(name, value)

    def _numbers(self, name: str, block: sp.Matrix) -> Array:
        values = np.zeros(block.shape)
        for i in range(block.rows):
            for j in range(block.cols):
                free = sorted(map(str, block[i, j].free_symbols))
                if free:
                    raise StructureError(
                        f"{name}[{i + 1},{j + 1}] = {block[i, j]} varies with {', '.join(free)}; "
                        f"use vertices(), or fix {', '.join(free)}",
                        entry=(i, j),
                        symbols=tuple(free),
                        condition="constant block",
                    )
                values[i, j] = round_number(block[i, j])[0]
        return values

    def vertices(self) -> QPVVertices:
        """Matrices at the vertices of the scheduling variables.

        Returns
        -------
        QPVVertices
            One vertex where nothing varies.

        Raises
        ------
        UnboundedError
            A scheduling variable without a finite range.

        Examples
        --------
        >>> from obsynth.derive import qpv
        >>> from obsynth.symbolic.plants import qpv_example
        >>> corners = qpv(qpv_example()).vertices()
        >>> corners.A.shape, corners.A[1, 0, 2], corners.A[2, 0, 0]
        ((4, 6, 6), np.float64(4.0), np.float64(-5.0))
        """
        return QPVVertices(family_of(self.schedule, self.layout.shape), self.layout)

    def function(self) -> ca.Function:
        """Return the augmented system as a CasADi function.

        Returns
        -------
        casadi.Function
            (x, u, d, f, w, p, rho) -> (rhs, y), x the augmented and f the remaining faults.
        """
        model = self.model
        groups: dict[str, tuple[Signal, ...]] = {
            "x": self.plant.states,
            "u": model.u,
            "d": model.d,
            "f": self.plant.faults,
            "w": model.w,
            "p": model.p,
            "rho": model.rho,
        }
        columns, table = [], {}
        for signals in groups.values():
            elements = [ca.SX.sym(s.name) for s in signals]
            columns.append(ca.vertcat(*elements) if elements else ca.SX(0, 1))
            table.update({s.symbol: e for s, e in zip(signals, elements, strict=True)})
        rhs = to_sx(list(self.plant.rows), table, list(self.names))
        outputs = to_sx(list(self.plant.outputs), table, list(model.output_names))
        return ca.Function(
            "qpv",
            columns,
            [ca.densify(ca.vertcat(*rhs)), ca.densify(ca.vertcat(*outputs))],
            list(groups),
            ["rhs", "y"],
        )

    def __repr__(self) -> str:
        return f"QPV({self.model.name!r}, states {', '.join(self.names)}, N {self.form_of_N})"

    def __str__(self) -> str:
        return qpv_text(self)

    def _repr_latex_(self) -> str:
        return f"$${qpv_latex(self)}$$"

    def _repr_html_(self) -> str:
        return qpv_html(self)
