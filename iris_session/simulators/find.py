"""`find_adapter`: the adapter for a simulation, by the package that its type comes from."""

from __future__ import annotations

from importlib import import_module
from os import PathLike, fspath
from types import ModuleType
from typing import Any, Final

from iris_session.simulators.adapter import Adapter

#: Package of a type -> module of the adapter and its class.
_ADAPTERS: Final = {
    "genesis": ("genesis", "GenesisAdapter"),
    "sapien": ("sapien", "SapienAdapter"),
    "mani_skill": ("sapien", "SapienAdapter"),
    "pybullet": ("pybullet", "PyBulletAdapter"),
    "pybullet_utils": ("pybullet", "PyBulletAdapter"),
    "newton": ("newton", "NewtonAdapter"),
    "pxr": ("usd", "UsdAdapter"),
    "coppeliasim_zmqremoteapi_client": ("coppeliasim", "CoppeliaAdapter"),
}
#: Attributes by which environments hold what they wrap: Gymnasium, then what benchmark suites call it.
_INSIDE: Final = ("unwrapped", "env", "_env")
_USD_SUFFIXES: Final = (".usd", ".usda", ".usdc", ".usdz")


def find_adapter(simulation: Any) -> Adapter | None:
    """Return the adapter for a simulation. Imports no simulator but the one that `simulation` is of.

    Args:
        simulation: An object of a simulator, its module, an environment that holds one, or the path of a USD file.

    Returns:
        `None` for an object of no known simulator.

    Raises:
        SimulatorError: An object of a known simulator that is not the one to give; the message says which is.
    """
    if isinstance(simulation, str | PathLike):
        is_stage = fspath(simulation).lower().endswith(_USD_SUFFIXES)
        return _make_adapter("pxr", simulation) if is_stage else None
    for candidate in (simulation, *(getattr(simulation, name, None) for name in _INSIDE)):
        package = _find_package(candidate)
        if package in _ADAPTERS:
            return _make_adapter(package, candidate)
    return None


def _find_package(candidate: Any) -> str:
    """Return the name of the package that an object, a type or a module comes from."""
    if isinstance(candidate, ModuleType):
        return candidate.__name__.split(".")[0]
    kind = candidate if isinstance(candidate, type) else type(candidate)
    return str(kind.__module__).split(".")[0]


def _make_adapter(package: str, simulation: Any) -> Adapter:
    module, name = _ADAPTERS[package]
    adapter: Adapter = getattr(import_module(f"iris_session.simulators.{module}"), name)(simulation)
    return adapter
