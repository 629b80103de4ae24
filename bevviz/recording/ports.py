"""Addresses and ports: choose them, check them, and build URLs."""

from __future__ import annotations

import socket
from ipaddress import IPv6Address, ip_address
from urllib.parse import quote

from bevviz.errors import UserError

LOOPBACK = "127.0.0.1"
FIRST_DATA_PORT = 9876  # Rerun's own default


def own_address(bind: str) -> str:
    """Resolve ``--bind`` to a numeric address of this machine.

    Raises:
        UserError: it is no address of this machine.
    """
    try:
        infos = socket.getaddrinfo(bind or LOOPBACK, 0, type=socket.SOCK_STREAM)
        address = str(infos[0][4][0])
        with socket.socket(infos[0][0]) as probe:
            probe.bind((address, 0))
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise UserError(
            f"--bind {bind}: no address of this machine ({reason}); 0.0.0.0: all of them"
        ) from None
    return address


def is_loopback(address: str) -> bool:
    """Return whether other machines cannot reach the address."""
    return ip_address(address).is_loopback


def host_for(address: str) -> str:
    """Return the host name or address that a browser or viewer uses to reach the address."""
    if is_loopback(address):
        return "localhost" if address in (LOOPBACK, "::1") else address
    if ip_address(address).is_unspecified:
        return socket.gethostname()
    return f"[{address}]" if isinstance(ip_address(address), IPv6Address) else address


def allowed_origins(address: str, port: int) -> list[str]:
    """Return the origins of web pages that may read the data: pages served from the same machine.

    Rerun adds localhost itself. An unspecified address allows any host name, because not every name of the
    machine is known.
    """
    if is_loopback(address):
        return [] if address in (LOOPBACK, "::1") else [f"http://{address}:{port}"]
    if ip_address(address).is_unspecified:
        return [f"http://*:{port}"]
    return [f"http://{host_for(address)}:{port}"]


def viewer_address(host: str, port: int, data_port: int) -> str:
    """Return the URL of the web viewer."""
    return f"http://{host}:{port}/?url={quote(f'rerun+http://{host}:{data_port}/proxy', safe='')}"


def is_listening(host: str, port: int) -> bool:
    """Return whether a server listens at the port."""
    try:
        socket.create_connection((host, port), timeout=5).close()
    except OSError:
        return False
    return True


def check_port(port: int, option: str = "--serve") -> None:
    """Raise UserError with the next free port if this port is in use."""
    if not _is_free(port):
        raise UserError(f"{option} {port}: the port is in use; another one: {option} {free_port(port + 1)}")


def free_port(port: int, but: int = 0) -> int:
    """Return the port, or the next free port. ``but`` is excluded."""
    return next(candidate for candidate in range(port, 65536) if candidate != but and _is_free(candidate))


def _is_free(port: int) -> bool:
    """Return whether the port is free at every address. A name such as localhost may mean several."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("", port))
        except OSError:
            return False
    return True
