"""Assets that the gateway sends: at a bounded rate."""

from __future__ import annotations

from iris_session.web.assets import ByteRate


def test_senders_share_a_rate_and_do_not_pay_for_silence() -> None:
    rate = ByteRate(1024.0)
    assert [rate.reserve(128, 5.0) for _ in range(3)] == [0.0, 0.125, 0.25]
    assert rate.reserve(128, 5.125) == 0.25
    assert rate.reserve(128, 60.0) == 0.0
