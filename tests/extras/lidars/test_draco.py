"""Clouds that point_cloud_transport compressed by draco."""

from __future__ import annotations

from base64 import b64decode
from typing import Any

import numpy as np
import pytest

from bevviz.drivers.compressed_clouds import COMPRESSED
from bevviz.extras.lidars import draco as extra
from bevviz.live.live_message import LiveMessage
from bevviz.messages.decoders import MessageError
from tests.support.compressed_clouds import DRACO, draco, messages


def decoded(message: Any) -> Any:
    raw = bytes(messages().store.serialize_cdr(message, COMPRESSED))
    return LiveMessage("/points", COMPRESSED, 0, raw).decode()


@pytest.mark.parametrize(("number", "off"), [(0, 0.0), (1, 0.005)])
def test_draco_clouds_are_decoded(number: int, off: float) -> None:
    pytest.importorskip("DracoPy")
    cloud = decoded(draco(b64decode(DRACO[number])))
    assert cloud.dropped == 0
    order = np.argsort(cloud.xyz[:, 0])
    i = np.arange(12)
    np.testing.assert_allclose(cloud.xyz[order], np.stack([4 + i, i % 4 - 1.5, i / 16 - 1.5], 1), atol=off)
    np.testing.assert_allclose(cloud.fields["intensity"][order], 10 * i, atol=off)
    np.testing.assert_array_equal(cloud.fields["ring"][order], i % 3)
    np.testing.assert_array_equal(cloud.fields["rgb"].view(np.uint32)[order], 0x102030 + i)


def test_damaged_draco_clouds_state_the_reason() -> None:
    some = draco(b64decode(DRACO[0]))
    some.fields = some.fields[:5]
    for message, said in (
        (draco(b"DRACO" + bytes(40)), "its draco data is damaged"),
        (some, "its draco data has 6 attributes of 12 points, but 5 fields"),
    ):
        with pytest.raises(MessageError, match=f"/points: not a {COMPRESSED}: .*{said}"):
            decoded(message)


def test_without_its_library_a_draco_cloud_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extra, "find_spec", lambda name: None)
    with pytest.raises(MessageError, match=r"which DracoPy reads: pip install 'bevviz\[lidars\]'"):
        decoded(draco(b64decode(DRACO[0])))
