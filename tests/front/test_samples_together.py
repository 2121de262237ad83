"""Samples of several devices in one message: each is an entry of its own, within the rate of single samples."""

from __future__ import annotations

import zmq

from iris_session.protocol.client_messages import Sample, Samples
from iris_session.protocol.common import IDENTITY
from iris_session.protocol.limits import LIMITS
from tests.front.test_intake import IntakeRig

DEVICES = ("head", "controller/left", "controller/right")


def together(seq: int) -> Samples:
    return Samples(tuple(Sample(device, "pose", seq, 0, 1, 0, 0, pose=IDENTITY) for device in DEVICES))


def test_each_sample_becomes_an_entry_of_its_own() -> None:
    with zmq.Context() as context:
        rig = IntakeRig(context)
        epoch = rig.join().connection_epoch
        rig.take(together(7), epoch=epoch)
        entries = rig.entries()
    assert [e.message for e in entries] == list(together(7).samples)
    assert {(e.connection, e.connection_epoch) for e in entries} == {(epoch, epoch)}


def test_a_flood_is_cut_at_the_rate_of_single_samples_and_counted() -> None:
    with zmq.Context() as context:
        rig = IntakeRig(context)
        epoch = rig.join().connection_epoch
        for seq in range(LIMITS[Samples].burst):
            rig.take(together(seq), epoch=epoch)
    assert rig.drops.by_reason["rate"] == 3 * LIMITS[Samples].burst - LIMITS[Sample].burst
