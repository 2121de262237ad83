"""Who saw what, as arrays for the solver of constellations: looks are edges between headsets and sheets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from anchors.groups import ViewpointGroup, AnchorObservation
from anchors.lie import Array, quat_conjugate, quat_to_matrix, quat_multiply
from anchors.noise import NoiseModel
from anchors.pose import PoseTuple, is_rigid, quat_normalize

if TYPE_CHECKING:
    from anchors.constellation import SheetObservation

HeadsetKey = tuple[str, int]


@dataclass(frozen=True)
class Edge:
    """All that one headset saw of one sheet from one viewpoint, merged: `T_tracking_anchor` and its covariance (6,
    6)."""

    headset: str
    tracking_epoch: int
    viewpoint_id: int
    anchor_id: str
    p: Array
    q: Array
    covariance: Array


def merge_edges(observations: Sequence[SheetObservation], noise: NoiseModel, fallback: Array) -> list[Edge]:
    """One edge per viewpoint and sheet; what is no pose, and viewpoints whose observations do not agree, are left
    out."""
    groups: dict[tuple[str, int, int, str], ViewpointGroup] = {}
    for o in observations:
        if not is_rigid(o.T_tracking_anchor):
            continue
        p, q = o.T_tracking_anchor
        sighting = AnchorObservation(0, p, quat_normalize(q), o.p_tracking_head, (), 1.0, 0.0)
        groups.setdefault((o.headset, o.tracking_epoch, o.viewpoint_id, o.anchor_id), ViewpointGroup()).observations.append(
            sighting
        )
    edges = []
    for (headset, epoch, viewpoint, anchor_id), group in sorted(groups.items()):
        merged = group.merge(noise, fallback, 0.6)
        if merged is not None:
            edges.append(Edge(headset, epoch, viewpoint, anchor_id, merged.p, merged.q, merged.covariance))
    return edges


def find_reachable(edges: Sequence[Edge], reference: str) -> set[str]:
    """Sheets that looks tie to the reference."""
    by_headset: dict[HeadsetKey, set[str]] = {}
    for e in edges:
        by_headset.setdefault((e.headset, e.tracking_epoch), set()).add(e.anchor_id)
    known, grown = {reference}, True
    while grown:
        grown = False
        for sheets in by_headset.values():
            if sheets & known and not sheets <= known:
                known |= sheets
                grown = True
    return known


@dataclass(frozen=True)
class ObservationGraph:
    """Poses are ordered: sheets other than the reference, then headsets."""

    edges: list[Edge]
    unknown: list[str]
    reference: str
    T_world_reference: PoseTuple

    @property
    def n_anchors(self) -> int:
        return len(self.unknown)

    @cached_property
    def headsets(self) -> list[HeadsetKey]:
        return sorted({(e.headset, e.tracking_epoch) for e in self.edges})

    @cached_property
    def headset_index(self) -> np.ndarray[Any, np.dtype[np.intp]]:
        """Per edge, the place of its headset among all poses."""
        at = {key: i + self.n_anchors for i, key in enumerate(self.headsets)}
        return np.array([at[e.headset, e.tracking_epoch] for e in self.edges], dtype=np.intp)

    @cached_property
    def anchor_index(self) -> np.ndarray[Any, np.dtype[np.intp]]:
        """Per edge, the place of its sheet among all poses followed by the reference."""
        at = {name: i for i, name in enumerate(self.unknown)}
        last = self.n_anchors + len(self.headsets)
        return np.array([at.get(e.anchor_id, last) for e in self.edges], dtype=np.intp)

    @cached_property
    def p(self) -> Array:
        return np.array([e.p for e in self.edges])

    @cached_property
    def q(self) -> Array:
        return np.array([e.q for e in self.edges])

    @cached_property
    def whitening(self) -> Array:
        covariance = np.array([e.covariance for e in self.edges])
        return np.asarray(np.swapaxes(np.linalg.cholesky(np.linalg.inv(covariance)), 1, 2))

    def anchor_poses(self, p: Array, q: Array) -> tuple[Array, Array]:
        """Per edge, the pose of its sheet."""
        p_ref, q_ref = self.T_world_reference
        return np.vstack([p, p_ref])[self.anchor_index], np.vstack([q, q_ref])[self.anchor_index]

    def sparsity(self) -> Any:
        """Which residuals depend on which increments."""
        from scipy.sparse import lil_matrix

        n = self.n_anchors + len(self.headsets)
        S = lil_matrix((6 * len(self.edges) + 2 * len(self.headsets), 6 * n), dtype=np.int8)
        for i, (a, h) in enumerate(zip(self.anchor_index.tolist(), self.headset_index.tolist(), strict=True)):
            for k in (a, h):
                if k < n:
                    S[6 * i : 6 * i + 6, 6 * k : 6 * k + 6] = 1
        for j in range(len(self.headsets)):
            k = self.n_anchors + j
            S[6 * len(self.edges) + 2 * j : 6 * len(self.edges) + 2 * j + 2, 6 * k : 6 * k + 6] = 1
        return S


def initial_guess(graph: ObservationGraph) -> tuple[Array, Array]:
    """First guess: outwards from the reference, each sheet and headset by the most certain look that ties it."""
    p_ref, q_ref = (np.array(part) for part in graph.T_world_reference)
    sheets: dict[str, tuple[Array, Array]] = {graph.reference: (p_ref, q_ref)}
    headsets: dict[HeadsetKey, tuple[Array, Array]] = {}
    by_certainty = sorted(graph.edges, key=lambda e: float(np.trace(e.covariance[:3, :3])))
    while len(headsets) < len(graph.headsets) or len(sheets) <= graph.n_anchors:
        for e in by_certainty:
            key = (e.headset, e.tracking_epoch)
            if e.anchor_id in sheets and key not in headsets:
                p, q = sheets[e.anchor_id]
                q_h = quat_multiply(q, quat_conjugate(e.q))
                headsets[key] = (p - quat_to_matrix(q_h) @ e.p, q_h)
                break
            if key in headsets and e.anchor_id not in sheets:
                p, q = headsets[key]
                sheets[e.anchor_id] = (p + quat_to_matrix(q) @ e.p, quat_multiply(q, e.q))
                break
        else:
            break
    rows = [sheets[name] for name in graph.unknown] + [headsets[key] for key in graph.headsets]
    return np.array([r[0] for r in rows]), np.array([r[1] for r in rows])
