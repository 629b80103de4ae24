"""Background jobs of a page: how they end, and what the page is told."""

from __future__ import annotations

import threading

import pytest

from bevviz.errors import UserError
from bevviz.support.json_form import json_tree
from bevviz.workbench.jobs import Job, Jobs
from tests.support.waiting import until


def test_a_job_tells_how_it_ended() -> None:
    told: list[str] = []
    jobs: Jobs[Job] = Jobs("count", lambda: told.append(jobs.jobs[-1].state))

    def count(job: Job) -> None:
        job.done = job.total

    def fail(job: Job) -> None:
        raise UserError("bag.mcap: the file has gone")

    def stumble(job: Job) -> None:
        job.error.index("camera")

    jobs.start(Job(0, ("voxel.size=0.2",), total=3), count)
    until(lambda: not jobs.jobs[-1].going)
    head = {"number": 0, "settings": ["voxel.size=0.2"]}
    assert json_tree(jobs.jobs[0]) == {**head, "state": "over", "error": "", "done": 3, "total": 3}
    jobs.start(Job(1), fail)
    until(lambda: not jobs.jobs[-1].going)
    assert (jobs.jobs[1].state, jobs.jobs[1].error) == ("failed", "bag.mcap: the file has gone")
    jobs.start(Job(2), stumble)
    until(lambda: not jobs.jobs[-1].going)
    assert (jobs.jobs[2].state, jobs.jobs[2].error) == ("failed", "the count failed: substring not found")
    jobs.end()
    assert told[-1] == "failed"


def test_a_cancelled_job_ends_at_its_next_step() -> None:
    jobs: Jobs[Job] = Jobs("wait", lambda: None)
    stepped = threading.Event()

    def work(job: Job) -> None:
        while True:
            stepped.set()
            job.stop.wait(10)
            job.check()

    jobs.start(Job(0), work)
    assert stepped.wait(10)
    with pytest.raises(UserError, match="it is counted: wait for it, or cancel it"):
        jobs.check_idle("it is counted")
    jobs.cancel()
    jobs.end()
    assert jobs.jobs[0].state == "cancelled"
    jobs.check_idle("it is counted")
