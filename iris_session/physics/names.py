"""Names of model elements: MuJoCo allows none at all, the wire needs one for everything, at most 64 characters.

Unnamed bodies get `body_<id>`, which is stable for a model; a generated or shortened name that is already taken gets
`~2`, `~3`, ... Joints, actuators and sites without a usable name are called `#` and their number: `#7`.
"""

from __future__ import annotations

from typing import Final

import mujoco

from iris_session.physics.errors import UnknownNameError

#: Longest name on the wire (`protocol.common.Name`).
MAX_NAME: Final = 64

_TYPES: Final = {
    kind: (int(getattr(mujoco.mjtObj, f"mjOBJ_{constant}")), count)
    for kind, constant, count in (
        ("body", "BODY", "nbody"),
        ("joint", "JOINT", "njnt"),
        ("actuator", "ACTUATOR", "nu"),
        ("site", "SITE", "nsite"),
        ("keyframe", "KEY", "nkey"),
        ("flex", "FLEX", "nflex"),
    )
}


def get_element_name(model: mujoco.MjModel, kind: str, index: int) -> str:
    """Return the name in the model, empty when it has none. `kind`: body, joint, actuator, site, keyframe or flex."""
    return mujoco.mj_id2name(model, _TYPES[kind][0], index) or ""


def list_element_names(model: mujoco.MjModel, kind: str) -> tuple[str, ...]:
    """Return all names of one kind, by id; empty strings for unnamed elements."""
    return tuple(get_element_name(model, kind, i) for i in range(getattr(model, _TYPES[kind][1])))


def find_element_id(model: mujoco.MjModel, kind: str, name: str, where: str = "") -> int:
    """Return the id of an element by its name, as `get_reference` and `list_body_names` have it.

    Raises `UnknownNameError` with the available names; `where` begins its text.
    """
    index = int(mujoco.mj_name2id(model, _TYPES[kind][0], name)) if name else -1
    if index < 0 and kind == "body" and name in (names := list_body_names(model)):
        index = names.index(name)
    elif index < 0:
        index = parse_number(name, getattr(model, _TYPES[kind][1]))
    if index < 0:
        raise UnknownNameError(kind, name, (n for n in list_element_names(model, kind) if n), where)
    return index


def get_reference(model: mujoco.MjModel, kind: str, index: int) -> str:
    """Return what `find_element_id` finds the element by: its name, or `#7` where it has none that fits the wire."""
    name = get_element_name(model, kind, index)
    return name if is_wire_name(name) else f"#{index}"


def parse_number(reference: str, count: int) -> int:
    """Return the number of a reference like `#7` to one of `count` elements, -1 for anything else."""
    digits = reference[1:]
    if not (reference.startswith("#") and digits.isascii() and digits.isdigit() and int(digits) < count):
        return -1
    return int(digits)


def list_body_names(model: mujoco.MjModel) -> tuple[str, ...]:
    """Return a unique name of at most 64 characters for every body, by id. Named bodies keep theirs."""
    given = list_element_names(model, "body")
    taken = {name for name in given if name and len(name) <= MAX_NAME}
    names = []
    for index, name in enumerate(given):
        if name and len(name) <= MAX_NAME:
            names.append(name)
            continue
        unique = stem = (name or f"body_{index}")[:MAX_NAME]
        number = 1
        while unique in taken:
            number += 1
            suffix = f"~{number}"
            unique = stem[: MAX_NAME - len(suffix)] + suffix
        taken.add(unique)
        names.append(unique)
    return tuple(names)


def is_wire_name(name: str) -> bool:
    """Return true when a name fits the wire as it is."""
    return 0 < len(name) <= MAX_NAME
