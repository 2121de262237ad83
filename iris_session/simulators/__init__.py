"""Other simulators: adapters that show their scenes and move their robots, one file each."""

from iris_session.simulators.adapter import Adapter, SimulationState, SimulatorError, TipTarget
from iris_session.simulators.find import find_adapter

__all__ = ["Adapter", "SimulationState", "SimulatorError", "TipTarget", "find_adapter"]
