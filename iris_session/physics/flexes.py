"""Deformables (MuJoCo's flexes) as others see them: names, where their vertices are, and who touches them.

Contacts of flexes have no geom on the side of the flex; they count as in `contacts`, within `includemargin`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.physics.contacts import ContactTables
from iris_session.physics.errors import UnknownNameError
from iris_session.physics.names import element_name
from iris_session.protocol.specs import RobotSpec


class Flexes:
    """The deformables of one world. `names`: by id, `flex_N` where the model has none."""

    def __init__(self, model: mujoco.MjModel, data: Any, robots: Sequence[RobotSpec], tables: ContactTables) -> None:
        self._model, self._data = model, data
        self.names = tuple(element_name(model, "flex", f) or f"flex_{f}" for f in range(model.nflex))
        self._id = {name: index for index, name in enumerate(self.names)}
        starts, counts = model.flex_vertadr.tolist(), model.flex_vertnum.tolist()
        self._rows = [slice(start, start + count) for start, count in zip(starts, counts, strict=True)]
        self._robot_names = tuple(robot.name for robot in robots)
        robot_of_body = np.array(tables.body_robot, np.int64)
        #: Robot of each geom; the last one, which the geom -1 of a flex hits, is nobody's.
        self._geom_robot: NDArray[np.int64] = np.append(robot_of_body[model.geom_bodyid], -1)

    def vertices(self, name: str) -> NDArray[np.float64]:
        """World positions of all vertices after the last tick [m], shape (n, 3), in the order of the model. A copy."""
        try:
            rows = self._rows[self._id[name]]
        except KeyError:
            raise UnknownNameError("deformable", name, self._id) from None
        positions: NDArray[np.float64] = self._data.flexvert_xpos[rows].copy()
        return positions

    def touching(self, name: str) -> tuple[str, ...]:
        """The robots of which any geom touches it, in the order of the robots."""
        if name not in self._id:
            raise UnknownNameError("deformable", name, self._id)
        contact = self._data.contact
        mine = (contact.flex == self._id[name]).any(axis=1) & (contact.dist < contact.includemargin)
        found = np.unique(self._geom_robot[contact.geom[mine]]).tolist()
        return tuple(self._robot_names[robot] for robot in found if robot >= 0)
