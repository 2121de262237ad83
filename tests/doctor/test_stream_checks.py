"""Checks of media streams: one fault at a time."""

from __future__ import annotations

import pytest

from iris_session.doctor.session_checks import check_session_report
from iris_session.doctor.stream_checks import FAULTS, MEDIA_DROPS, check_streams
from iris_session.protocol.media import StreamBudget
from iris_session.protocol.status import MediaStreamReport, StatusReport
from tests.doctor.test_session_checks import ANN, DOCTOR, WELL, assert_only, change

ROOM = MediaStreamReport("room", 30.0, source="cam-1", encoding="cloud", age_ms=33.0, title="Room", audience="remote")


def with_stream(**fields: object) -> StatusReport:
    report: StatusReport = change(WELL, media=(change(ROOM, **fields), MediaStreamReport("cloth")))
    return report


def test_healthy_streams_are_ok() -> None:
    (found,) = [one for one in check_session_report(with_stream(), "p9") if one.check == "streams"]
    assert (found.state, found.text) == ("ok", "room, cloth")
    assert check_streams(()).state == "ok"


@pytest.mark.parametrize("fault", sorted(FAULTS))
def test_every_fault_is_reported_with_cause_and_advice(fault: str) -> None:
    why, advice = FAULTS[fault]
    report = with_stream(fault=fault, detail="front camera")
    assert_only(report, "streams", "warning", f"room (Room) from cam-1: {fault} (front camera)", f"room: {why}", advice)


def test_stale_stream_is_reported() -> None:
    report = with_stream(stale=True, age_ms=2_500.0, title="", source="")
    assert_only(report, "streams", "warning", "room: no frame for 2.5 s", "hangs", "the program that publishes it")


def test_reduced_or_dropped_media_are_reported() -> None:
    full, quarter = StreamBudget("cloud", "full", 20.0), StreamBudget("cloth", "quarter", 0.5)
    cut = change(ANN, media=(full, quarter))
    assert_only(change(WELL, participants=(cut, DOCTOR)), "media", "warning", "ann: cloth in class quarter", "links.md")
    lossy = change(ANN, media=(full,), media_drops=MEDIA_DROPS)
    assert_only(change(WELL, participants=(lossy, DOCTOR)), "media", "warning", f"ann: {MEDIA_DROPS} frames dropped")


def test_healthy_media_are_ok() -> None:
    for fields in ({"media": (StreamBudget("cloud"),), "media_drops": MEDIA_DROPS - 1}, {"media": ()}):
        report = change(WELL, participants=(change(ANN, **fields), DOCTOR))
        assert all(one.state == "ok" for one in check_session_report(report, "p9"))
