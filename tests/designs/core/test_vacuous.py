"""A half width that says nothing says so, and where to look for a better one."""

from dataclasses import replace

import numpy as np

import obsynth as ob


def test_what_is_no_narrower_than_declared_is_named_with_what_to_do():
    """Mutants: half of the half range, or the whole range, as what is declared."""
    observer = ob.IntervalObserver().design(ob.plants.leaking_tanks())
    assert observer.vacuous == () and "choose" not in str(observer) + observer._repr_html_()
    for width, told in ((0.05, ("leak",)), (0.0499, ())):
        wide = replace(observer, half_widths=np.append(observer.half_widths[:3], width))
        assert wide.vacuous == told
        assert ("no more than is declared" in wide.widths["leak"]) is bool(told)
        for shown in (str(wide), wide._repr_html_()):
            advice = "says no more of leak than is declared: obsynth.choose tries the other methods"
            assert (advice in shown) is bool(told)
    assert replace(observer, half_widths=None).vacuous == ()
