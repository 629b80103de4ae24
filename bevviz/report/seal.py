"""What the page of a report says of the recording beside it: that it is this very file."""

from __future__ import annotations

import re
from pathlib import Path

from bevviz.errors import UserError
from bevviz.recording.provenance import file_hash

_SEAL = re.compile(rb'id="seal">SHA-256 of the recording: ([0-9a-f]{64})<')


def check_seal(rrd: Path) -> bool:
    """Whether there is a page beside the recording that tells of it.

    Raises:
        UserError: it tells of another file. A reader may take what is damaged for something else, or break.
    """
    page = rrd.with_suffix(".html")
    try:
        said = _SEAL.findall(page.read_bytes()) if page.is_file() else []
    except OSError:
        said = []
    if said and said[-1].decode() != file_hash(rrd):
        raise UserError(
            f"{rrd}: changed or damaged: it is not the file that {page.name}, its page, tells of "
            "(SHA-256); without that page beside it, it is compared even so"
        )
    return bool(said)
