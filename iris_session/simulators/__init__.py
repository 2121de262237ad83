"""Other simulators: adapters that show their scenes and move their robots, one file each."""

from iris_session.simulators.adapter import Adapter, SimulationState, TipTarget
from iris_session.simulators.find import find_adapter
from iris_session.simulators.wrapping import SimulatorError

__all__ = ["Adapter", "SimulationState", "SimulatorError", "TipTarget", "find_adapter"]
