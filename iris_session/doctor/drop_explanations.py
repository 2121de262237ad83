"""What the reasons of drops mean, for people. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

#: Of those that are most, how many are told.
MAX_LISTED: Final = 6
_SLOW: Final = "to who did not read in time"
_FAST: Final = "from who sends faster than the session takes it"
_DISK: Final = "not recorded: the recorder did not keep up"
_PAIRING: Final = "pairing refused, see the session's terminal"
_ODD: Final = "from who breaks the protocol"
EXPLANATIONS: Final[Mapping[str, str]] = {
    "send_queue_full": f"answers and events {_SLOW}",
    "media_superseded": f"frames of media {_SLOW}, newer ones took their place",
    "state_superseded": "states that the front was too late for, newer ones went out",
    "state_to_front": "states that the front did not take",
    "state_of_other_scene": "states that came as the scene changed",
    "samples_pending": _FAST,
    "devices_pending": _FAST,
    "messages_pending": _FAST,
    "urgent_pending": _FAST,
    "rate": _FAST,
    "flood": "connections that sent far too much, refused",
    "flood_cut": "connections that sent far too much, closed",
    "audit_lost": "records of who was let in or refused",
    "malformed": _ODD,
    "too_large": _ODD,
    "report_not_finite": _ODD,
    "decision_invalid": "too large for any client",
    "unversioned_peer": "connections that are no client: a browser, a port scan",
    "unknown_key": "connections with a key that is not on the list",
    "unpaired": "from keys that are not on the list",
    "not_admitted": "from who was not let in yet",
    "pair_refused": _PAIRING,
    "pair_rate": _PAIRING,
    "pair_shut_out": _PAIRING,
    "pair_busy": "pairing put off, it is asked for again",
    "observation_before_jump": "anchors seen before a headset's frame jumped",
    "observation_unusable": "anchors seen too far away, or that the session does not know",
    "alarms_repeated": "alarms of headsets that were told already",
    "beacon_unsent": "the network takes no broadcasts here",
    "allow_list_unreadable": "the list of keys cannot be read: the one before counts",
    "certificate_unusable": "a key file cannot be used",
    "close_failed": "connections that the system did not close",
    "memory": "connections closed, as the front's memory ran short",
    "memory_elsewhere": "media held back, as the front's memory ran short",
    "recorder_queue_full": _DISK,
    "journal_rows": _DISK,
    "recorded_items": _DISK,
    "recorded_vertices": "frames of what bends that the recording is without",
}

#: Why a request for a piece of the scene was not answered: the reasons are those of the protocol.
_ASSET_PREFIX: Final = "assets_"
_ASSETS: Final = "requests for pieces of the scene that were refused"


def explain_drops(drops: Mapping[str, int]) -> str:
    """The most frequent ones with what they mean; empty for none."""
    most = sorted(((n, reason) for reason, n in drops.items() if n), reverse=True)[:MAX_LISTED]
    return ", ".join(f"{reason} {n}{_explain_reason(reason)}" for n, reason in most)


def _explain_reason(reason: str) -> str:
    meaning = EXPLANATIONS.get(reason, _ASSETS if reason.startswith(_ASSET_PREFIX) else "")
    return f" ({meaning})" if meaning else ""
