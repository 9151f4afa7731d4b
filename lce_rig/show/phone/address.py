"""Where the page is served: addresses as people write them, the socket, and the links that lead there."""

import errno
import fcntl
import ipaddress
import socket
import struct

from lce_rig.core.errors import UsageError

LOOPBACK = "127.0.0.1"
DEFAULT_PORT = 8765

_HINT = (
    "--preview takes HOST:PORT, HOST or PORT, such as 0.0.0.0:8765, [::1]:8765 or 8080. "
    "Give the session before it: lce-rig collect --rig R session/ --preview"
)
# linux/sockios.h; Python names neither.
_SIOCGIFADDR = 0x8915
_INTERFACE = struct.Struct("16s20s")


def parse_address(text: str) -> tuple[str, int]:
    """Take an address apart: "host:port", "host", "port", ":port", "[ipv6]:port", "ipv6".

    Args:
        text: by default this computer alone, port 8765.

    Returns:
        Host without brackets, and port; port 0 is any free one.

    Raises:
        UsageError: it is none of these.
    """
    text = text.strip()
    if text.startswith("["):
        host, closing, rest = text[1:].partition("]")
        if not closing or (rest and not rest.startswith(":")) or not _is_ipv6(host):
            raise UsageError(f"{text!r} is no address for a page", _HINT)
        return host, _port(rest[1:], text)
    if _is_ipv6(text):
        return text, DEFAULT_PORT
    host, separator, port = text.partition(":")
    if not separator and _is_number(text):
        host, port = "", text
    if ":" in port or "/" in host or any(character.isspace() for character in text):
        raise UsageError(f"{text!r} is no address for a page", _HINT)
    return host or LOOPBACK, _port(port, text)


def listen(host: str, port: int) -> socket.socket:
    """Open a socket that listens; on all addresses of both kinds where `host` is "::".

    Raises:
        UsageError: the port is in use or not permitted, or the host is not this computer.
    """
    try:
        family, _, _, _, where = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        is_dual = family == socket.AF_INET6 and host == "::" and socket.has_dualstack_ipv6()
        return socket.create_server(where[:2], family=family, dualstack_ipv6=is_dual)
    except (OSError, UnicodeError) as error:
        raise _explained(host, port, error) from None


def is_loopback(opened: socket.socket) -> bool:
    """Return whether only programs on this computer reach a socket."""
    return ipaddress.ip_address(_bound_to(opened)).is_loopback


def links(opened: socket.socket, token: str | None) -> tuple[str, ...]:
    """Build the links under which a page can be opened, the likeliest first.

    Where the socket listens on all addresses, there is one for each IPv4 address of this computer: which of
    its networks a phone is in cannot be known.

    Args:
        opened: the listening socket.
        token: part of the link; None where none is needed.
    """
    host, port = _bound_to(opened), opened.getsockname()[1]
    hosts = [host]
    if ipaddress.ip_address(host).is_unspecified:
        hosts = _own_addresses() or [f"{socket.gethostname()}.local"]
    query = f"?token={token}" if token else ""
    return tuple(f"http://{bracketed(each)}:{port}/{query}" for each in hosts)


def bracketed(host: str) -> str:
    """Write a host as it stands in a link: IPv6 addresses in brackets."""
    return f"[{host}]" if ":" in host else host


def _bound_to(opened: socket.socket) -> str:
    # A link-local address may carry its interface: fe80::1%eth0.
    return str(opened.getsockname()[0]).partition("%")[0]


def _own_addresses() -> list[str]:
    """List the IPv4 addresses of this computer's networks, that of the default route first."""
    found = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            # Chooses a route without sending anything (TEST-NET-1, RFC 5737).
            probe.connect(("192.0.2.1", 9))
            found.append(str(probe.getsockname()[0]))
        except OSError:
            pass  # no default route, as with a computer that is the access point itself
        for _, name in socket.if_nameindex():
            request = _INTERFACE.pack(name.encode(), b"")
            try:
                answer = fcntl.ioctl(probe.fileno(), _SIOCGIFADDR, request)
            except OSError:
                continue  # an interface without an IPv4 address
            found.append(socket.inet_ntoa(answer[20:24]))
    return [each for each in dict.fromkeys(found) if not ipaddress.ip_address(each).is_loopback]


def _port(text: str, whole: str) -> int:
    if not text:
        return DEFAULT_PORT
    if not _is_number(text) or int(text) > 65535:
        raise UsageError(f"{whole!r} is no address for a page: {text!r} is no port", _HINT)
    return int(text)


def _is_number(text: str) -> bool:
    return text.isascii() and text.isdigit() and len(text) <= 5


def _is_ipv6(text: str) -> bool:
    try:
        ipaddress.IPv6Address(text)
    except ValueError:
        return False
    return True


def _explained(host: str, port: int, error: OSError | UnicodeError) -> UsageError:
    """Say why a page cannot be served at an address, and what to do about it."""
    where = f"{bracketed(host)}:{port}"
    number = getattr(error, "errno", None)
    if number == errno.EADDRINUSE:
        return UsageError(
            f"the page cannot be served at {where}: the port is in use",
            f"Another collection may be running: `ss -ltnp sport = :{port}` names it. "
            f"Or choose another port: --preview {bracketed(host)}:{min(port + 1, 65535)}.",
        )
    if number in (errno.EACCES, errno.EPERM):
        hint = f"Ports below 1024 need root: --preview {bracketed(host)}:{DEFAULT_PORT}."
        return UsageError(f"the page cannot be served at {where}: not permitted", hint)
    if number == errno.EADDRNOTAVAIL or isinstance(error, (socket.gaierror, UnicodeError)):
        hint = "`hostname -I` lists this computer's addresses; 0.0.0.0 stands for all of them."
        return UsageError(f"the page cannot be served at {where}: not an address of this computer", hint)
    return UsageError(f"the page cannot be served at {where}: {error}", _HINT)
