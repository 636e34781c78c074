"""obsynth: from a plant's equations to a proven fault-estimating observer in C.

By convention ``import obsynth as ob``. The public names stand in ``__init__.pyi`` and are
loaded on first use, so that importing the package costs next to nothing.
"""

from importlib import import_module

import lazy_loader

__version__ = "0.2.0"

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    """Load a public name, and with it what `Plant.discretise` encloses remainders by."""
    value = _load(name)
    import_module("obsynth.derive.remainder.enclosure")
    return value
