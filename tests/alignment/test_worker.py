"""Estimates beside the loop: what comes meanwhile waits, and what makes them void discards them."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from iris_session.alignment.cross_check import Job
from iris_session.alignment.service import _MAX_WAITING, Worker
from iris_session.protocol.server_messages import AlignmentRun
from tests.alignment.emulated_headsets import PERIOD_NS, Lab, Wearer


class HeldWorker:
    """Computes when the test says so."""

    def __init__(self) -> None:
        self.job: Job | None = None

    @property
    def is_busy(self) -> bool:
        return self.job is not None

    def submit(self, job: Job) -> None:
        assert self.job is None
        self.job = job

    def compute(self) -> None:
        job, self.job = self.job, None
        assert job is not None
        job()()

    def poll(self) -> None:
        pass

    def close(self) -> None:
        pass


def test_a_fault_in_a_job_is_raised_by_poll() -> None:
    worker = Worker(ThreadPoolExecutor(1))

    def job() -> object:
        raise ZeroDivisionError

    worker.submit(job)  # type: ignore[arg-type]
    while worker._running is None or not worker._running.done():
        time.sleep(0.001)
    with pytest.raises(ZeroDivisionError):
        worker.poll()
    assert not worker.is_busy
    worker.close()


def _start_estimate() -> tuple[Lab, HeldWorker, Wearer]:
    """Return a headset whose first estimate is being computed."""
    lab, held = Lab(), HeldWorker()
    lab.service._worker = held  # type: ignore[assignment]
    ann = lab.wearer()
    for _ in range(15):
        lab.now_ns += PERIOD_NS
        ann.report_observation(ann.place("sheet"), "sheet")
    lab.poll()
    assert held.is_busy
    assert ann.entries() == []
    return lab, held, ann


def _count_observations(lab: Lab) -> int:
    report = lab.service.complete_report(1, None, lab.now_ns)
    assert report is not None
    return report.observations


def test_observations_wait_for_the_estimate_and_are_bounded() -> None:
    lab, held, ann = _start_estimate()
    for _ in range(_MAX_WAITING + 6):
        ann.report_observation(ann.place("sheet"), "sheet")
    lab.poll()
    assert _count_observations(lab) == 15
    assert lab.drops.by_reason == {"observation_waiting": 6}
    held.compute()
    assert len(ann.proposals()) == 1
    assert _count_observations(lab) == 15 + _MAX_WAITING


def test_estimate_of_a_run_that_ended_meanwhile_is_discarded() -> None:
    lab, held, ann = _start_estimate()
    lab.service.process_event(AlignmentRun(ann.connection.participant_id, True, 1))
    held.compute()
    assert ann.entries() == []
    lab.poll()
    assert not held.is_busy, "the new run has no observations"


def test_estimate_of_a_connection_that_ended_meanwhile_is_discarded() -> None:
    lab, held, ann = _start_estimate()
    lab.service.remove_connection(1)
    held.compute()
    assert ann.entries() == []


def test_estimates_in_a_thread_arrive_as_proposals() -> None:
    lab = Lab()
    lab.service._worker = Worker(ThreadPoolExecutor(1))
    ann = lab.wearer()
    for _ in range(15):
        lab.now_ns += PERIOD_NS
        ann.report_observation(ann.place("sheet"), "sheet")
    until = time.monotonic() + 30.0
    while not ann.proposals():
        assert time.monotonic() < until
        lab.poll()
        time.sleep(0.001)
    lab.service.close()
