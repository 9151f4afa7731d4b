"""Who may see the page: whoever has the link, and no page of another site on their behalf."""

import hmac
import ipaddress
import re
import secrets
import socket
from collections.abc import Callable

from aiohttp import web
from aiohttp.typedefs import Handler, Middleware

from lce_rig.core.errors import UsageError

# 72 bits: beyond guessing, and can still be typed into a phone.
_TOKEN_BYTES = 9
_TOKEN = re.compile(r"[A-Za-z0-9_-]{8,128}")


def new_token() -> str:
    """Draw a token."""
    return secrets.token_urlsafe(_TOKEN_BYTES)


def check_token(token: str) -> str:
    """Accept a token that was chosen by hand.

    Raises:
        UsageError: it is too short, or would not survive in a link.
    """
    if not _TOKEN.fullmatch(token):
        raise UsageError("the page's token cannot be used", "Take 8 to 128 letters, digits, '-' or '_'.")
    return token


class Gate:
    """Refuses requests before anything answers them.

    Three things are asked for. The Host must be an address or a name of this computer: a site that has its
    own name resolve to this computer (DNS rebinding) sends that name. The Origin, where the browser sends
    one, must be this page: otherwise any site could open the connection to a page without a token. And the
    token, where there is one, from the link or from the cookie that the link left.

    Args:
        port: of this page; cookies are shared between the ports of a host, so it is part of their name.
        token: None where none is needed.
        host: as which the page was bound.
    """

    def __init__(self, port: int, token: str | None, host: str) -> None:
        self._token = token
        self._cookie = f"lce_rig_preview_{port}"
        self._own = socket.gethostname().lower().partition(".")[0]
        self._names = {"localhost", host.lower(), self._own, f"{self._own}.local"}

    def refusal(self, request: web.Request) -> str | None:
        """Say why a request is refused, None where it is not."""
        if not self._is_own_name(_host_name(request.host)):
            return "This page is served under its own address only."
        origin = request.headers.get("Origin")
        if origin is not None and origin != f"http://{request.host}":
            return "This page shows nothing to other sites."
        if self._token is not None and not self._has_token(request):
            return "This page needs the whole link that lce-rig shows, with its token."
        return None

    def remember(self, request: web.Request, response: web.StreamResponse) -> None:
        """Leave the token that came in the link as a cookie, for what the page loads next."""
        if self._token is not None and "token" in request.query:
            # Lax: a link opened from another program or site must work at the first click.
            response.set_cookie(self._cookie, self._token, httponly=True, samesite="Lax", path="/")

    def _has_token(self, request: web.Request) -> bool:
        assert self._token is not None
        wanted = self._token.encode()
        given = (request.query.get("token", ""), request.cookies.get(self._cookie, ""))
        # In constant time, so that a wrong token does not tell how much of it is right.
        return any(hmac.compare_digest(each.encode(errors="replace"), wanted) for each in given)

    def _is_own_name(self, name: str) -> bool:
        try:
            ipaddress.ip_address(name)
        except ValueError:
            name = name.lower()
            # Networks append their own ending to a computer's name, unknown to this computer. A site could
            # take that name, but not the token.
            return name in self._names or (self._token is not None and name.partition(".")[0] == self._own)
        return True


def guarded(gate: Gate, welcome: Callable[[web.Request], None]) -> Middleware:
    """Build the middleware that puts a gate before every request, unknown paths included.

    Args:
        gate: refuses requests.
        welcome: called for every request that it lets in.
    """

    @web.middleware
    async def guard(request: web.Request, handler: Handler) -> web.StreamResponse:
        refusal = gate.refusal(request)
        if refusal is not None:
            answer = web.Response(status=403, text=refusal + "\n")
            # Without the connection, strangers ask no faster than they are accepted.
            answer.force_close()
            return answer
        welcome(request)
        return await handler(request)

    return guard


def _host_name(host: str) -> str:
    """Take the port, and an IPv6 address's brackets, off a Host header."""
    if host.startswith("["):
        return host[1:].partition("]")[0]
    return host.partition(":")[0]
