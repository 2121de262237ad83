"""`share`: a session of whatever a researcher has at hand, in one line."""

from __future__ import annotations

import atexit
import dataclasses
import importlib.util
import logging
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

import msgspec
import mujoco

from iris_session.control.config import OUTPUT_CTRL, OUTPUT_TARGETS
from iris_session.protocol.specs import ObjectSpec
from iris_session.session.config import SessionConfig
from iris_session.session.errors import ConfigError, OwnershipError
from iris_session.session.resume import has_free_ports
from iris_session.session.robots import RobotChoice, explain_no_robots
from iris_session.session.session import Session
from iris_session.session.session_base import SessionBase
from iris_session.session.simulation import list_owners, require_simulation, unwrap_data, unwrap_model
from iris_session.session.simulator_session import SimulatorSession
from iris_session.simulators import find_adapter

S = TypeVar("S", bound=SessionBase)

#: How participants drive, and the output of control that this means.
DRIVES: Final = {"ctrl": OUTPUT_CTRL, "action": OUTPUT_TARGETS}

_log = logging.getLogger(__name__)
#: Environments that are shown by `sync`, with their sessions, whose data is their own.
_synced: list[tuple[Any, Session]] = []


def share(
    x: Any,
    data: Any = None,
    config: SessionConfig | None = None,
    *,
    robots: RobotChoice = "auto",
    objects: Sequence[ObjectSpec] | None = None,
    groups: Iterable[int] | None = None,
    sites: bool | Iterable[int] | None = None,
    drive: str = "ctrl",
    step: str = "step",
) -> Session | SimulatorSession:
    """Share a simulation or a model file: participants see it, and drive the robots that are found in it.

    The program stays as it is, and so does its trajectory while no participant drives. A robot about which something
    is unclear is shown all the same: `session.notes` says what, and `session.describe_robots()` has lines for a robots
    file with which it can be driven.

        session = iris_session.share("panda.xml");  session.run()    # a model file, or an MjModel: in our loop
        session = iris_session.share(model, data)                    # your own loop, unchanged
        session = iris_session.share(env)                            # an environment, unchanged
        session = iris_session.share(scene)                          # of Genesis, SAPIEN, ...: docs/simulators.md

    Args:
        x: The path of a model file, an `MjModel` or `MjSpec`, or an environment that simulates with MuJoCo: of
            Gymnasium, dm_control (its physics, too), robosuite, LIBERO, Meta-World, OGBench, MyoSuite, gym-aloha,
            LeRobot. For what steps outside of Python's MuJoCo (MuJoCo Playground, MJX), call `session.sync(data)` after
            its steps.
            Or a simulation of another simulator: a Genesis or SAPIEN scene, a ManiSkill environment, `pybullet` or one
            of its clients, a solver of Newton, a USD stage or file, the `RemoteAPIClient` of CoppeliaSim.
        data: With an `MjModel`: the data that your loop advances. `None`: the session simulates, by `session.run()`.
        config: Settings; `None` for the defaults, on other ports where those are in use. Where rerun is not installed,
            nothing is recorded by default.
        robots: `auto` finds them, `none` offers none; or names of robots found, the path of a robots file, or
            specifications.
        objects: Free bodies that robots and hands can take; `None` finds them in the model.
        groups: Groups of geoms that participants see; `None` for those that the viewer of the suite shows: 0, 1 and 2,
            but not 0 where that has the collision shapes (robosuite).
        sites: Groups of sites that participants see, True for all sites, False for none; `None` for those that MuJoCo's
            viewer shows, 0 to 2.
        drive: `ctrl`: the session writes `data.ctrl` of the robots that participants drive, or moves them by their
            simulator's own control. `action`: it writes nothing; your program asks for the action with
            `session.action(action)` or for `session.targets()`.
        step: Name of the environment's method that advances the simulation.

    Returns:
        The started session, which is a context manager. It ends with `close()`, or with the program. Of a model
        without data it lets participants in from `session.run()` on, or from the first `session.sync(data)`.

    Raises:
        ModelNotFoundError, ModelInvalidError: The file is missing, or MuJoCo does not compile it.
        ConfigError: `x` is nothing that can be shared, or an argument cannot be used.
        SimulatorError: A simulation cannot be shown as it is: not built yet, for example.
        OwnershipError: A session shares this data, or this environment, already.
        StartError: A port is in use, a folder cannot be written, a key is missing.
    """
    if drive not in DRIVES:
        raise ConfigError(f"drive is {drive!r}; it must be one of {', '.join(map(repr, DRIVES))}")
    config, notes = _complete_config(config, DRIVES[drive])
    if type(x).__name__ == "MjSpec":
        x = x.compile()
    given: dict[str, Any] = {"objects": objects, "groups": groups, "sites": sites}
    session: Session | SimulatorSession
    adapter = find_adapter(x)
    if adapter is None:
        session = _share(x, data, config, {"robots": robots, **given}, step)
    elif wrong := [name for name, value in {"data": data, **given}.items() if value is not None]:
        raise ConfigError(f"{wrong[0]} is given with {type(x).__name__}: only worlds of MuJoCo have it, leave it out")
    else:
        session = _start(SimulatorSession(adapter, config, robots=robots, drives=drive == "ctrl"))
    if isinstance(session, Session) and robots in (None, "auto") and not session.robots and not session._robot_notices:
        notes.append(explain_no_robots(session.model))
    session._start_notes = tuple(notes)
    for note in notes:
        _log.warning("%s", note)
    return session


