"""Explanations of the reasons of drops. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

#: Listed are the most frequent reasons, at most this many.
MAX_LISTED: Final = 6
_SLOW: Final = "the receiver did not read in time"
_FAST: Final = "the sender is faster than the session accepts"
_KEY: Final = "one key sends or causes more than the session accepts, over all its connections"
_DISK: Final = "not recorded: the recorder did not keep up"
_PAIRING: Final = "pairing refused, see the session's terminal"
_ODD: Final = "protocol violation"
EXPLANATIONS: Final[Mapping[str, str]] = {
    "send_queue_full": f"answers and events: {_SLOW}",
    "media_superseded": f"media frames replaced by newer ones: {_SLOW}",
    "state_superseded": "states replaced by newer ones: the front was late",
    "state_to_front": "states that the front did not accept",
    "state_of_other_scene": "states received during a change of the scene",
    "samples_pending": _FAST,
    "devices_pending": _FAST,
    "messages_pending": _FAST,
    "urgent_pending": _FAST,
    "rate": _FAST,
    "flood": "connections refused because they sent far too much",
    "flood_cut": "connections closed because they sent far too much",
    "key_messages": _KEY,
    "key_bytes": _KEY,
    "key_requests": _KEY,
    "key_events": _KEY,
    "key_connections": "connections refused of keys that open too many",
    "key_banned": "connections refused of keys that sent far too much a moment ago",
    "estops_merged": "e-stops merged with the next one of the same key",
    "state_topic_unknown": "subscriptions to topics that do not exist",
    "state_closed_early": "connections to the state that ended before they subscribed to anything",
    "subscribers_too_many": "connections to the state closed because their key had too many",
    "media_source_refused": "media of keys without the role camera or source",
    "media_flood": "connections to media closed because they sent more than was read",
    "media_too_many": "connections to media closed because their key had too many",
    "audit_lost": "audit records of admissions and refusals",
    "malformed": _ODD,
    "too_large": _ODD,
    "report_not_finite": _ODD,
    "decision_invalid": "decisions too large for any client",
    "unversioned_peer": "connections of other programs: a browser, a port scan",
    "unknown_key": "connections with a key that is not on the list",
    "unpaired": "messages from keys that are not on the list",
    "not_admitted": "messages of participants that were not admitted yet",
    "pair_refused": _PAIRING,
    "pair_rate": _PAIRING,
    "pair_shut_out": _PAIRING,
    "pair_busy": "pairing postponed; the client asks again",
    "observation_before_jump": "observations from before a jump of the tracking frame",
    "observation_unusable": "observations of anchors that are too far away or unknown to the session",
    "observation_waiting": f"observations of anchors: {_FAST}",
    "alarms_repeated": "repeated alarms of headsets",
    "beacon_unsent": "the network does not send broadcasts",
    "allow_list_unreadable": "the list of keys cannot be read; the previous list is used",
    "certificate_unusable": "a key file cannot be used",
    "close_failed": "connections that the operating system did not close",
    "memory": "connections closed because the front's memory limit was reached",
    "media_memory": "media not sent because the front's memory limit was reached",
    "memory_elsewhere": "the front's memory limit was reached, and no connection held much",
    "recorder_queue_full": _DISK,
    "raw_key_share": f"raw samples that are not recorded: {_FAST}",
    "raw_total_share": "raw samples that are not recorded: all senders together are faster than the session accepts",
    "observer_request_share": f"requests of observers: {_FAST}",
    "presence_share": f"samples of observers: {_FAST}",
    "recorded_samples": "raw samples that are not recorded: disk slow or nearly full, the journal is whole",
    "allow_list_missing": "the list of keys was missing; its keys counted for two more seconds",
    "journal_rows": _DISK,
    "recorded_items": _DISK,
    "recorded_vertices": "frames of deformables that are missing in the recording",
}

#: Prefix of refused asset requests; what follows is a reason of the protocol.
_ASSET_PREFIX: Final = "assets_"
_ASSETS: Final = "refused requests for assets"


def explain_drops(drops: Mapping[str, int]) -> str:
    """Return the most frequent reasons with their explanations; empty for no drops."""
    most = sorted(((n, reason) for reason, n in drops.items() if n), reverse=True)[:MAX_LISTED]
    return ", ".join(f"{reason} {n}{_explain_reason(reason)}" for n, reason in most)


def _explain_reason(reason: str) -> str:
    meaning = EXPLANATIONS.get(reason, _ASSETS if reason.startswith(_ASSET_PREFIX) else "")
    return f" ({meaning})" if meaning else ""
