"""Seal of a recording: the page beside it states its checksum."""

from __future__ import annotations

import re
from pathlib import Path

from bevviz.errors import UserError
from bevviz.recording.provenance import file_hash

_SEAL = re.compile(rb'id="seal">SHA-256 of the recording: ([0-9a-f]{64})<')


def check_seal(rrd: Path) -> bool:
    """Return whether a page beside the recording states its checksum.

    Raises:
        UserError: the checksum differs. A damaged file could be misread, or crash its reader.
    """
    page = rrd.with_suffix(".html")
    try:
        checksums = _SEAL.findall(page.read_bytes()) if page.is_file() else []
    except OSError:
        checksums = []
    if checksums and checksums[-1].decode() != file_hash(rrd):
        raise UserError(
            f"{rrd}: changed or damaged: it is not the file that {page.name}, its page, tells of "
            "(SHA-256); without that page beside it, it is compared even so"
        )
    return bool(checksums)
