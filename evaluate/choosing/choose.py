"""`choose`: which observer for this plant?"""

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from obsynth.derive import DerivationError, equilibrium
from obsynth.derive.equilibrium import operating_values
from obsynth.designs.core.method import Method
from obsynth.evaluate.choosing.choice import Choice
from obsynth.evaluate.choosing.kalman import ExtendedKalman
from obsynth.evaluate.choosing.tries import METHODS, Try, attempt, in_time, named
from obsynth.evaluate.data.estimate import estimate
from obsynth.evaluate.data.estimated import Estimate
from obsynth.evaluate.errors import SimulationError
from obsynth.evaluate.progress import bar
from obsynth.evaluate.run import Run
from obsynth.evaluate.simulate import simulate
from obsynth.symbolic import Plant, Record, Scenario
from obsynth.symbolic.scenarios import gentle
from obsynth.symbolic.taking import takes


@takes(model="Plant", record="Record", scenario="Scenario")
def choose(
    model: Plant,
    record: Record | None = None,
    budget: int | None = None,
    *,
    criterion: str | Sequence[str] = "faults",
    Ts: float | None = None,
    methods: Sequence[Method] = METHODS,
    scenario: Scenario | None = None,
    seed: int = 0,
    limit: float | None = 270.0,
) -> Choice:
    """Try every method on a plant and recommend one.

    Parameters
    ----------
    model : Plant
        Discrete, or continuous with `Ts`. Methods in continuous time take the plant behind a
        discrete one, where there is one.
    record : Record, optional
        Run the observers on what was measured; by default they run in one simulation.
    budget : int, optional
        Largest number of operations that a step of the recommended observer may take.
    criterion : {"faults", "states", "all"} or sequence of str
        Over which signals half width / half range in the run is averaged; "faults" stands for the
        states where there is no fault.
    Ts : float, optional
        For a continuous plant: it is discretised by Euler's rule, and the discrete guarantees
        speak of that model. Give ``plant.discretise(...)`` for another one.
    methods : sequence of methods, optional
        With their options; by default all that may fit.
    scenario : Scenario, optional
        The common run; by default `scenarios.gentle`, as gentle and as short as keeps the state in
        its box.
    seed : int
        Of the scenario and of the disturbances, the same for all.
    limit : float or None
        Seconds for all methods. One that takes about twice its share of what is left is ended and
        counts as refused, where processes can be forked. None: as long as it takes, in this one.

    Returns
    -------
    Choice
        ``recommended``, ``reason``, ``table``, ``widths``, ``assumptions``, ``plot()``. The
        recommended observer is the cheapest per step of those that are at most 5 per cent wider
        than the narrowest in the run, within the budget.

    Examples
    --------
    >>> import obsynth as ob
    >>> few = [ob.IntervalObserver(), ob.BoundedErrorUIO(bounds="peak")]
    >>> choose(ob.plants.cruise_control(), Ts=0.1, methods=few).best.name
    "BoundedErrorUIO(bounds='peak')"
    """
    if (model.check().Ts is None) == (Ts is None):
        what = "a continuous plant" if Ts is None else f"sampled every {model.Ts:g} s"
        mend = "give Ts=, the sample time of the observers" if Ts is None else "leave Ts out"
        raise SimulationError(f"{model.name} is {what}: {mend}.")
    model = model if Ts is None else model.discretise("euler", Ts=Ts)
    counted, kalman = _signals(model, criterion), ExtendedKalman(model)
    if record is None:
        chosen = _gentle(model, kalman, seed) if scenario is None else scenario
        # what a discretisation leaves out is nobody's to draw, and its noise is that of the others
        own, noise = len(model.w) - len(model.remainder or ()), chosen.arrays(model, seed)["w"]
        assert noise is not None
        chosen = replace(chosen, disturbances=noise[:, :own])

    def run(observer: Any) -> Run | Estimate:
        if record is not None:
            return estimate(observer, record)
        return simulate(observer.model, observer, chosen, seed)

    tries, yardstick = [], Try(kalman.method, 0.0, kalman, run(kalman))
    start = time.perf_counter()
    with bar() as say:
        for i, method in enumerate(methods):
            say(named(method), i / len(methods))
            left = None if limit is None else max(limit - (time.perf_counter() - start), 0.0)
            share = None if left is None else 2.0 * left / (len(methods) - i + 1)
            tries.append(in_time(named(method), partial(attempt, method, model, run), share))
    return Choice(model, counted, budget, tuple(tries), yardstick)


def _gentle(model: Plant, kalman: Any, seed: int) -> Scenario:
    """Return the longest gentle scenario that keeps the state in its box, then the least gentle.

    About the nominal state, then about the one that nominal inputs hold.
    """
    about, why = [np.zeros(len(model.x))], ""
    try:
        about.append(equilibrium(model).x - operating_values(model, "x"))
    except DerivationError as error:
        why = f" ({error})"
    for steps in (1000, 300, 100, 50, 25):
        for share, off in product((0.05, 0.02, 0.005), about):
            plain = gentle(model, steps, seed, share)
            scenario = replace(plain, x0=np.add(plain.x0, off), guess=np.add(plain.guess, off))
            try:
                if simulate(model, kalman, scenario, seed).domain.x_inside.all():
                    return scenario
            except SimulationError:
                continue
    raise SimulationError(
        f"{model.name} leaves its box within 25 samples of any gentle scenario{why}: give "
        "scenario= of inputs that keep it there."
    )


def _signals(model: Plant, criterion: str | Sequence[str]) -> tuple[str, ...]:
    """Return the names over which the criterion is averaged."""
    x, f = model.names("x"), model.names("f")
    words = {"faults": f or x, "states": x, "all": (*x, *f)}
    given = (criterion,) if isinstance(criterion, str) else tuple(criterion)
    found = words.get(given[0], given) if len(given) == 1 else given
    if not found or not set(found) <= set(words["all"]):
        raise SimulationError(
            f"criterion={criterion!r}; it takes {', '.join(words)} or names of "
            f"{', '.join(words['all'])}.",
            criterion=criterion,
        )
    return found