def _complete_config(config: SessionConfig | None, output: str) -> tuple[SessionConfig, list[str]]:
    """Return the configuration with what a machine does not have left out, and notes that say so."""
    notes = []
    if config is None:
        config = SessionConfig()
        if not has_free_ports(config):  # of another session on this machine
            config = dataclasses.replace(config, control_port=0, state_port=0)
            notes.append("the usual ports are in use, by another session perhaps: this one is at session.address")
    elif not isinstance(config, SessionConfig):
        raise TypeError(
            f"config must be a SessionConfig, not {type(config).__name__}: share(x, config=SessionConfig())"
        )
    if config.control.output != output:
        config = dataclasses.replace(config, control=msgspec.structs.replace(config.control, output=output))
    if config.record is True and importlib.util.find_spec("rerun") is None:  # the default, beside a suite
        config = dataclasses.replace(config, record=False)
        notes.append("not recorded, because rerun is not installed: pip install 'iris-session[recording]'")
    return config, notes


def _share(x: Any, data: Any, config: SessionConfig, given: Mapping[str, Any], step: str) -> Session:
    if isinstance(x, str | os.PathLike):
        return _start(Session(Path(x).expanduser(), None, config, **given))
    model = unwrap_model(x)
    if model is not None:
        if data is None:
            return _start(Session(model, None, config, **given))
        return Session.attach(model, unwrap_data(data) or data, config, **given)
    if data is not None:
        raise ConfigError(f"data is given with {type(x).__name__}: give it with an MjModel, as in share(model, data)")
    model, found = require_simulation(x)
    if found is None:
        environment = next(list_owners(x), x)
        _synced[:] = [(one, session) for one, session in _synced if not session._is_closed]
        if any(one is environment for one, _ in _synced):
            raise OwnershipError(f"a session shares this {type(environment).__name__} already: close it first")
        found = mujoco.MjData(model)
        if model.nkey:
            mujoco.mj_resetDataKeyframe(model, found, 0)
        session = _start(Session(model, found, config, **given))
        session.sync(found)  # from here on participants can join
        _synced.append((environment, session))
        return session
    return Session.attach(model, found, config, environment=x, step=step, **given)


def _start(session: S) -> S:
    session.start()
    atexit.register(session.close)  # a script may simply end
    return session
