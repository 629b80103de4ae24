"""Bags on a web server or in object storage, of which only the parts that are needed are loaded (fsspec)."""

from __future__ import annotations

import re
import time
from collections import OrderedDict
from pathlib import Path, PurePosixPath
from threading import Lock
from typing import Any
from urllib.parse import unquote, urlsplit

from bevviz.bags.reader import FileBytes
from bevviz.errors import UserError, first_line

_ADDRESS = re.compile(r"(https?|s3|gs|gcs|az|abfs):/+(?=[^/])")  # a Path has one slash of two
PART = 1 << 16  # bytes loaded at least: many records of an index lie in one part
CACHE = 1 << 26  # bytes kept in memory
TRIES = 3
PAUSE = 0.5  # seconds before the second try; twice as long before the third
PACKAGES = {"s3": "s3fs", "gs": "gcsfs", "gcs": "gcsfs", "az": "adlfs", "abfs": "adlfs"}
NO_CREDENTIALS = ("NoCredentialsError", "PartialCredentialsError")  # errors of s3fs


def address_of(path: Path) -> str:
    """Return the address that a path stands for; empty if it is a path of this machine."""
    found = _ADDRESS.match(str(path))
    return f"{found[1]}://{str(path)[found.end() :]}" if found else ""


def name_of(path: Path) -> str:
    """Return the file name in an address, without a query, which may hold a signature."""
    return PurePosixPath(unquote(urlsplit(address_of(path)).path)).name or "remote"


def beside(path: Path) -> Path:
    """Return the absolute path that names files beside a bag; for an address in the working directory."""
    return Path.cwd() / name_of(path) if address_of(path) else path.resolve()


def open_bytes(path: Path) -> FileBytes:
    """Open the bytes of a file of this machine, or of an address."""
    return RemoteBytes(path) if address_of(path) else FileBytes(path)


class RemoteBytes(FileBytes):
    """Bytes of a file at an address, by ranges. The latest ones are kept in memory.

    Raises:
        UserError: the file cannot be reached or read by ranges, or a package for its protocol is missing.
    """

    def __init__(self, path: Path) -> None:
        self._address, self._name = address_of(path), name_of(path)
        self._protocol = self._address.partition(":")[0]
        self._parts: OrderedDict[tuple[int, int], bytes] = OrderedDict()
        self._kept = 0
        self._lock = Lock()
        try:
            import fsspec

            self._system, self._inner = fsspec.core.url_to_fs(self._address)
        except ImportError:
            also = f" {PACKAGES[self._protocol]}" if self._protocol in PACKAGES else ""
            raise UserError(
                f"{self._name}: reading {self._protocol}:// needs more packages: "
                f"pip install 'bevviz[remote]'{also}"
            ) from None
        except ValueError as error:
            raise UserError(f"{self._name}: {first_line(error)}") from None
        self._latest = 0, b""
        size = self._request(lambda: self._system.info(self._inner))["size"]
        if size is None:
            raise UserError(f"{self._name}: the server does not state the size of the file: download it")
        self.size = int(size)

    def close(self) -> None:
        """Forget the loaded parts."""
        with self._lock:
            self._parts.clear()
            self._kept = 0

    def _pread(self, offset: int, size: int) -> bytes:
        if size >= PART:
            return self._load(offset, min(size, self.size - offset))
        parts, end = [], min(offset + size, self.size)
        for start in range(offset - offset % PART, end, PART):
            part = self._load(start, min(PART, self.size - start))
            parts.append(part[max(0, offset - start) : end - start])
        return b"".join(parts)

    def _load(self, start: int, size: int) -> bytes:
        """Return a part, which is loaded unless it is kept."""
        if size <= 0:
            return b""
        with self._lock:
            if (kept := self._parts.get((start, size))) is not None:
                self._parts.move_to_end((start, size))
                return kept
        data: bytes = self._request(lambda: self._system.cat_file(self._inner, start=start, end=start + size))
        if len(data) != size:
            raise UserError(
                f"{self._name}: the server gave {len(data)} bytes where {size} were asked for: it does not "
                "serve parts of files; download it"
            )
        with self._lock:
            if (start, size) not in self._parts:
                self._parts[start, size] = data
                self._kept += size
            while self._kept > CACHE and len(self._parts) > 1:
                self._kept -= len(self._parts.popitem(last=False)[1])
        return data

    def _request(self, request: Any) -> Any:
        """Return what a request gives. A failure of the network is tried again."""
        tries = 1 if self._protocol in PACKAGES else TRIES  # the packages for storage try again themselves
        for number in range(1, tries + 1):
            try:
                return request()
            except FileNotFoundError:
                raise UserError(f"{self._name}: there is no such file at this address") from None
            except PermissionError:
                raise UserError(f"{self._name}: the server permits no reading of it") from None
            except Exception as error:  # each protocol's package has errors of its own
                if type(error).__name__ in NO_CREDENTIALS:
                    raise UserError(
                        f"{self._name}: no credentials for {self._protocol}://: set AWS_PROFILE, or "
                        "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY; for a public bucket FSSPEC_S3_ANON=true"
                    ) from None
                if number == tries:
                    # The text of an error may hold the address with its signature.
                    raise UserError(
                        f"{self._name}: cannot be read over the network ({type(error).__name__})"
                    ) from error
                time.sleep(PAUSE * number)
        raise AssertionError
