"""Files of a network: an ONNX file, and the files beside it that hold its weights."""

from __future__ import annotations

import re
from hashlib import sha256
from pathlib import Path

from bevviz.support.files import file_hash

DEMO_MODEL = Path(__file__).parents[1] / "data" / "demo_detector.onnx"


def with_weights(model: Path) -> list[Path]:
    """Return an ONNX file and the files beside it that hold its weights, by their names in it."""
    names = re.findall(rb"\n\x08location\x12([\x01-\x7f])([^\0]{1,127})", model.read_bytes())
    found = {text[: length[0]].decode(errors="replace") for length, text in names}
    return [model, *(path for name in sorted(found) if (path := model.parent / name).is_file())]


def network_hash(model: Path) -> str:
    """Return the SHA-256 of an ONNX file. Weights in files beside it count, too."""
    hashes = [file_hash(path) for path in with_weights(model)]
    return hashes[0] if len(hashes) == 1 else sha256("".join(hashes).encode()).hexdigest()
