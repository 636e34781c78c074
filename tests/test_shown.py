"""Every public object shows itself: a short repr, and HTML that is whole, escaped and rounded.

Mutants: `_part` of `symbolic/shown.py` that does not escape text, or lines; a cell, a head or a
title of `Table` that is not escaped; a table without its end; numbers with nine digits.
"""

import inspect
import re
from functools import cache, partial
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import obsynth as ob
from methods import METHODS
from obsynth.designs.hinf.worst_case import WorstCase
from obsynth.designs.set_adaptive.indicators import Indicators
from obsynth.evaluate.choosing.tries import Try

TAGS = {"p", "b", "div", "table", "caption", "thead", "tbody", "tr", "th", "td"}
TAGS |= {"ul", "li", "details", "summary", "br"}
NAME, UNIT = "<i>car</i> & co", "<m/s>"


@cache
def car():
    """Third powers of fractions, so that there are digits to show."""
    plant = ob.Plant(NAME)
    (v,) = plant.states("v", range=(1 / 3, 40 / 3), unit=UNIT)
    (u,) = plant.inputs("u", range=(0, 1), nominal=2 / 3, unit=UNIT)
    (k,) = plant.params("k", value=1 / 3000)
    plant.actuator_faults("f", of=u, range=(-1 / 3, 1 / 3))
    n, w = plant.disturbances("n w", bound=1e-3 / 3, unit=UNIT)
    plant.dynamics([u - k * v**3 / 3 - v / 30 + n])
    plant.outputs([v + w], unit=UNIT)
    return plant


@cache
def model():
    return car().discretise("euler", Ts=0.1)


@cache
def observer():
    return ob.BoundedErrorUIO(bounds="peak").design(model())


@cache
def scenario():
    return ob.scenarios.gentle(model(), steps=30)


@cache
def run():
    return ob.simulate(model(), detector(), scenario())


@cache
def detector():
    return ob.FaultDetector(observer())


@cache
def record():
    return ob.read_record({"t": run().t, "u": run().u[:, 0], "y1": run().y[:, 0]}, model())


@cache
def fit():
    return ob.least_bounds(model(), record()[:12])


def leak():
    return ob.records.three_tank_leak()[:20]


def project(kind):
    known = {"name": "car", "build": None, "comparison": None}
    if kind is ob.Fmu:
        parts = dict.fromkeys(("inputs", "outputs", "parameters"), ("v",))
        return kind(path=Path(f"{NAME}.fmu"), guid="{1}", platform=None, **parts, **known)
    more = {"files": (), "sizes": {"x": 1}, "operations": 7, "vectors": 3, "statuses": {0: 3}}
    return kind(folder=Path(NAME), **more, **known)


def study():
    told = SimpleNamespace(data={"record": {}})
    return ob.Study(car(), ob.BoundedErrorUIO(), told, Path())


def choice():
    tried, kalman = (Try(word, 1 / 3, observer(), run()) for word in (NAME, "Kalman"))
    return ob.Choice(model(), ("v",), None, (tried, Try("b", 1 / 3, reason=NAME)), kalman)


def campaign():
    row = {"design": NAME, "scenario": UNIT, "truth": "", "refused": "", "kept": True}
    row |= {"v: missed": 0, "v: bounded": True, "v: half width": 1 / 3}
    return ob.Campaign((row,), ("v",))


