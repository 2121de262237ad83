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
_WEB_FULL: Final = "web gateway: connections closed because there were too many"
#: Counted by the web gateway.
WEB_EXPLANATIONS: Final[Mapping[str, str]] = {
    "web_accept": "web gateway: the system gave no connection (ulimit -n)",
    "web_asset_hash": "web gateway: assets that came with other bytes, twice",
    "web_asset_malformed": "web gateway: answers about assets that fit no request",
    "web_asset_slow": "web gateway: downloads of assets that were not read",
    "web_asset_unknown": "web gateway: requests for assets that the session does not serve",
    "web_assets_at_once": "web gateway: requests for more assets at once than one client may have",
    "web_connections": _WEB_FULL,
    "web_connections_per_address": _WEB_FULL,
    "web_evicted": "web gateway: clients that had not joined closed for others",
    "web_handshake_rate": "web gateway: connections of addresses that open too many",
    "web_request_rate": "web gateway: requests of addresses that make too many",
    "web_fault": "web gateway: a fault of its own, see its log",
    "web_flood": "web gateway: clients that sent far too much",
    "web_full": "web gateway: clients above the number that it takes",
    "web_gateway_only": "web gateway: clients that spoke in another name",
    "web_handshake": "web gateway: connections without a handshake of TLS: a certificate that is not trusted",
    "web_body": "web gateway: requests with a body, which no request of the page has",
    "web_host": "web gateway: requests under a name that is not this machine's: use its address",
    "web_identity": "web gateway: clients that said hello with another secret on the same WebSocket",
    "web_idle": "web gateway: connections that sent no request",
    "web_malformed": "web gateway: messages that are none",
    "web_no_hello": "web gateway: clients that did not join in time",
    "web_origin": "web gateway: requests by pages of other sites",
    "web_pair_rate": "web gateway: clients closed because their address tried to pair too often",
    "web_plain": "web gateway: http:// where https:// is needed; the browser was sent there",
    "web_session_full": "web gateway: clients closed because the session did not read",
    "web_silent": "web gateway: clients that sent no heartbeats",
    "web_subprotocol": "web gateway: WebSockets of another version, or of other programs",
    "web_ticket": "web gateway: requests without a valid ticket",
    "web_too_large": "web gateway: messages that are larger than the session takes",
    "web_too_slow": "web gateway: clients closed because they read nothing for seconds",
    "web_unknown_name": "web gateway: messages for clients that had closed",
    "web_version": "web gateway: clients of another protocol version",
}
EXPLANATIONS: Final[Mapping[str, str]] = {
    **WEB_EXPLANATIONS,
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
    "subscribers_too_many": "connections to the state closed because their key had too many",
    "media_newest_rate": "newest frames sent later to clients that subscribe over and over",
    "media_info_malformed": "descriptions of media streams with values out of range; their frames were taken",
    "media_stream_taken": "media of a source under the name of a stream that another one sends",
    "media_source_left": "last frames of media sources that have left the session",
    "media_source_refused": "media of keys without the role camera or source",
    "media_flood": "connections to media closed because they sent more than was read, or what is no subscription",
    "media_order_lost": "connections to media closed, to subscribe again, since another sent what is no subscription",
    "media_backoff": "connections to media refused of keys that sent more than was read before",
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
    "observation_unusable": "observations of anchors that are too far away, 5 s old, or unknown to the session",
    "observation_waiting": f"observations of anchors: {_FAST}",
    "tip_superseded": "poses of a tip, before those that came earlier were solved",
    "tip_waiting": "poses of the tips of more devices than are solved at a time",
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
    "recorded_samples": "raw samples that are not recorded: disk slow, or it or the budget nearly full; journal whole",
    "recorded_assets": "meshes and textures that are not recorded: `iris-session recording inspect` says why",
    "allow_list_missing": "the list of keys was missing; its keys counted for two more seconds",
    "journal_rows": _DISK,
    "recorded_items": _DISK,
    "camera_superseded": "frames of cameras for which newer ones came in time",
    "camera_budget": "points of cameras above the budget",
    "camera_send": "frames of cameras that the session did not take in time",
    "camera_join": "frames of a camera that were captured more than 50 ms before those of another one",
    "camera_pose": "frames of a camera without a pose of the body that carries it",
    "camera_unusable": "frames of cameras of a wrong size, or with a pose that is none",
    "camera_incomplete": "frames of a folder that lack depth, colour or pose",
    "camera_range": "points of cameras nearer than nearest_m or beyond farthest_m, of clouds without a point",
    "camera_box": "points of cameras outside the box from low to high, of clouds without a point",
    "camera_cells": "points of cameras above the number of cells that a cloud has",
    "camera_failed": "clouds and pictures of cameras that could not be made: the stream's fault says why",
    "media_record_share": "frames of point clouds and pictures that are missing in the recording: above 4 MB/s in all",
    "media_record_queue_full": "frames of point clouds and pictures that are missing in the recording: disk is slow",
    "recorded_media": "frames of point clouds and pictures that are not recorded: their source encodes them wrongly",
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
