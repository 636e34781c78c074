"""Plants in notebooks."""

import re

import pytest
import sympy as sp

from obsynth.symbolic import Plant
from obsynth.symbolic.plants import quadruple_tank


def balanced(latex):
    return latex.count("{") == latex.count("}") and latex.count(r"\left") == latex.count(r"\right")


@pytest.mark.parametrize("method", [None, "euler", "rk4"])
def test_latex_has_one_row_per_equation(method):
    plant = quadruple_tank()
    if method is not None:
        plant = plant.discretise(method, sp.Rational(1, 2))
    latex = plant._repr_latex_()
    assert latex.startswith(r"$$\begin{aligned}")
    assert latex.endswith(r"\end{aligned}$$")
    assert balanced(latex)
    rows = latex.split(r"\\")
    assert len(rows) == 7 + (method == "rk4")
    assert all("&=" in row for row in rows)
    left = r"h_{1}^{+} &=" if method == "euler" else r"\dot{h}_{1} &="
    assert left in latex
    assert r"\gamma_{1} k_{1} \left(f_{1} + v_{1}\right)" in latex, "faults are shown"
    assert r"y_{3} &= h_{3} + w_{3}" in latex


def test_rk4_is_shown_by_its_derivatives():
    model = quadruple_tank().discretise("rk4", sp.Rational(1, 2))
    latex = model._repr_latex_()
    assert r"T_s &= \frac{1}{2}\,\mathrm{s}" in latex
    assert len(latex) < 2000


def test_html_lists_every_signal_and_escapes():
    plant = Plant("a < b & c")
    (x,) = plant.states("x", range=(0, 1), unit="<m>")
    (u,) = plant.inputs("u", nominal=2)
    plant.params("k", sp.Rational(1, 3))
    plant.scheduling("r", range=(0, 1), measured=False)
    plant.actuator_faults("f", of=u, rate=0.05)
    plant.dynamics([sp.Piecewise((x, x < 1), (u, True))])
    plant.outputs([x, x], names="y z", unit="<m>", range=[(0, sp.oo), None])
    html = re.sub(r' (class|style|scope|data-\w+)(="[^"]*")?(?=[ >])', "", plant._repr_html_())
    assert "a &lt; b &amp; c" in html
    assert "&lt;m&gt;" in html
    assert "x &lt; 1" in html
    assert not re.search(r"<(?!/?(p|b|div|table|thead|tbody|tr|th|td)>)", html), "no other tags"
    for signal in plant.signals:
        assert f"<td>{signal.name}</td>" in html
    assert "actuator fault of u" in html
    assert "<td>y</td><td>output</td><td>[0, inf]</td><td></td><td></td><td>&lt;m&gt;</td>" in html
    assert "<td>z</td><td>output</td><td>unbounded</td>" in html
    assert "<td>1/3</td>" in html
    assert "not measured" in html
    assert "unbounded" in html
    assert "continuous time" in html
    assert "sampled every 0.5 s, euler" in plant.discretise("euler", 0.5)._repr_html_()


def test_an_unfinished_plant_is_shown_too():
    plant = Plant("unfinished")
    assert plant._repr_html_()
    (x,) = plant.states("theta_dot")
    plant.dynamics([-x])
    assert balanced(plant._repr_latex_())
    assert r"\begin{aligned}" in plant._repr_latex_()


def test_repr_is_one_line():
    assert repr(quadruple_tank()) == (
        "Plant('quadruple tank', continuous: 4 x, 2 u, 1 d, 2 f, 3 w, 3 y)"
    )
