"""The message definitions as plain data, for the generators of other languages and documents.

Structs are in the order of their definition, fields in the order of the wire. `array_like` structs are MessagePack
arrays, all others maps with the field names as keys.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any, Final, get_args

import msgspec

from iris_session.protocol import (
    assets,
    client_messages,
    common,
    discovery,
    media,
    names,
    scene,
    server_messages,
    status,
)
from tools.codegen import rigid_reference


@dataclass(frozen=True)
class Type:
    """Type of a field. `base`: bool, int, float, str, bytes, array, map, struct, union.

    `item`: of an array, or the value of a map. `length`: of an array of fixed length. `min_length`, `max_length`: 0
    for no limit. `name`: of a struct or union. `optional`: may be null. `minimum`, `maximum`: of an int.
    `pattern`: of a str.
    """

    base: str
    item: Type | None = None
    length: int = 0
    min_length: int = 0
    max_length: int = 0
    name: str = ""
    optional: bool = False
    minimum: int | None = None
    maximum: int | None = None
    pattern: str = ""


@dataclass(frozen=True)
class Field:
    """One field. `enum`: name of the open enumeration that its values come from, or empty."""

    name: str
    type: Type
    required: bool
    default: Any
    enum: str


@dataclass(frozen=True)
class Struct:
    """One struct. `tag_field`, `tag`: empty for structs outside of a union."""

    name: str
    doc: str
    array_like: bool
    tag_field: str
    tag: str
    fields: tuple[Field, ...]
    cls: type[msgspec.Struct]


#: Numbers and texts of the protocol that are no messages.
CONSTANTS: Final[dict[str, int | float | str]] = {
    "PROTOCOL_VERSION": names.PROTOCOL_VERSION,
    "TOPIC_RIGID": server_messages.TOPIC_RIGID.decode(),
    "TOPIC_PRESENCE": server_messages.TOPIC_PRESENCE.decode(),
    "RIGID_FORMAT": rigid_reference.FORMAT,
    "RIGID_LATTICE_M": rigid_reference.LATTICE_M,
    "RIGID_POSITION_BITS": rigid_reference.POSITION_BITS,
    "RIGID_ROTATION_CENTRE": rigid_reference.ROTATION_CENTRE,
    "SCENE_VERSION": names.SCENE_VERSION,
    "MAX_SCENE_BYTES": scene.MAX_SCENE_BYTES,
    "ARRAYS_MAGIC": assets.ARRAYS_MAGIC.decode(),
}

#: Closed unions of tagged structs, by the name used in generated code.
UNIONS: Final[dict[str, tuple[type[msgspec.Struct], ...]]] = {
    "ClientMessage": get_args(client_messages.ClientMessage),
    "ServerMessage": get_args(server_messages.ServerMessage),
    "EventKind": get_args(server_messages.EventKind),
    "PatchOp": get_args(scene.PatchOp),
}

#: Groups of structs in the order of the document.
GROUPS: Final[dict[str, tuple[type[msgspec.Struct], ...]]] = {
    "values": (
        common.Pose,
        common.Target,
        common.Lease,
        common.Denial,
        common.Alignment,
        common.Applied,
        server_messages.Endpoints,
        server_messages.ParticipantInfo,
        server_messages.ActuatorInfo,
        server_messages.RobotInfo,
        server_messages.BodyInfo,
        server_messages.AnchorMark,
        server_messages.AnchorInfo,
        status.Quantiles,
        media.StreamCamera,
        media.StreamInfo,
        media.StreamBudget,
        status.AnchorSeen,
        status.AlignmentReport,
        status.CrossCheckReport,
        status.UnverifiedReport,
        status.AnchorReport,
        status.StopReport,
        status.ParticipantReport,
        status.RobotReport,
        status.RecorderReport,
        status.MediaStreamReport,
        status.AssetsReport,
    ),
    "client": UNIONS["ClientMessage"],
    "server": UNIONS["ServerMessage"],
    "events": UNIONS["EventKind"],
    "frames": (
        client_messages.ClientEnvelope,
        server_messages.ServerEnvelope,
        server_messages.StateHeader,
        server_messages.PresenceItem,
        server_messages.Presence,
        server_messages.RobotState,
        server_messages.RobotStates,
        media.MediaHeader,
        media.MediaPush,
        assets.AssetRequest,
        assets.AssetChunk,
        assets.AssetRefused,
        discovery.Beacon,
        discovery.Introduction,
    ),
    "scene": (
        scene.SceneSpec,
        scene.Body,
        scene.Visual,
        scene.Geometry,
        scene.Material,
        scene.TextureUse,
        scene.Texture,
        scene.TextureLevel,
        scene.Mesh,
        scene.MeshLevel,
        scene.HeightField,
        scene.Light,
        scene.Camera,
        scene.Site,
        scene.Tendon,
        scene.Deformable,
        scene.Environment,
        scene.Headlight,
        scene.Totals,
    ),
    "arrays": (assets.ArrayHeader, assets.ArrayInfo),
    "patch": UNIONS["PatchOp"],
}

#: Open enumeration of the values of a field.
_ENUMS: Final[dict[str, str]] = {
    "Hello.role": "Role",
    "Hello.devices": "Device",
    "Hello.alignment": "AlignmentKind",
    "Sample.device": "Device",
    "Sample.kind": "SampleKind",
    "SetMode.mode": "LeaseMode",
    "Grasp.device": "Device",
    "Align.action": "AlignAction",
    "Observation.kind": "AnchorKind",
    "Observation.device": "Device",
    "Observation.source": "ObservationSource",
    "TipCalibrated.device": "Device",
    "Episode.action": "EpisodeAction",
    "EpisodeChanged.state": "EpisodeState",
    "EpisodeChanged.verdict": "EpisodeState",
    "Control.action": "ControlAction",
    "Target.kind": "TargetKind",
    "Lease.kind": "TargetKind",
    "Lease.mode": "LeaseMode",
    "Denial.reason": "DenialReason",
    "Alignment.kind": "AlignmentKind",
    "AlignmentAlarmed.kind": "AlarmKind",
    "AlignmentReport.alarm": "AlarmKind",
    "AlignmentReport.doubt": "AlignmentDoubt",
    "Applied.device": "Device",
    "ParticipantInfo.role": "Role",
    "ParticipantInfo.devices": "Device",
    "SetRole.role": "Role",
    "Welcome.kind": "SessionKind",
    "Welcome.role": "Role",
    "Refused.code": "RefusalCode",
    "ProtocolFault.code": "FaultCode",
    "Feedback.state": "CommandKind",
    "Feedback.hold_reason": "HoldReason",
    "ObjectGrasped.device": "Device",
    "SamplesRejected.device": "Device",
    "SamplesRejected.reason": "RejectReason",
    "PresenceItem.device": "Device",
    "Beacon.kind": "SessionKind",
    "Paired.roles": "Role",
    "Audited.kind": "AuditKind",
    "DeliveryBudget.budget_class": "BudgetClass",
    "StreamInfo.audience": "StreamAudience",
    "StreamInfo.fault": "StreamFault",
    "StreamBudget.budget_class": "BudgetClass",
    "StreamBudget.encoding": "MediaEncoding",
    "StreamBudget.audience": "StreamAudience",
    "StreamBudget.fault": "StreamFault",
    "MediaHeader.budget_class": "BudgetClass",
    "MediaHeader.encoding": "MediaEncoding",
    "MediaPush.classes": "BudgetClass",
    "MediaPush.encoding": "MediaEncoding",
    "AssetRefused.reason": "AssetRefusal",
    "ParticipantReport.role": "Role",
    "ParticipantReport.alignment": "AlignmentKind",
    "ParticipantReport.budget_class": "BudgetClass",
    "MediaStreamReport.encoding": "MediaEncoding",
    "MediaStreamReport.audience": "StreamAudience",
    "MediaStreamReport.fault": "StreamFault",
    "RobotReport.mode": "LeaseMode",
    "RobotReport.state": "CommandKind",
    "RobotReport.hold_reason": "HoldReason",
    "Geometry.kind": "GeometryKind",
    "TextureUse.role": "TextureRole",
    "Texture.kind": "TextureKind",
    "Texture.colorspace": "ColorSpace",
    "TextureLevel.encoding": "AssetEncoding",
    "MeshLevel.encoding": "AssetEncoding",
    "HeightField.encoding": "AssetEncoding",
    "Light.kind": "LightKind",
    "Light.follow": "Follow",
    "Camera.follow": "Follow",
    "Deformable.encoding": "AssetEncoding",
    "ArrayHeader.kind": "ArrayKind",
    "ArrayInfo.name": "ArrayName",
    "ArrayInfo.filter": "ArrayFilter",
    "ArrayInfo.codec": "ArrayCodec",
}

_SCALARS: Final[dict[type[msgspec.inspect.Type], str]] = {
    msgspec.inspect.BoolType: "bool",
    msgspec.inspect.FloatType: "float",
}


def list_structs(group: str) -> tuple[Struct, ...]:
    """Return the structs of one of `GROUPS`."""
    return tuple(_describe_struct(cls) for cls in GROUPS[group])


@cache
def list_all_structs() -> tuple[Struct, ...]:
    """Return every struct of the wire, each once."""
    return tuple(struct for group in GROUPS for struct in list_structs(group))


def list_enums() -> dict[str, dict[str, str]]:
    """Return the open enumerations: name -> constant -> value, in the order of their definition."""
    return {
        name: {key: text for key, text in vars(kind).items() if key.isupper() and isinstance(text, str)}
        for name, kind in _list_enum_classes().items()
    }


def find_enum_doc(name: str) -> str:
    """Return the docstring of an open enumeration, unindented, or empty."""
    return inspect.getdoc(_list_enum_classes()[name]) or ""


def _list_enum_classes() -> dict[str, type]:
    return {
        name: value
        for name, value in vars(names).items()
        if isinstance(value, type) and value.__module__ == names.__name__
    }


def _describe_struct(cls: type[msgspec.Struct]) -> Struct:
    info = msgspec.inspect.type_info(cls)
    assert isinstance(info, msgspec.inspect.StructType)
    return Struct(
        name=cls.__name__,
        doc=_clean_doc(cls),
        array_like=info.array_like,
        tag_field=info.tag_field or "",
        tag=str(info.tag) if info.tag_field else "",
        fields=tuple(_describe_fields(cls, info)),
        cls=cls,
    )


def _clean_doc(cls: type[msgspec.Struct]) -> str:
    """Return the docstring of `cls` itself (not of its base), unindented."""
    return inspect.cleandoc(cls.__doc__) if cls.__doc__ else ""


def _describe_fields(cls: type[msgspec.Struct], info: msgspec.inspect.StructType) -> Iterator[Field]:
    for field in info.fields:
        default = field.default
        if field.default_factory is not msgspec.NODEFAULT:
            default = field.default_factory()
        enum = _ENUMS.get(f"{cls.__name__}.{field.encode_name}", "")
        yield Field(field.encode_name, _describe_type(field.type), field.required, default, enum)


def _describe_type(node: msgspec.inspect.Type) -> Type:
    scalar = _SCALARS.get(type(node))
    if scalar:
        return Type(scalar)
    match node:
        case msgspec.inspect.IntType():
            return Type("int", minimum=node.ge, maximum=node.le)
        case msgspec.inspect.StrType():
            return Type("str", max_length=node.max_length or 0, pattern=node.pattern or "")
        case msgspec.inspect.BytesType():
            return Type("bytes", max_length=node.max_length or 0)
        case msgspec.inspect.TupleType():
            items = [_describe_type(item) for item in node.item_types]
            if items.count(items[0]) == len(items):
                return Type("array", item=items[0], length=len(items))
        case msgspec.inspect.VarTupleType():
            item = _describe_type(node.item_type)
            return Type("array", item=item, min_length=node.min_length or 0, max_length=node.max_length or 0)
        case msgspec.inspect.DictType():
            return Type("map", item=_describe_type(node.value_type))
        case msgspec.inspect.StructType():
            return Type("struct", name=node.cls.__name__)
        case msgspec.inspect.UnionType():
            return _describe_union(node)
    raise TypeError(
        f"{node} has no form in the schema: use bool, int, float, str, bytes, dict, a Struct or a tuple of one type"
    )


def _describe_union(node: msgspec.inspect.UnionType) -> Type:
    members = [member for member in node.types if not isinstance(member, msgspec.inspect.NoneType)]
    if len(members) == 1:
        inner = _describe_type(members[0])
        return Type(**{**vars(inner), "optional": True})
    classes = {member.cls for member in members if isinstance(member, msgspec.inspect.StructType)}
    for name, union in UNIONS.items():
        if classes == set(union):
            return Type("union", name=name)
    raise TypeError(f"{node} is none of the unions {', '.join(UNIONS)}")
