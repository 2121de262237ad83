"""Priority of the tick loop: taken when allowed, given back, and never a reason to fail."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from iris_session.session.scheduling import tick_priority

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="priorities are asked for on Linux only")


def test_it_is_given_back() -> None:
    before = os.sched_getscheduler(0)
    with tick_priority() as reached:
        inside = os.sched_getscheduler(0)
    assert reached in ("realtime", "normal")
    assert (inside & ~os.SCHED_RESET_ON_FORK == os.SCHED_RR) == (reached == "realtime")
    assert os.sched_getscheduler(0) == before


#: Root has `CAP_SYS_NICE` until it becomes somebody else; whoever has an `rtprio` limit never had it.
WITHOUT_CAPABILITY = """
import os
from iris_session.session.scheduling import tick_priority
with tick_priority() as reached:
    if os.getuid() == 0:
        os.setuid(65534)
    inside = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
print(reached, inside == os.SCHED_RR, os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER)
"""


def test_it_is_given_back_without_the_capability() -> None:
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_CAPABILITY], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.split() in (["realtime", "True", "True"], ["normal", "False", "True"])


def test_without_permission_it_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError("no")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    with tick_priority() as reached:
        assert reached == "normal"


def test_it_is_not_asked_for_when_not_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise AssertionError("asked")

    monkeypatch.setattr(os, "sched_setscheduler", fail)
    with tick_priority(False) as reached:
        assert reached == "normal"


def test_a_single_processor_is_shared_fairly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})
    before = os.sched_getscheduler(0)
    with tick_priority() as reached:
        assert reached == "normal"
        assert os.sched_getscheduler(0) == before
