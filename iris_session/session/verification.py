"""`verify_recording`: builds a core from a recording's header and re-simulates its journal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import msgspec

from anchors.ageing import AgeingLaw
from iris_session.authority import AuthorityConfig, is_same_snapshot
from iris_session.control import ControlConfig
from iris_session.control.config import SOLVER_AUTO, SOLVER_MINK
from iris_session.journal.environment import use_one_blas_thread
from iris_session.journal.rows import SNAPSHOTS
from iris_session.journal.verification import Models
from iris_session.physics import decode_model
from iris_session.protocol.entries import Entry
from iris_session.recording import Keyframe, SessionHeader, VerifyReport, unpack_model, verify
from iris_session.session.core import CoreConfig, CoreState, SessionCore


class _RecordedAuthorityConfig(AuthorityConfig, frozen=True):
    """Configuration in the header of a recording: laws that it does not name were not in force when it was made."""

    doubts: bool = False
    ageing: AgeingLaw | None = None
    verify_pairs: bool = False
    min_change_share: float = 1e9
    explains: bool = False
    episode_rules: bool = False
    strict_episodes: bool = False
    self_rename: bool = False


class _RecordedControlConfig(ControlConfig, frozen=True):
    compensate_sag: bool = False
    few_joints_orientation_cost: float | None = None
    target_grippers: bool = False
    proximity_per_joint: bool = False
    proximity_stopped: bool = False


#: Settings of control that recordings got later; what one of them does not name was off when it was made.
NEWER_CONTROL: Final = ("solver", *_RecordedControlConfig.__annotations__)


class _RecordedConfig(CoreConfig, frozen=True):
    authority: _RecordedAuthorityConfig
    control: _RecordedControlConfig


def decode_recorded_config(header_config: bytes) -> CoreConfig:
    """Return the configuration in the header of a recording. Raises `msgspec.DecodeError` for other bytes."""
    config = msgspec.msgpack.decode(header_config, type=_RecordedConfig)
    if config.control.solver == SOLVER_AUTO:  # not in the header: there was only one
        config = msgspec.structs.replace(config, control=msgspec.structs.replace(config.control, solver=SOLVER_MINK))
    return config


class ReplayCore:
    """A `SessionCore` as `recording.verify` drives it."""

    def __init__(self, header: SessionHeader, models: Models) -> None:
        use_one_blas_thread()
        config = decode_recorded_config(header.config)
        model = decode_model(unpack_model(header.model))
        self.core = SessionCore(model, config, lambda model_hash: decode_model(models(model_hash)))

    def step(self, now_ns: int, entries: Sequence[Entry], n_ticks: int, plant: bytes = b"") -> bytes:
        """Take one step and return its digest."""
        return self.core.step(now_ns, entries, n_ticks, plant).digest

    def restore(self, keyframe: Keyframe) -> None:
        """Restore the state after the step of a keyframe."""
        self.core.restore(CoreState(keyframe.plant, keyframe.authority, keyframe.controller, keyframe.status))

    def find_differences(self, keyframe: Keyframe) -> list[str]:
        """Return the names of the snapshots in `keyframe` that are not those of the present state."""
        state = self.core.snapshot()
        other = [name for name in SNAPSHOTS if getattr(state, name) != getattr(keyframe, name)]
        if "authority" in other and is_same_snapshot(keyframe.authority, state.authority):
            other.remove("authority")
        return other


def verify_recording(path: Path, progress: Callable[[int, int], None] | None = None) -> VerifyReport:
    """Re-simulate every step of a recording.

    Args:
        path: First file of the recording.
        progress: Called with the number of steps done and of all steps.

    Raises:
        RecordingError: The recording cannot be read at all.
    """
    use_one_blas_thread()  # before versions are compared: threads that are not used here are no difference
    return verify(path, ReplayCore, progress)
