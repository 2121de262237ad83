"""Detection of silence of a source with a period."""

from __future__ import annotations

from iris_session.session.publish_loop import SILENT_NS, SILENT_PERIODS, ArrivalMonitor

MS = 1_000_000


def follow(monitor: ArrivalMonitor, first_ns: int, period_ns: int, count: int) -> int:
    for i in range(count):
        monitor.note_arrival(first_ns + i * period_ns)
    return first_ns + (count - 1) * period_ns


def test_source_without_period_is_never_silent() -> None:
    monitor = ArrivalMonitor()
    assert not monitor.measure_silence_ns(3600 * SILENT_NS)
    monitor.note_arrival(0)
    assert not monitor.measure_silence_ns(3600 * SILENT_NS)


def test_quick_source_is_silent_after_a_second() -> None:
    monitor = ArrivalMonitor()
    last_ns = follow(monitor, 0, 16 * MS, 100)
    assert not monitor.measure_silence_ns(last_ns + SILENT_NS)
    assert monitor.measure_silence_ns(last_ns + SILENT_NS + MS) == SILENT_NS + MS
    monitor.note_arrival(last_ns + 300 * SILENT_NS)
    assert not monitor.measure_silence_ns(last_ns + 300 * SILENT_NS + MS)
    again_ns = follow(monitor, last_ns + 301 * SILENT_NS, 16 * MS, 100)
    assert monitor.measure_silence_ns(again_ns + 2 * SILENT_NS), "the long silence is not its rhythm"


def test_slow_source_is_silent_after_ten_periods() -> None:
    monitor = ArrivalMonitor()
    last_ns = follow(monitor, 0, 5 * SILENT_NS, 20)
    assert not monitor.measure_silence_ns(last_ns + SILENT_PERIODS * 5 * SILENT_NS)
    assert monitor.measure_silence_ns(last_ns + (SILENT_PERIODS * 5 + 1) * SILENT_NS)


def test_two_arrivals_at_one_time_are_a_period() -> None:
    monitor = ArrivalMonitor()
    monitor.note_arrival(5)
    monitor.note_arrival(5)
    assert monitor.measure_silence_ns(5 + 2 * SILENT_NS) == 2 * SILENT_NS
