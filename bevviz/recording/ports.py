"""Addresses and ports: at which we listen, and whether somebody else does."""

from __future__ import annotations

import socket
from ipaddress import IPv6Address, ip_address
from urllib.parse import quote

from bevviz.errors import UserError

LOOPBACK = "127.0.0.1"
FIRST_DATA_PORT = 9876  # Rerun's own default


def own_address(bind: str) -> str:
    """The numeric address of this machine that ``--bind`` means.

    Raises:
        UserError: it is none.
    """
    try:
        found = socket.getaddrinfo(bind or LOOPBACK, 0, type=socket.SOCK_STREAM)
        address = str(found[0][4][0])
        with socket.socket(found[0][0]) as probe:
            probe.bind((address, 0))
    except (OSError, UnicodeError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise UserError(f"--bind {bind}: no address of this machine ({why}); 0.0.0.0: all of them") from None
    return address


def is_loopback(address: str) -> bool:
    return ip_address(address).is_loopback


def host_for(address: str) -> str:
    """How a browser or a viewer calls who listens there."""
    if is_loopback(address):
        return "localhost" if address in (LOOPBACK, "::1") else address
    if ip_address(address).is_unspecified:
        return socket.gethostname()
    return f"[{address}]" if isinstance(ip_address(address), IPv6Address) else address


def origins(address: str, port: int) -> list[str]:
    """Which pages a browser may let at the data: those that are served beside it.

    Rerun itself adds those of localhost. Of all addresses of a machine nobody knows every name.
    """
    if is_loopback(address):
        return [] if address in (LOOPBACK, "::1") else [f"http://{address}:{port}"]
    if ip_address(address).is_unspecified:
        return [f"http://*:{port}"]
    return [f"http://{host_for(address)}:{port}"]


def viewer_address(host: str, port: int, data_port: int) -> str:
    """What to open in a browser."""
    return f"http://{host}:{port}/?url={quote(f'rerun+http://{host}:{data_port}/proxy', safe='')}"


def answers(host: str, port: int) -> bool:
    """Whether somebody listens there."""
    try:
        socket.create_connection((host, port), timeout=5).close()
    except OSError:
        return False
    return True


def check_port(port: int, option: str = "--serve") -> None:
    """Raises UserError with a free port where this one is in use."""
    if not _is_free(port):
        raise UserError(f"{option} {port}: the port is in use; another one: {option} {free_port(port + 1)}")


def free_port(port: int, but: int = 0) -> int:
    """The port, or the next one that is free."""
    return next(p for p in range(port, 65536) if p != but and _is_free(p))


def _is_free(port: int) -> bool:
    """At every address: a name such as localhost may mean several."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("", port))
        except OSError:
            return False
    return True
