"""Store of expensive results of single frames on disk. A result is found by the content it was made from.

The detections of an image are kept, and what a user-defined stage returns that says what its results depend
on. Their keys are hashes of the image or the cloud, of the network's files, of the code that runs it, and of
the parameters that the result depends on.
"""

from __future__ import annotations

import hashlib
import io
import os
import sqlite3
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from bevviz.errors import UserError
from bevviz.model.frame import I64, U8
from bevviz.model.results import Masks
from bevviz.stages.detector import Detector, Inference
from bevviz.stages.user_stages import UserStage
from bevviz.support import progress
from bevviz.support.contexts import Closable
from bevviz.support.files import file_hash
from bevviz.support.loggers import logger
from bevviz.support.onnx_files import with_weights
from bevviz.support.version import __version__

T = TypeVar("T")
Arrays = Sequence[NDArray[Any]]

NETWORKS = "stages/detector"  # code that runs networks, in the package
FOLDER_VARIABLE = "BEVVIZ_STORE"
FILE_NAME = "results.sqlite"
APPLICATION_ID = 0x62657676  # "bevv", in the header of the file
MAGIC = b"SQLite format 3\0"
WAITING = 2.0  # seconds that another process may hold the file; after that a result is not kept
CHECK_EVERY = 50  # results between two looks at the size of the file
FILLED = 0.9  # of the size, to which old results are deleted
SEEN_AGAIN = 3600  # seconds after which the use of a result is noted again
SUM = 16  # bytes of the checksum before each value
BUSY = {sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED}
DAMAGED = {sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB}

_log = logger(__name__)


