"""Bags on a web server or in object storage, of which only the parts that are needed are loaded (fsspec)."""

from __future__ import annotations

import re
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path, PurePosixPath
from threading import Lock
from typing import Any
from urllib.parse import unquote, urljoin, urlsplit

from bevviz.bags.reader import FileBytes
from bevviz.errors import UserError, first_line
from bevviz.support.limits import MAX_REDIRECTS, MAX_REQUEST

_ADDRESS = re.compile(r"(https?|s3|gs|gcs|az|abfs):/+(?=[^/])")  # a Path has one slash of two
PART = 1 << 16  # bytes loaded at least: many records of an index lie in one part
CACHE = 1 << 26  # bytes kept in memory
TIMEOUT = 20.0  # seconds without a byte after which a request is given up
LEAST_RATE = 10_000  # bytes per second of a whole request, after the first ``TIMEOUT`` seconds
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


class _RefusedError(Exception):
    """An answer of a server that is not used. The text ends a sentence."""


class RemoteBytes(FileBytes):
    """Bytes of a file at an address, by ranges. The latest ones are kept in memory.

    The caches of fsspec either keep one stretch of the file (``BytesCache``), or ask for each of their blocks
    by a request of its own (``BlockCache``), which is 65 requests instead of one for a chunk of 4 MB.

    Raises:
        UserError: the file cannot be reached or read by ranges, the server is too slow or does not give what
            was asked for, or a package for its protocol is missing.
    """

    def __init__(self, path: Path) -> None:
        self._address, self._name = address_of(path), name_of(path)
        self._protocol = self._address.partition(":")[0]
        self._parts: OrderedDict[tuple[int, int], bytes] = OrderedDict()
        self._kept = 0
        self._lock = Lock()
        self._is_web = self._protocol in ("http", "https")
        # Without automatic decompression, a body has no more bytes in memory than on the wire.
        options = {"client_kwargs": {"auto_decompress": False}} if self._is_web else {}
        try:
            import fsspec

            self._system, self._inner = fsspec.core.url_to_fs(self._address, **options)
        except ImportError:
            also = f" {PACKAGES[self._protocol]}" if self._protocol in PACKAGES else ""
            raise UserError(
                f"{self._name}: reading {self._protocol}:// needs more packages: "
                f"pip install 'bevviz[remote]'{also}"
            ) from None
        except ValueError as error:
            raise UserError(f"{self._name}: {first_line(error)}") from None
        self._latest = 0, b""
        if self._is_web:
            self.size = self._request(lambda: self._web_range(0, 1))[1]
            return
        size = self._request(lambda: self._stored("info", 0))["size"]
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
        if size > MAX_REQUEST:
            raise UserError(
                f"{self._name}: it asks for {size:,} bytes at once, more than {MAX_REQUEST:,}: download it"
            )
        if self._is_web:
            data: bytes = self._request(lambda: self._web_range(start, size))[0]
        else:
            data = self._request(lambda: self._stored("cat_file", size, start=start, end=start + size))
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

    def _stored(self, method: str, size: int, **arguments: int) -> Any:
        """Call a method of a file system of fsspec, which ends in time if the file system is asynchronous."""
        if not getattr(self._system, "async_impl", False):
            return getattr(self._system, method)(self._inner, **arguments)
        from fsspec.asyn import sync

        function = getattr(self._system, f"_{method}")
        return sync(self._system.loop, function, self._inner, timeout=_longest(size), **arguments)

    def _web_range(self, start: int, size: int) -> tuple[bytes, int]:
        """Return a range of a file on a web server, and the size of the file."""
        from fsspec.asyn import sync

        result: tuple[bytes, int] = sync(self._system.loop, self._fetch, start, size)
        return result

    async def _fetch(self, start: int, size: int) -> tuple[bytes, int]:
        """Ask for a range, and read no more than was asked for.

        Redirects are followed here, because aiohttp would follow one from a public server to a page of this
        machine or of its network.

        Raises:
            _RefusedError: the answer is another than asked for.
        """
        from aiohttp import ClientTimeout

        session, url = await self._system.set_session(), self._address
        limits = ClientTimeout(total=_longest(size), sock_connect=TIMEOUT, sock_read=TIMEOUT)
        options: dict[str, Any] = {"allow_redirects": False, "timeout": limits}
        options["headers"] = {"Range": f"bytes={start}-{start + size - 1}", "Accept-Encoding": "identity"}
        for _ in range(1 + MAX_REDIRECTS):
            async with session.get(self._system.encode_url(url), **options) as answer:
                if answer.status in (301, 302, 303, 307, 308) and "Location" in answer.headers:
                    url = _redirected(url, answer.headers["Location"])
                    continue
                total = _check_answer(answer.status, answer.headers, start)
                data = bytearray()
                while len(data) <= size and (part := await answer.content.readany()):
                    data += part
                if len(data) > size:
                    raise _RefusedError("gives more bytes than were asked for")
                return bytes(data), total
        raise _RefusedError(f"redirects more than {MAX_REDIRECTS} times")

    def _request(self, request: Callable[[], Any]) -> Any:
        """Return what a request gives. A failure of the network is tried again."""
        tries = 1 if self._protocol in PACKAGES else TRIES  # the packages for storage try again themselves
        for number in range(1, tries + 1):
            try:
                return request()
            except _RefusedError as error:
                raise UserError(f"{self._name}: the server {error}: download it") from None
            except TimeoutError:
                raise UserError(
                    f"{self._name}: the server is too slow: it sent nothing for {TIMEOUT:g} s, or less than "
                    f"{LEAST_RATE // 1000} kB per second: download it"
                ) from None
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


def _longest(size: int) -> float:
    """Return the seconds in which a request for ``size`` bytes has to end."""
    return TIMEOUT + size / LEAST_RATE


def _redirected(url: str, location: str) -> str:
    """Return the address that a redirect leads to.

    Raises:
        _RefusedError: the address is neither encrypted nor on the same server. It could be a page of this
            machine or of its network, which the server itself cannot reach.
    """
    target = urljoin(url, location)
    old, new = urlsplit(url), urlsplit(target)
    if new.scheme != "https" and (new.scheme, new.netloc) != (old.scheme, old.netloc):
        raise _RefusedError("redirects to an address that is neither https:// nor its own")
    return target


def _check_answer(status: int, headers: Mapping[str, str], start: int) -> int:
    """Check the head of an answer to a request for a range. Return the size of the whole file.

    Raises:
        _RefusedError: it is no uncompressed part of a file that begins at ``start``.
        FileNotFoundError: there is no such file.
        PermissionError: the file may not be read.
        ConnectionError: another failure, which may pass.
    """
    if status in (404, 410):
        raise FileNotFoundError
    if status in (401, 403):
        raise PermissionError
    if status == 200:
        raise _RefusedError("does not serve parts of files")
    if status != 206:
        raise ConnectionError(f"status {status}")
    if headers.get("Content-Encoding", "identity") not in ("", "identity"):
        raise _RefusedError("sends compressed bytes where plain ones were asked for")
    stated = re.fullmatch(r"bytes (\d{1,19})-\d{1,19}/(\d{1,19})", headers.get("Content-Range", ""))
    if stated is None:
        raise _RefusedError("does not state the size of the file")
    if int(stated[1]) != start:
        raise _RefusedError("gives another part of the file than was asked for")
    return int(stated[2])
