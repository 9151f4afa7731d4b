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
    refusal = UsageError(f"{text!r} is no address for a page", _HINT)
    host, port = text, ""
    if text.startswith("["):
        host, closing, rest = text[1:].partition("]")
        if not closing or not _is_ipv6(host) or (rest and not rest.startswith(":")):
            raise refusal
        port = rest[1:]
    elif not _is_ipv6(text):
        host, separator, port = text.partition(":")
        if not separator and text.isdecimal():
            host, port = "", text
        if "/" in host or any(character.isspace() for character in text):
            raise refusal
    if port and not (port.isascii() and port.isdigit() and int(port[:6]) <= 65535):
        raise refusal
    return host or LOOPBACK, int(port or DEFAULT_PORT)


def listen(host: str, port: int) -> socket.socket:
    """Open a socket that listens; on all addresses of both kinds where `host` is "::".

    Raises:
        UsageError: the port is in use or not permitted, or the host is not this computer.
    """
    address = f"{_bracketed(host)}:{port}"
    try:
        family, _, _, _, where = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        is_dual = family == socket.AF_INET6 and host == "::" and socket.has_dualstack_ipv6()
        return socket.create_server(where[:2], family=family, dualstack_ipv6=is_dual)
    except (OSError, UnicodeError) as error:
        number, why, hint = getattr(error, "errno", None), str(error), _HINT
        if number == errno.EADDRINUSE:
            other = f"{_bracketed(host)}:{min(port + 1, 65535)}"
            why = "the port is in use"
            hint = (
                f"Another collection may be running: `ss -ltnp sport = :{port}` names it. "
                f"Or choose another port: --preview {other}."
            )
        elif number in (errno.EACCES, errno.EPERM):
            why = "not permitted"
            hint = f"Ports below 1024 need root: --preview {_bracketed(host)}:{DEFAULT_PORT}."
        elif number == errno.EADDRNOTAVAIL or isinstance(error, (socket.gaierror, UnicodeError)):
            why = "not an address of this computer"
            hint = "`hostname -I` lists this computer's addresses; 0.0.0.0 stands for all of them."
        raise UsageError(f"the page cannot be served at {address}: {why}", hint) from None


def links(opened: socket.socket, token: str) -> tuple[str, ...]:
    """Build the links under which a page can be opened, the likeliest first.

    Where the socket listens on all addresses, there is one for each IPv4 address of this computer: which of
    its networks a phone is in cannot be known.
    """
    # A link-local address may carry its interface: fe80::1%eth0.
    host, port = str(opened.getsockname()[0]).partition("%")[0], opened.getsockname()[1]
    hosts = [host]
    if ipaddress.ip_address(host).is_unspecified:
        hosts = _network_addresses() or [f"{socket.gethostname()}.local"]
    return tuple(f"http://{_bracketed(host)}:{port}/?token={token}" for host in hosts)


def _network_addresses() -> list[str]:
    """List the IPv4 addresses of this computer's networks, that of the default route first."""
    addresses = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            # Chooses a route without sending anything (TEST-NET-1, RFC 5737).
            probe.connect(("192.0.2.1", 9))
            addresses.append(str(probe.getsockname()[0]))
        except OSError:
            pass  # no default route, as with a computer that is the access point itself
        for _, name in socket.if_nameindex():
            request = _INTERFACE.pack(name.encode(), b"")
            try:
                answer = fcntl.ioctl(probe.fileno(), _SIOCGIFADDR, request)
            except OSError:
                continue  # an interface without an IPv4 address
            addresses.append(socket.inet_ntoa(answer[20:24]))
    return [each for each in dict.fromkeys(addresses) if not ipaddress.ip_address(each).is_loopback]


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _is_ipv6(text: str) -> bool:
    try:
        ipaddress.IPv6Address(text)
    except ValueError:
        return False
    return True
