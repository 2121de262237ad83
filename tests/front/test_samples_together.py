"""Samples of several devices in one message: each is an entry of its own, within the rate of single samples."""

from __future__ import annotations

import zmq

from iris_session.protocol.client_messages import Sample, Samples
from iris_session.protocol.common import IDENTITY
from iris_session.protocol.limits import LIMITS
from tests.front.test_intake import Desk

DEVICES = ("head", "controller/left", "controller/right")


def together(seq: int) -> Samples:
    return Samples(tuple(Sample(device, "pose", seq, 0, 1, 0, 0, pose=IDENTITY) for device in DEVICES))


def test_each_sample_becomes_an_entry_of_its_own() -> None:
    with zmq.Context() as context:
        desk = Desk(context)
        epoch = desk.join().connection_epoch
        desk.take(together(7), epoch=epoch)
        entries = desk.entries()
    assert [e.message for e in entries] == list(together(7).samples)
    assert {(e.connection, e.connection_epoch) for e in entries} == {(epoch, epoch)}


def test_a_flood_is_cut_at_the_rate_of_single_samples_and_counted() -> None:
    with zmq.Context() as context:
        desk = Desk(context)
        epoch = desk.join().connection_epoch
        for seq in range(LIMITS[Samples].burst):
            desk.take(together(seq), epoch=epoch)
    assert desk.drops.by_reason["rate"] == 3 * LIMITS[Samples].burst - LIMITS[Sample].burst
