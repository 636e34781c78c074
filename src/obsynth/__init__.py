"""obsynth: from a plant's equations to a proven fault-estimating observer in C.

By convention ``import obsynth as ob``. The public names are loaded on first
use, so that importing the package costs next to nothing.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from obsynth.symbolic import Plant as Plant

__version__ = "0.1.0"

_HOME = {
    "Plant": "obsynth.symbolic",
}

_MODULES = {"plants": "obsynth.symbolic.plants", "scenarios": "obsynth.symbolic.scenarios"}

__all__ = ["Plant", "__version__", "plants", "scenarios"]


def __getattr__(name: str) -> Any:
    """Load a public name from its room on first use (PEP 562)."""
    if name in _MODULES:
        value = importlib.import_module(_MODULES[name])
    elif name in _HOME:
        value = getattr(importlib.import_module(_HOME[name]), name)
    else:
        raise AttributeError(f"module 'obsynth' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(__all__))
