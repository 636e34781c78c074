"""The quadratic parameter-varying form of a plant, its text, and where its matrices stand."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from typing import ClassVar, Literal

import casadi as ca
import sympy as sp

from obsynth.derive.forms.qpv.augment import Augmented
from obsynth.derive.forms.varying import Layout, VaryingForm, Vertices, casadi_elements, short
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.convert import to_sx
from obsynth.symbolic.plant import Plant


@dataclass(frozen=True)
class QPVLayout(Layout):
    """Columns [c A N M B D B_f G] over the rows of the dynamics, then of the outputs.

    A row of N holds the matrix N_i row by row, a row of M the rows of M_1, M_2, ... one after the
    other.

    states, outputs, inputs, unknown, faults, disturbances: numbers of signals, states after
        augmentation
    """

    BLOCKS: ClassVar[dict[str, tuple[str, str]]] = {
        "c": ("dynamics", "1"),
        "A": ("dynamics", "x"),
        "N": ("dynamics", "xx"),
        "M": ("dynamics", "ux"),
        "B": ("dynamics", "u"),
        "D": ("dynamics", "d"),
        "B_f": ("dynamics", "f"),
        "G": ("dynamics", "w"),
        "C": ("outputs", "x"),
        "feedthrough": ("outputs", "u"),
        "D_f": ("outputs", "f"),
        "H": ("outputs", "w"),
        "output_offset": ("outputs", "1"),
    }

    states: int
    outputs: int
    inputs: int
    unknown: int
    faults: int
    disturbances: int

    @classmethod
    def of(cls, plant: Augmented) -> QPVLayout:
        """Return the layout of an augmented plant."""
        model = plant.model
        return cls(
            len(plant.states),
            len(plant.outputs),
            len(model.u),
            len(model.d),
            len(plant.faults),
            len(model.w),
        )

    @property
    def heights(self) -> tuple[int, int]:
        """Number of states and of outputs."""
        return self.states, self.outputs

    @property
    def widths(self) -> dict[str, int]:
        """Columns by the signals they multiply."""
        n, k = self.states, self.inputs
        counts = (1, n, n * n, n * k, k, self.unknown, self.faults, self.disturbances)
        return dict(zip(("1", "x", "xx", "ux", "u", "d", "f", "w"), counts, strict=True))

    def unfold(self, block: str, values: FloatArray) -> FloatArray:
        """Give N and M their shapes, (n, n, n) and (n_u, n, n)."""
        n, before = self.states, values.shape[:-1]
        if block == "N":
            return values.reshape(*before, n, n)
        return values.reshape(*before, -1, n).swapaxes(-3, -2) if block == "M" else values

    def start(self, block: str) -> int:
        """First column of a block."""
        return int(self.place(block)[1].start)

    def quadratic(self, a: int, b: int) -> int:
        """Column of the entry (a, b) of N_i."""
        return self.start("N") + a * self.states + b

    def bilinear(self, j: int, a: int) -> int:
        """Column of u_j x_a."""
        return self.start("M") + j * self.states + a


@dataclass(frozen=True, eq=False)
class QPVVertices(Vertices):
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

    layout: QPVLayout

    @property
    def c(self) -> FloatArray:
        """Constant part, shape (V, n)."""
        return self.block("c")[:, :, 0]

    @property
    def N(self) -> FloatArray:
        """Quadratic part, shape (V, n, n, n): N[v, i] is N_i."""
        return self.block("N")

    @property
    def M(self) -> FloatArray:
        """State-by-input terms, shape (V, n_u, n, n): M[v, j] belongs to u_j."""
        return self.block("M")

    @property
    def G(self) -> FloatArray:
        """Disturbances in the dynamics, shape (V, n, n_w)."""
        return self.block("G")

    @property
    def C(self) -> FloatArray:
        """Output matrix, shape (V, m, n)."""
        return self.block("C")

    @property
    def H(self) -> FloatArray:
        """Disturbances in the outputs, shape (V, m, n_w)."""
        return self.block("H")


@dataclass(frozen=True, eq=False, repr=False)
class QPV(VaryingForm):
    """x' = c + A x + [x'N_i x] + sum_j u_j M_j x + B u + D d + B_f f + G w, y = C x + H w + ...

    Equations (5)-(6) of Rotondo, Buciakowski and Witczak for a plant with process faults: x is
    the augmented state, faults last. For a discrete plant x' stands for the next state. The
    matrices are functions of scheduling variables and uncertain parameters.

    Attributes
    ----------
    matrix : sympy.Matrix
        All blocks stacked, exact.
    layout : QPVLayout
        Where the blocks are; see `block`.
    schedule : AffineSchedule
        The same, affine in scheduling variables.
    proof : FormProof
        That the form is the plant.
    plant : Augmented
        Plant, augmented states, remaining faults.
    form_of_N : str
        ``"upper"`` or ``"symmetric"``: the same dynamics, different LMIs.
    """

    layout: QPVLayout
    plant: Augmented
    form_of_N: Literal["upper", "symmetric"]

    @property
    def model(self) -> Plant:
        """The plant before augmentation."""
        return self.plant.model

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the augmented states."""
        return tuple(s.name for s in self.plant.states)

    @property
    def box(self) -> FloatArray:
        """Ranges of the augmented states, shape (n, 2)."""
        return self.plant.box

    @property
    def c(self) -> sp.Matrix:
        """Constant part, shape (n, 1)."""
        return self.block("c")

    @property
    def N(self) -> tuple[sp.Matrix, ...]:
        """Quadratic part: row i is x'N_i x."""
        n = self.layout.states
        rows = self.block("N")
        return tuple(sp.ImmutableMatrix(n, n, list(rows[i, :])) for i in range(n))

    @property
    def M(self) -> tuple[sp.Matrix, ...]:
        """State-by-input terms: the sum of u_j M_j x."""
        n = self.layout.states
        columns = self.block("M")
        return tuple(columns[:, j * n : (j + 1) * n] for j in range(self.layout.inputs))

    @property
    def D(self) -> sp.Matrix:
        """Matrix of the unknown inputs, shape (n, n_d)."""
        return self.block("D")

    @property
    def B_f(self) -> sp.Matrix:
        """Matrix of the faults that are no states, shape (n, n_f)."""
        return self.block("B_f")

    @property
    def G(self) -> sp.Matrix:
        """Disturbances in the dynamics, shape (n, n_w)."""
        return self.block("G")

    @property
    def feedthrough(self) -> sp.Matrix:
        """Inputs in the outputs, shape (m, n_u)."""
        return self.block("feedthrough")

    @property
    def D_f(self) -> sp.Matrix:
        """Remaining faults in the outputs, shape (m, n_f)."""
        return self.block("D_f")

    @property
    def H(self) -> sp.Matrix:
        """Disturbances in the outputs, shape (m, n_w)."""
        return self.block("H")

    @property
    def output_offset(self) -> sp.Matrix:
        """Constant part of the outputs, shape (m, 1)."""
        return self.block("output_offset")

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
        return QPVVertices(self.schedule.family(self.layout.shape), self.layout)

    def function(self) -> ca.Function:
        """Return the augmented system as a CasADi function.

        Returns
        -------
        casadi.Function
            (x, u, d, f, w, p, rho) -> (rhs, y), x the augmented and f the remaining faults.
        """
        model, table = self.model, casadi_elements(self.model)
        # a loss of effectiveness is no signal of the plant
        table |= {s.symbol: ca.SX.sym(s.name) for s in self.plant.states if s.symbol not in table}
        groups = {kind: getattr(model, kind) for kind in ("x", "u", "d", "f", "w", "p", "rho")}
        groups |= {"x": self.plant.states, "f": self.plant.faults}
        columns = [
            ca.vertcat(ca.SX(0, 1), *[table[s.symbol] for s in part]) for part in groups.values()
        ]
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


