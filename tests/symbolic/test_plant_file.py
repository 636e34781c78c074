"""Plants as text: what a file says, and where a file is wrong."""

from pathlib import Path

import pytest
import sympy as sp

import obsynth as ob
from obsynth.symbolic.plant_file import PlantText

CAR = (Path(ob.plants.__file__).parent / "cruise_control.toml").read_text()
NEW = Path(ob.plants.__file__).parents[1] / "new_plant.toml"


def test_the_template_is_the_tank_of_the_readme():
    """The same plant in Python; a range read as a bound, or an exact number rounded, differs."""
    read = ob.read_plant(NEW)
    plant = ob.Plant("tank")
    (h,) = plant.states("h", range=(10, 100), nominal=25, unit="cm")
    (v,) = plant.inputs("v", range=(0, 10), nominal=5, unit="V")
    plant.actuator_faults("f", of=v, range=(-2, 2), rate=0.01)
    (w,) = plant.disturbances("w", bound=0.1, unit="cm")
    (a,) = plant.params("a", sp.Rational(1, 10), unit="cm^(1/2)/s")
    plant.dynamics([v / 10 - a * sp.sqrt(h)])
    plant.outputs([h + w], names="y", unit="cm")
    assert read.to_dict() == plant.discretise("taylor", Ts=1).to_dict()


def test_every_way_of_declaring():
    text = """
        name = "all of it"
        Ts = "1/2"
        [states]
        "x1:3" = { range = [[0, 1], [-2, "1/3"]] }
        [inputs]
        u.range = [0, 1]
        u.unit = "V"
        [unknown_inputs]
        d = { nominal = 3 }
        [scheduling.rho]
        range = [0, 1]
        measured = false
        [parameters]
        a = "2/3"
        b = { value = 2, tolerance = 0.5 }
        c = { range = [1, 2], constant = false }
        [outputs]
        "y" = { is = "x1 + s0", unit = "m", range = [-inf, 3] }
        z = "x2"
        [sensor_faults]
        s = { of = "y", constant = true, range = [-1, 1] }
        [process_faults]
        p = { rate = 1 }
        [disturbances]
        s0 = { range = [-1, 2] }
        [definitions]
        g = "a*u"
        half = 0.5
        [dynamics]
        x2 = "x1*c"
        x1 = "g + p + d + rho + half + b"
    """
    plant = PlantText(text, "all.toml").plant()
    assert plant.exact_Ts == sp.Rational(1, 2)
    assert plant.box("x").tolist() == [[0, 1], [-2, 1 / 3]]
    assert plant.d[0].nominal == 3
    assert plant.names("f") == ("s", "p") and plant.names("p") == ("b", "c")
    assert [s.unit for s in (*plant.u, *plant.f)] == ["V", "m", ""]
    assert plant.constant_values[sp.Symbol("a", real=True)] == sp.Rational(2, 3)
    assert not plant.rho[0].measured and plant.f[0].constant and plant.f[1].rate == 1
    assert plant.output_ranges.tolist()[0] == [-float("inf"), 3]
    assert str(plant.rhs[1]) == "c*x1" and plant.rhs[0].has(sp.Float(0.5))


