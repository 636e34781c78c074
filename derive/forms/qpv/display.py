"""Quadratic forms as text, LaTeX and HTML."""

from html import escape
from typing import TYPE_CHECKING

import sympy as sp

from obsynth.derive.forms.text import short

if TYPE_CHECKING:
    from obsynth.derive.forms.qpv.form import QPV


def _quadratic(form: "QPV", i: int) -> sp.Expr:
    """Quadratic part of a row as an expression."""
    x = sp.Matrix([s.symbol for s in form.plant.states])
    return (x.T * form.N[i] * x)[0]


def _bilinear(form: "QPV", i: int) -> sp.Expr:
    x = sp.Matrix([s.symbol for s in form.plant.states])
    u = [s.symbol for s in form.model.u]
    parts = (s * (part[i, :] * x)[0] for s, part in zip(u, form.M, strict=True))
    return sum(parts, sp.Integer(0))


def qpv_text(form: "QPV") -> str:
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


def qpv_latex(form: "QPV") -> str:
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


def qpv_html(form: "QPV") -> str:
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
