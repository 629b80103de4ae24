"""Messages that are decoded from a bag and as of a live graph, to compare both."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from bevviz.bags.bag import Recording
from bevviz.live.live_message import LiveMessage
from tests.support import bags


def assert_same(one: Any, other: Any) -> None:
    """Compare two messages or clouds field by field."""
    assert type(one).__name__ == type(other).__name__
    if dataclasses.is_dataclass(one):
        for field in dataclasses.fields(one):
            assert_same(getattr(one, field.name), getattr(other, field.name))
    elif isinstance(one, dict):
        assert_same(list(one.keys()), list(other.keys()))
        assert_same(list(one.values()), list(other.values()))
    elif isinstance(one, list):
        assert len(one) == len(other)
        for left, right in zip(one, other, strict=True):
            assert_same(left, right)
    else:
        np.testing.assert_array_equal(one, other)


def both(path: Path, item: bags.Item, made: bags.Messages) -> tuple[Any, Any]:
    """Decode the message of a bag, and the same bytes as of a live graph."""
    with Recording([bags.write(path, [item], made)]) as recording:
        message = recording.first(item.topic)
        assert message is not None
        data = bytes(message.content())
        return recording.decode(message), LiveMessage(item.topic, item.type, bags.START, data).decode()
