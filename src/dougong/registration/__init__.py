"""Registration: a search, then a proof.

Names are loaded when they are first used: Numba is not imported with the parameter models of
other rooms. (`register` the function lives in `pair`, so that no module hides it.)
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dougong.registration.document import registration_to_json
    from dougong.registration.free_rotation import (
        FreeRotation,
        ObjectRegistration,
        register_object,
    )
    from dougong.registration.icp import Icp, refine
    from dougong.registration.pair import register
    from dougong.registration.prepare import Prepare, Prepared
    from dougong.registration.result import FineResult, Hypothesis, Registration
    from dougong.registration.settings import Register

_HOME = {
    "FineResult": "result",
    "FreeRotation": "free_rotation",
    "Hypothesis": "result",
    "Icp": "icp",
    "ObjectRegistration": "free_rotation",
    "Prepare": "prepare",
    "Prepared": "prepare",
    "Register": "settings",
    "Registration": "result",
    "refine": "icp",
    "register": "pair",
    "register_object": "free_rotation",
    "registration_to_json": "document",
}

__all__ = [
    "FineResult",
    "FreeRotation",
    "Hypothesis",
    "Icp",
    "ObjectRegistration",
    "Prepare",
    "Prepared",
    "Register",
    "Registration",
    "refine",
    "register",
    "register_object",
    "registration_to_json",
]


def __getattr__(name: str) -> Any:
    """Import the module of a public `name` when it is first asked for."""
    if name not in _HOME:
        msg = f"module 'dougong.registration' has no attribute {name!r}"
        raise AttributeError(msg)
    value = getattr(import_module(f"dougong.registration.{_HOME[name]}"), name)
    globals()[name] = value
    return value
