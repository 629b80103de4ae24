"""A random walk over the workbench's page: no sentence is about another object, frame or value."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.page_walk import Oracle, Walk
from tests.support.workbench_pages import chromium, demo_bag, serving

pytestmark = pytest.mark.long
SEED, STEPS = 4, 12
SECONDS = 25.0  # a slower machine takes fewer steps


def test_no_sentence_names_another_object_frame_or_value(tmp_path: Path) -> None:
    bag = demo_bag(tmp_path)
    with serving("open", str(bag)) as (address, _), chromium() as browser:
        walk = Walk(browser, address, Oracle(bag), SEED)
        taken = walk.go(STEPS, within=SECONDS)
    assert taken and not walk.wrong, "\n".join(walk.wrong)