class ResultStore(Closable):
    """Bounded store of bytes by key in one SQLite file that several processes share.

    SQLite of the standard library was chosen by measurement. To write and to read an entry of 8 to 24 kB took
    55 and 33 us of processor time, as single files did (56, 22) and diskcache did not (139, 101). LMDB is
    faster (17, 8), and leaves the bound to us. The journal is not a write-ahead log, since that does not work
    on file systems that machines share. Nothing waits for the disk: after a power failure the file may be
    damaged, which is noticed. A store that cannot be used says so once and keeps nothing.

    Args:
        folder: folder of the file. It is created if it is missing.
        size: bytes that the file may have. The results that were not used for longest go first.
    """

    def __init__(self, folder: Path, size: int) -> None:
        self.path, self._size = folder / FILE_NAME, size
        self._lock = threading.Lock()
        self._connection: sqlite3.Connection | None = None
        self._unchecked = CHECK_EVERY  # The first result that is kept looks at the size.
        with self._lock:
            self._attempt(self._open)

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._close()

    @property
    def usable(self) -> bool:
        """Whether values are kept."""
        return self._connection is not None

    def get(self, key: bytes) -> bytes | None:
        """Return the value of a key. None: there is none, or it is damaged."""
        with self._lock:
            return self._attempt(lambda: self._get(key))

    def put(self, key: bytes, value: bytes) -> None:
        """Keep a value."""
        with self._lock:
            self._attempt(lambda: self._put(key, value))

    def clear(self) -> int:
        """Delete all values. Return how many there were."""
        with self._lock:
            count = self._attempt(lambda: self._run("DELETE FROM results").rowcount) or 0
            self._attempt(lambda: self._run("VACUUM"))
        return count

    def summary(self) -> tuple[int, int]:
        """Return the number of values and the bytes that they take on disk."""
        with self._lock:
            count = self._attempt(lambda: int(self._run("SELECT count(*) FROM results").fetchone()[0]))
            return count or 0, self._attempt(self._bytes) or 0

    def _get(self, key: bytes) -> bytes | None:
        row = self._run("SELECT value, used FROM results WHERE key = ?", key).fetchone()
        if row is None:
            return None
        stored, used = row
        value = stored[SUM:] if isinstance(stored, bytes) else b""
        if not value or _checksum(value) != stored[:SUM]:
            self._run("DELETE FROM results WHERE key = ?", key)
            return None
        now = int(time.time())
        if not 0 <= now - used < SEEN_AGAIN:
            self._run("UPDATE results SET used = ? WHERE key = ?", now, key)
        return value

    def _put(self, key: bytes, value: bytes) -> None:
        stored = _checksum(value) + value
        self._run("INSERT OR REPLACE INTO results VALUES (?, ?, ?)", key, int(time.time()), stored)
        self._unchecked += 1
        if self._unchecked >= CHECK_EVERY:
            self._unchecked = 0
            self._shrink()

    def _shrink(self) -> None:
        """Delete the results that were not used for longest if the file is larger than its size."""
        size = self._bytes()
        if size <= self._size:
            return
        count = int(self._run("SELECT count(*) FROM results").fetchone()[0])
        spare = max(1, int(count * (1 - FILLED * self._size / size)))
        self._run("DELETE FROM results WHERE key IN (SELECT key FROM results ORDER BY used LIMIT ?)", spare)

    def _bytes(self) -> int:
        pages, free, size = (
            int(self._run(f"PRAGMA {name}").fetchone()[0])
            for name in ("page_count", "freelist_count", "page_size")
        )
        return (pages - free) * size

    def _run(self, sql: str, *values: object) -> sqlite3.Cursor:
        assert self._connection is not None
        return self._connection.execute(sql, values)

    def _open(self) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        self._connection = sqlite3.connect(
            self.path, timeout=WAITING, isolation_level=None, check_same_thread=False
        )
        owner = self._run("PRAGMA application_id").fetchone()[0]
        is_new = not self._run("SELECT count(*) FROM sqlite_master").fetchone()[0]
        if not is_new and owner != APPLICATION_ID:
            raise UserError("is another program's file")
        self._run("PRAGMA synchronous = OFF")
        if is_new:
            self._run("PRAGMA auto_vacuum = FULL")
            self._run("PRAGMA journal_mode = TRUNCATE").fetchall()
            self._run(f"PRAGMA application_id = {APPLICATION_ID}")
        self._run("CREATE TABLE IF NOT EXISTS results (key BLOB PRIMARY KEY, used INTEGER, value BLOB)")
        self._run("CREATE INDEX IF NOT EXISTS by_use ON results (used)")

    def _attempt(self, work: Callable[[], T]) -> T | None:
        """Return what the work returns. None: it failed, and the run goes on without the store's help."""
        if self._connection is None and work != self._open:
            return None
        try:
            return work()
        except (UserError, OSError) as error:
            self._give_up(str(error))
        except sqlite3.Error as error:
            code = getattr(error, "sqlite_errorcode", 0) & 0xFF
            if code in BUSY:
                _log.debug("%s is busy", self.path)
            elif code in DAMAGED and self._is_own():
                self._restart()
            else:
                self._give_up(str(error))
        return None

    def _is_own(self) -> bool:
        """Return whether the header of a damaged file says that it is a store."""
        try:
            with self.path.open("rb") as file:
                head = file.read(72)
        except OSError:
            return False
        return head.startswith(MAGIC) and head[68:72] == APPLICATION_ID.to_bytes(4, "big")

    def _restart(self) -> None:
        """Delete a damaged file and begin anew."""
        progress.say(f"{self.path}: the store of results is damaged; it begins anew")
        self._close()
        try:
            self.path.unlink(missing_ok=True)
            self._open()
        except (OSError, sqlite3.Error, UserError) as error:
            self._give_up(str(error))

    def _give_up(self, reason: str) -> None:
        self._close()
        text = f"{self.path}: no results are kept there ({reason}); set {FOLDER_VARIABLE} to another folder"
        progress.say(text)
        _log.warning("%s", text)

    def _close(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None


def store_folder() -> Path | None:
    """Return the folder of the store: stated in ``BEVVIZ_STORE``, else in the user's cache.

    None: the variable is stated and empty, so that nothing is kept.

    Raises:
        UserError: the user has no home folder, and no folder is stated.
    """
    stated = os.environ.get(FOLDER_VARIABLE)
    if stated is not None:
        return Path(stated) if stated else None
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "bevviz"
    except RuntimeError:
        raise UserError(f"no results are kept: this user has no home; set {FOLDER_VARIABLE}") from None


def open_store(megabytes: float) -> ResultStore | None:
    """Return the store of this process. None: there is no folder for it, or its size is 0."""
    if not megabytes:
        return None
    try:
        folder = store_folder()
    except UserError as error:
        progress.say(str(error))
        return None
    return None if folder is None else _opened(folder, int(megabytes * 1e6))


@lru_cache(maxsize=1)
def _opened(folder: Path, size: int) -> ResultStore:
    return ResultStore(folder, size)


# --- results of networks -----------------------------------------------------------------------


class StoredDetector:
    """Detector that keeps its candidates and masks, before any threshold of ``detector``.

    Args:
        detector: the detector.
        store: where they are kept.
    """

    def __init__(self, detector: Detector, store: ResultStore) -> None:
        self._detector, self._store = detector, store
        self._identity = _identity([detector.path], detector.identity)

    def infer(self, bgr: U8, least: float) -> Inference:
        """Return the candidates of a non-empty image, as ``Detector.infer`` does."""
        key = store_key(self._identity, str(least), bgr)
        arrays = _unpack(self._store.get(key), ((2, "f"), (1, "f"), (1, "i")))
        if arrays is None:
            inference = self._detector.infer(bgr, least)
            self._store.put(key, _pack((inference.xyxy, inference.score, inference.class_id)))
        else:
            masks = partial(self._infer_masks, bgr, least)
            inference = Inference(arrays[0], arrays[1], arrays[2], self._detector.place(bgr), masks)
        if inference.masks is None or not self._detector.has_masks:
            return replace(inference, masks=None)
        return replace(inference, masks=partial(self._masks, key, inference.masks))

    def _infer_masks(self, bgr: U8, least: float, rows: I64, kept: I64, count: int) -> Masks:
        """Run the network for masks alone."""
        masks = self._detector.infer(bgr, least).masks
        assert masks is not None
        return masks(rows, kept, count)

    def _masks(
        self, image: bytes, make: Callable[[I64, I64, int], Masks], rows: I64, kept: I64, count: int
    ) -> Masks:
        """Return the masks of the kept candidates, whose rows depend on the thresholds."""
        key = store_key(image, str(count), rows, kept)
        arrays = _unpack(self._store.get(key), ((1, "u"), (2, "i"), (1, "f")))
        if arrays is not None:
            return Masks(*arrays)
        masks = make(rows, kept, count)
        self._store.put(key, _pack((masks.packed, masks.place, masks.grid)))
        return masks


class StoredStage:
    """User-defined stage that keeps the arrays and names that it returns.

    Args:
        stage: the stage, with an identity.
        store: where they are kept.
        files: files of the stage.
    """

    def __init__(self, stage: UserStage, store: ResultStore, files: Iterable[Path]) -> None:
        self._call, self._store = stage.call, store
        module, code = stage.plugin.file, ""
        if module is not None:
            code = code_hash(str(module.parent)) if "." in stage.plugin.module else file_hash(module)
        self._identity = _identity(files, stage.plugin.name, code, stage.identity)

    def __call__(self, array: NDArray[Any], **facts: Any) -> Any:
        """Return the stage's result for an array."""
        key = store_key(self._identity, str(sorted(facts.items())), array)
        known = _unpack(self._store.get(key))
        if known is not None:
            return known[0] if len(known) == 1 else tuple(known)
        returned = self._call(array, **facts)
        arrays = [np.asarray(part) for part in (returned if isinstance(returned, tuple) else [returned])]
        if all(part.dtype.kind in "biufU" for part in arrays):
            self._store.put(key, _pack(arrays))
        return returned


def _identity(files: Iterable[Path], *facts: str) -> bytes:
    """Return the hash of everything but the input that a network's result depends on."""
    versions = __version__, ort.__version__, cv2.__version__, np.__version__, code_hash(NETWORKS)
    return store_key(*versions, *facts, *(file_hash(path) for file in files for path in with_weights(file)))


@lru_cache
def code_hash(*folders: str) -> str:
    """Return the hash of the code in folders of the package. A checkout changes without a new version."""
    package = Path(__file__).parents[1]
    files = sorted(path for folder in folders for path in (package / folder).rglob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()


def store_key(*parts: bytes | str | NDArray[Any]) -> bytes:
    """Return the hash of a sequence of values. An array counts with its type and shape."""
    total = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            total.update(f"{part.dtype.str}{part.shape}\0".encode())
            total.update(np.ascontiguousarray(part).data)
        else:
            content = part.encode() if isinstance(part, str) else part
            total.update(f"{len(content)}\0".encode() + content)
    return total.digest()


def _checksum(value: bytes) -> bytes:
    return hashlib.blake2b(value, digest_size=SUM).digest()


def _pack(arrays: Arrays) -> bytes:
    """Return arrays as NPY files, one after the other."""
    target = io.BytesIO()
    for array in arrays:
        np.save(target, array, allow_pickle=False)
    return target.getvalue()


def _unpack(value: bytes | None, expected: Sequence[tuple[int, str]] = ()) -> list[Any] | None:
    """Return arrays of the expected number of axes and kinds. None: there is no such value.

    Args:
        value: what ``_pack`` returned.
        expected: number of axes and kind of each array. Empty: any.
    """
    if value is None:
        return None
    source, arrays = io.BytesIO(value), []
    try:
        while source.tell() < len(value):
            arrays.append(np.load(source, allow_pickle=False))
    except (ValueError, EOFError, OSError):
        return None
    return arrays if not expected or [(a.ndim, a.dtype.kind) for a in arrays] == list(expected) else None