@pytest.mark.parametrize(
    ("what", "into", "place", "message"),
    [
        ("pull*u", "pul*u", (37, 7), "pul is not declared .* did you mean pull"),
        ('v = "(pull', 'v = "(pull(', (37, 7), "the function pull is not supported"),
        ('v = "(pull', "v = (pull", (37, 5), "equations stand in quotes"),
        ("drag)/1600", "drag/1600", (37, 40), r"expected '\)'"),
        ("v**2", "v^2", (34, 35), r"a power is written \*\*"),
        ("[5, 40]", "[40, 5]", (18, 1), "state v: the range .* is empty; give the lower"),
        ("[5, 40]", "[40]", (18, 1), "range of v: a pair"),
        ("[5, 40]", '"a lot"', (18, 16), "a is not declared"),
        ("[inputs]", "[input]", (20, 1), "did you mean inputs"),
        ("nominal = 20", "nominl = 20", (18, 24), "nominl has no meaning in v; did you mean"),
        ('of = "u", ', "", (24, 1), "fault f needs of ="),
        ('of = "u"', 'of = "uu"', (24, 1), "of=uu is no input; inputs are u"),
        ('v = "(pull', 'vv = "(pull', (37, 1), "vv is no state; did you mean v"),
        ("[disturbances]", "[disturbances]\nv = { bound = 1 }", (27, 1), "taken by the state v"),
        ("is = ", "equals = ", (40, 8), "equals has no meaning in y1; known are is"),
        ("bound = 0.2", "bound = -0.2", (27, 1), "not a finite, non-negative number"),
        ("[inputs]", "[discretise]\nmethod = 'eulr'\nTs = 1\n[inputs]", (20, 1), "euler, rk4"),
        ("[inputs]", "[discretise]\nmethod = 'euler'\n[inputs]", (20, 1), "needs Ts"),
        ('name = "cruise control"', "", (1, 1), "has no name: write name"),
        ("[outputs]", "[parameters]", (40, 8), "is has no meaning in y1; known are constant"),
        ("[dynamics]", "[dynamics]\n[x]", (37, 1), "x has no meaning here"),
        ("pull = ", "v = ", (32, 1), "a definition has a name of its own"),
        ('y1 = { is = "v + w2", unit = "m/s" }', "y1 = true", (40, 1), "text in quotes, not True"),
        ('v = { range = [5, 40], nominal = 20, unit = "m/s" }', "v = 3", (18, 1), "is a table"),
        ("[5, 40]", "[5, 40", (18, 15), r"the \[ is not closed; noticed in line 18"),
        ("[5, 40]", "[5,\n 40", (18, 15), r"the \[ is not closed; noticed in line 19"),
        ("[5, 40]", "5, 40]", (18, 20), "^((?!not closed).)*in a line of { }"),
        ("[5, 40]", "[5, fast]", (18, 19), "Invalid value; equations"),
        ('20, unit = "m/s" }', '20, unit = "m/s"', (18, 5), "the { is not closed"),
        ("[states]", "[states", (17, 1), r"the \[ is not closed"),
        ('v = "(pull', "v = '(pull", (37, 5), "the ' is not closed"),
        ("[outputs]", '[outputs]\nz = """v', (40, 5), 'the """ is not closed; noticed in line 4'),
    ],
)
def test_mistakes_are_told_by_line_and_column(what, into, place, message):
    """A pointer that is one line off, or at the key in place of the character, is seen."""
    assert what in CAR
    with pytest.raises(ob.PlantError, match=message) as caught:
        PlantText(CAR.replace(what, into), "car.toml").plant()
    told = str(caught.value)
    assert (caught.value.line, caught.value.column) == place
    assert told.startswith(f"car.toml, line {place[0]}, column {place[1]}: ")
    pointer = told.splitlines()[-1]
    assert pointer.index("^") == 4 + place[1] - 1


def test_what_is_no_text(tmp_path):
    file = tmp_path / "plant.toml"
    file.write_bytes(b"\xff\xfe")
    with pytest.raises(ob.PlantError, match="no text in UTF-8"):
        ob.read_plant(file)
    file.write_bytes(b" " * 1_000_001)
    with pytest.raises(ob.PlantError, match="at most 1000000"):
        ob.read_plant(file)
    file.write_text('name = "x')
    with pytest.raises(ob.PlantError, match=r'line 1, column 8: the " is not closed') as caught:
        ob.read_plant(file)
    assert caught.value.line == 1


def test_long_lines_are_shown_around_the_mistake():
    text = CAR.replace("drag)/1600", "drag)/1600" + " + v" * 60 + " + oops")
    with pytest.raises(ob.PlantError, match="oops is not declared") as caught:
        PlantText(text, "car.toml").plant()
    shown, pointer = str(caught.value).splitlines()[1:]
    assert shown[pointer.index("^") :].startswith("oops") and len(shown) < 120


def test_windows_line_ends():
    plant = PlantText(CAR.replace("\n", "\r\n"), "car.toml").plant()
    assert plant.to_dict() == ob.plants.cruise_control().to_dict()
