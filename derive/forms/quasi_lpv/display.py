"""Quasi-LPV forms as text, LaTeX and HTML."""

from html import escape
from typing import TYPE_CHECKING

import sympy as sp

from obsynth.derive.forms.text import short

if TYPE_CHECKING:
    from obsynth.derive.forms.quasi_lpv.form import QuasiLPV

_LONGEST = 60
UNMEASURED_NOTE = (
    "With unmeasured scheduling A(x) x - A(xhat) xhat is not A(x) (x - xhat): an observer that "
    "schedules with its estimate needs the Jacobian form (jacobian_bounds), or bounds that hold "
    "for every value (vertices, interval)."
)


def form_text(form: "QuasiLPV") -> str:
    """Return a form as plain text."""
    names = form.model.names("x")
    lines = [_title(form)]
    for block, columns in (("A", names), ("B", form.model.names("u"))):
        place = form.layout.place(block)
        matrix = form.scheduled[place]
        for i, row in enumerate(names):
            entries = [
                f"{column}: {sp.sstr(short(matrix[i, j]))}"
                for j, column in enumerate(columns)
                if matrix[i, j] != 0
            ]
            if entries:
                lines.append(f"  {block}, row of {row}: {'; '.join(entries)}")
    offset = form.scheduled[form.layout.place("offset")]
    if any(e != 0 for e in offset):
        listed = ", ".join(sp.sstr(short(e)) for e in offset)
        lines.append(f"  offset: ({listed})")
    lines.append("scheduling" if form.scheduling else "no scheduling: the form is linear")
    lines += [f"  {v}" for v in form.scheduling]
    lines += notes(form)
    return "\n".join(lines)


def notes(form: "QuasiLPV") -> list[str]:
    """List what a user has to know about a form: choices, terms left over, measurement, proof."""
    result = []
    for ranking in form.ranking:
        if ranking.total > 1:
            result.append(f"row of {ranking.row}: {ranking.total} ways, chosen is")
            result.append(f"  {ranking.alternatives[0]}")
    for row, term, reason in form.unfactored:
        text = sp.sstr(short(term))
        text = text if len(text) <= _LONGEST else text[: _LONGEST - 3] + "..."
        result.append(f"the term {text} in the row of {row} stays in the offset: {reason}")
    lost = form.unmeasured
    if lost:
        result.append(f"unmeasured scheduling: {', '.join(str(v.symbol) for v in lost)}")
        result.append(UNMEASURED_NOTE)
    result.append(str(form.proof))
    return result


def _title(form: "QuasiLPV") -> str:
    time = "x+" if form.model.Ts is not None else "x'"
    if form.centre.is_origin:
        return f"{form.model.name}: {time} = A x + B u + ... + offset"
    return f"{form.model.name}: {time} = A (x - x_c) + B (u - u_c) + ... + offset"


def form_latex(form: "QuasiLPV") -> str:
    r"""Return the matrices of a form in their scheduling variables, as LaTeX."""
    rows = []
    for name, label in (("A", "A"), ("B", "B"), ("offset", "r")):
        matrix = form.scheduled[form.layout.place(name)]
        if matrix.cols and any(e != 0 for e in matrix):
            rows.append(f"{label} &= {sp.latex(sp.Matrix(matrix).applyfunc(short))}")
    for v in form.scheduling:
        own = "" if v.symbol == v.expression else f"= {sp.latex(short(v.expression))} "
        rows.append(f"{sp.latex(v.symbol)} &{own}\\in [{v.lower:.6g},\\, {v.upper:.6g}]")
    body = " \\\\\n".join(rows)
    return f"\\begin{{aligned}}\n{body}\n\\end{{aligned}}"


def form_html(form: "QuasiLPV") -> str:
    """Return a form for a notebook: matrices, scheduling table, ranking, notes."""
    cells = "".join(
        f"<tr><td>{escape(str(v.symbol))}</td><td>{escape(sp.sstr(short(v.expression)))}</td>"
        f"<td>{v.lower:.8g}</td><td>{v.upper:.8g}</td><td>{str(v.status).split(':')[0]}</td>"
        f"<td>{'measured' if v.measured else 'needs ' + escape(', '.join(v.unmeasured))}</td></tr>"
        for v in form.scheduling
    )
    heads = ("variable", "function", "min", "max", "range", "known on line")
    table = (
        f"<table><tr>{''.join(f'<th>{h}</th>' for h in heads)}</tr>{cells}</table>" if cells else ""
    )
    listed = "".join(f"<li>{escape(note)}</li>" for note in notes(form))
    ranked = "".join(
        f"<tr><td>{escape(r.row)}</td><td>{k + 1}</td><td>{escape(_ways(a.choices))}</td>"
        f"<td>{a.inflation:.4g}</td><td>{escape(', '.join(a.unmeasured))}</td></tr>"
        for r in form.ranking
        if r.total > 1
        for k, a in enumerate(r.alternatives)
    )
    ranking = (
        "<table><tr><th>row</th><th>rank</th><th>term by divisor</th><th>inflation</th>"
        f"<th>unmeasured</th></tr>{ranked}</table>"
        if ranked
        else ""
    )
    latex = escape(form_latex(form), quote=False)
    return (
        f"<p><b>{escape(_title(form))}</b></p><div>$${latex}$$</div>{table}"
        f"<ul>{listed}</ul>{ranking}"
    )


def _ways(choices: tuple[tuple[str, str], ...]) -> str:
    return "; ".join(f"{term} by {divisor}" for term, divisor in choices)