THIRDS = np.ones((4, 1)) / 3, np.ones((4, 1)) / 3
REFUSED = f"{NAME} {UNIT}\n  of {1 / 3:.4g}"
# Public classes, and what public functions return beside them.
SHOWN = {
    **{
        name: partial(getattr(ob, name), REFUSED)
        for name in ob.__all__
        if inspect.isclass(getattr(ob, name)) and issubclass(getattr(ob, name), Exception)
    },
    "BoundedErrorUIO": lambda: ob.BoundedErrorUIO(gamma=1 / 3),
    "CProject": lambda: project(ob.CProject),
    "Campaign": campaign,
    "Certificate": lambda: observer().certificate,
    "Choice": choice,
    "Ellipsoid": lambda: ob.Ellipsoid([1 / 3, 2 / 3], [1 / 7, 0]),
    "Equilibrium": lambda: ob.equilibrium(car()),
    "Estimate": lambda: ob.estimate(observer(), record()),
    "FaultDetector": detector,
    "FilterBank": ob.FilterBank,
    "Fmu": lambda: project(ob.Fmu),
    "HinfUIO": ob.HinfUIO,
    "Identified": lambda: ob.identify(ob.plants.leaking_tanks(), leak(), {"a1": (0.005, 0.05)}),
    "IntervalObserver": ob.IntervalObserver,
    "JacobianBounds": lambda: ob.jacobian_bounds(model()),
    "LeastBounds": fit,
    "Observer": observer,
    "Plant": car,
    "QPVObserver": lambda: METHODS["qpv_observer"].method,
    "Record": record,
    "Run": run,
    "Scenario": scenario,
    "SetAdaptiveObserver": ob.SetAdaptiveObserver,
    "SetMembershipObserver": ob.SetMembershipObserver,
    "Split": lambda: ob.split(model()),
    "Study": study,
    "Table": lambda: ob.Table(NAME, [UNIT, "b"], [[NAME, 1 / 3]], note=UNIT, marked=[0]),
    "StructureReport": lambda: ob.analyse(model()),
    "Remainder": lambda: ob.discretisation_remainder(car(), "euler", Ts=0.1),
    "Excitation": lambda: ob.excitation(model()),
    "Indicators": lambda: Indicators(*(np.ones((4, 2), dtype=bool),) * 3),
    "FaultIsolability": lambda: ob.fault_isolability(model()),
    "LipschitzConstants": lambda: ob.lipschitz(model()),
    "Majorant": lambda: ob.majorant(ob.split(model())),
    "QPV": lambda: ob.qpv(ob.plants.qpv_example()),
    "QuasiLPV": lambda: ob.quasi_lpv(model()),
    "WorstCase": lambda: WorstCase(*(1 / 3,) * 2, *(np.ones(3) / 7,) * 3, 1 / 3, *THIRDS, 2 / 3),
}
# What methods of those return.
FURTHER = {
    "Guarantee": lambda: observer().guarantee,
    "Detection": lambda: detector().detect(run()),
    "Domain": lambda: run().domain,
    "Trace": lambda: run()["v"],
    "Vertices": lambda: ob.quasi_lpv(model()).vertices(),
    "CentredForm": lambda: ob.quasi_lpv(model()).centred(),
    "IntervalForm": lambda: ob.quasi_lpv(model()).interval(),
    "Validation": lambda: fit().validate(2),
    "Attribution": lambda: fit().attribute(),
}


class Page(HTMLParser):
    """Tags that are opened and closed in turn, and the text between them."""

    def __init__(self, page):
        super().__init__()
        self.open, self.tags, self.text = [], set(), ""
        self.feed(page)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.text += " "
        if tag != "br":
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def long_numbers(text):
    """Numbers with more than eight significant digits."""
    found = re.findall(r"\d+\.?\d*", text)
    return [n for n in found if len(n.replace(".", "").strip("0")) > 8]


@pytest.mark.parametrize("name", [*SHOWN, *FURTHER])
def test_a_public_object_shows_itself(name):
    shown = {**SHOWN, **FURTHER}[name]()
    assert type(shown).__name__ == name
    assert 0 < len(repr(shown)) <= 2000
    html = shown._repr_html_()
    page = Page(html)
    assert page.open == [] and page.tags and page.tags <= TAGS
    assert page.text.strip() and len(html) < 40_000
    assert long_numbers(page.text) == []


def test_names_units_and_words_of_the_user_are_shown_as_they_are():
    for shown in (car(), ob.split(model()), observer(), detector(), observer().guarantee):
        assert "&" in Page(shown._repr_html_()).text
    text = Page(SHOWN["Table"]()._repr_html_()).text
    assert text.count(NAME) == 2 and text.count(UNIT) == 2
    assert Page(ob.PlantError(REFUSED)._repr_html_()).text.count(UNIT) == 1
    assert long_numbers("1.23456789 0.0012345678 120000000 3.14") == ["1.23456789"]


def test_every_public_class_and_what_functions_return_is_in_the_table():
    public = {name: getattr(ob, name) for name in ob.__all__}
    classes = {name for name, value in public.items() if inspect.isclass(value)}
    returned = set()
    for value in filter(inspect.isfunction, public.values()):
        kind = inspect.signature(value).return_annotation
        kind = inspect.unwrap(value).__globals__.get(kind) if isinstance(kind, str) else kind
        if getattr(kind, "__module__", "").startswith("obsynth"):
            returned.add(kind.__name__)
    assert classes | returned == set(SHOWN)


@pytest.mark.parametrize("module", [ob, ob.plants, ob.scenarios, ob.records])
def test_only_public_names_are_listed(module):
    listed = {name for name in dir(module) if not name.startswith("_")}
    assert listed - {"text"} == set(module.__all__)
