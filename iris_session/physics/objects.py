"""Objects: the free bodies of a scene that people and robots can take."""

from __future__ import annotations

import mujoco

from iris_session.physics.names import element_names, wire_name
from iris_session.physics.tree import Tree
from iris_session.protocol.specs import ObjectSpec


def find_objects(model: mujoco.MjModel) -> tuple[ObjectSpec, ...]:
    """Free bodies that nothing drives, by body id. A free body with an actuated joint in its subtree is a robot.

    An object is asked for by its name, so a free body without one (or with more than 64 characters) is streamed, but
    is no object.
    """
    tree = Tree(model)
    names = element_names(model, "body")
    objects = []
    for body in tree.free_bodies:
        driven = any(tree.actuators_of_joint[j] for b in tree.subtree(body) for j in tree.joints_of(b))
        if not driven and wire_name(names[body]):
            objects.append(ObjectSpec(name=names[body], body=names[body]))
    return tuple(objects)