def _quadratic(form: QPV, i: int) -> sp.Expr:
    """Quadratic part of a row as an expression."""
    x = sp.Matrix([s.symbol for s in form.plant.states])
    return (x.T * form.N[i] * x)[0]


def _bilinear(form: QPV, i: int) -> sp.Expr:
    x = sp.Matrix([s.symbol for s in form.plant.states])
    u = [s.symbol for s in form.model.u]
    parts = (s * (part[i, :] * x)[0] for s, part in zip(u, form.M, strict=True))
    return sum(parts, sp.Integer(0))


def qpv_text(form: QPV) -> str:
    """Return a quadratic form as plain text."""
    time = "x+" if form.model.Ts is not None else "x'"
    lines = [
        f"{form.model.name}: {time} = c + A x + [x'N_i x] + sum_j u_j M_j x + B u + ...; "
        f"x = ({', '.join(form.names)}), N {form.form_of_N}"
    ]
    for i, name in enumerate(form.names):
        parts = [p for p in (_quadratic(form, i), _bilinear(form, i)) if p != 0]
        if parts:
            listed = " + ".join(sp.sstr(short(p)) for p in parts).replace("+ -", "- ")
            lines.append(f"  {name}: {listed}")
    lines += [f"  scheduling {v}" for v in form.scheduling]
    lines.append(str(form.proof))
    return "\n".join(lines)


def qpv_latex(form: QPV) -> str:
    r"""Return the matrices of a quadratic form as LaTeX."""
    blocks: list[tuple[str, sp.Matrix]] = [("c", form.c), ("A", form.A)]
    blocks += [(f"N_{{{i + 1}}}", part) for i, part in enumerate(form.N)]
    blocks += [(f"M_{{{j + 1}}}", part) for j, part in enumerate(form.M)]
    blocks += [("B", form.B), ("D", form.D), ("B_f", form.B_f), ("G", form.G)]
    blocks += [("C", form.C), ("D_f", form.D_f), ("H", form.H)]
    rows = [
        f"{name} &= {sp.latex(sp.Matrix(part).applyfunc(short))}"
        for name, part in blocks
        if any(entry != 0 for entry in part)
    ]
    body = " \\\\\n".join(rows)
    return f"\\begin{{aligned}}\n{body}\n\\end{{aligned}}"


def qpv_html(form: QPV) -> str:
    """Return a quadratic form for a notebook."""
    states = "".join(
        f"<tr><td>{escape(s.name)}</td><td>{escape(str(s.role))}</td>"
        f"<td>{s.lower:.6g}</td><td>{s.upper:.6g}</td></tr>"
        for s in form.plant.states
    )
    scheduling = "".join(f"<li>{escape(str(v))}</li>" for v in form.scheduling)
    head, *_ = qpv_text(form).split("\n")
    return (
        f"<p><b>{escape(head)}</b></p><div>$${escape(qpv_latex(form), quote=False)}$$</div>"
        f"<table><tr><th>state</th><th>role</th><th>min</th><th>max</th></tr>{states}</table>"
        f"<ul>{scheduling}<li>{escape(str(form.proof))}</li></ul>"
    )
