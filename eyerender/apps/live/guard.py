"""The guard in front of the live page, which decides which requests reach the server.

Every program of the machine can reach a server on 127.0.0.1, and so can every page in a browser on it. So the guard
passes a request only if all of the following holds, for HTTP and WebSockets alike:

- Its path begins with the token, 256 random bits that are printed once and change with every start. No cookie is
  used, because a browser sends cookies to all ports of a host, also to the server of another user.
- Its `Host` is a name of this machine's loopback. A page that had its own name resolved to 127.0.0.1 (DNS rebinding)
  sends its own name. The port is not compared, because SSH may forward another one.
- Its `Origin`, if it has one, is the page's own: `http://` and the same host. A WebSocket and a request that changes
  something must have one.
- `Sec-Fetch-Site`, if a browser sends it, does not name another site, except for opening the page itself by a link.
"""

from __future__ import annotations

import re
import secrets
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

_LOOPBACK = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:\d{1,5})?", re.IGNORECASE | re.ASCII)
_READING = ("GET", "HEAD")
# Headers of a proxy could change what the server takes for its own address.
_DROPPED = (b"x-forwarded-prefix", b"x-forwarded-host", b"x-forwarded-proto", b"x-forwarded-for", b"forwarded")
_HEADERS = [
    (b"referrer-policy", b"no-referrer"),  # the token is in the address
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"content-security-policy", b"frame-ancestors 'none'; base-uri 'none'; form-action 'none'; object-src 'none'"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
]


def new_token() -> str:
    """Create a random URL-safe token of 256 bits."""
    return secrets.token_urlsafe(32)


class Guard:
    """An ASGI application that forwards permitted requests to another one and refuses all others.

    Args:
        app: the application behind the guard. It sees paths with the token as its root path.
        token: the token with which the path of every request must begin.
    """

    def __init__(self, app: App, token: str) -> None:
        self._app = app
        self._token = token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Forward a request, or refuse it."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        reason = self.refusal(scope)
        if reason is not None:
            await _refuse(scope, receive, send, reason)
            return
        headers = [(name, value) for name, value in scope["headers"] if name.lower() not in _DROPPED]
        await self._app({**scope, "headers": headers, "root_path": f"/{self._token}"}, receive, _hardened(send))

    def refusal(self, scope: Scope) -> str | None:
        """Return why a request is refused; None if it may pass."""
        headers: dict[bytes, list[str]] = {}
        for name, value in scope["headers"]:
            headers.setdefault(name.lower(), []).append(value.decode("latin-1"))
        hosts, origins = headers.get(b"host", []), headers.get(b"origin", [])
        if len(hosts) != 1 or not _LOOPBACK.fullmatch(hosts[0]):
            return "the Host of the request is not this machine's loopback"
        if not self._knows_token(scope["path"]):
            return "the address lacks its token; open the address that the command printed"
        reading = scope["type"] == "http" and scope["method"] in _READING
        if len(origins) > 1 or (not origins and not reading):
            return "the request has no Origin"
        if origins and origins[0].lower() != f"http://{hosts[0].lower()}":
            return "the request comes from a page of another origin"
        site = headers.get(b"sec-fetch-site", ["none"])[-1]
        opening = reading and headers.get(b"sec-fetch-mode", [""])[-1] == "navigate"
        if site not in ("same-origin", "none") and not opening:
            return "the request comes from a page of another site"
        return None

    def _knows_token(self, path: str) -> bool:
        first = path.removeprefix("/").partition("/")[0]
        return secrets.compare_digest(first.encode(), self._token.encode())


def _hardened(send: Send) -> Send:
    """Add headers to each response that keep other pages from reading it."""

    async def sending(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            names = {name for name, _ in _HEADERS}
            kept = [(name, value) for name, value in message.get("headers", []) if name.lower() not in names]
            message = {**message, "headers": [*kept, *_HEADERS]}
        await send(message)

    return sending


async def _refuse(scope: Scope, receive: Receive, send: Send, reason: str) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": 1008})  # before it is accepted: the server answers 403
        return
    body = f"403: {reason}\n".encode()
    headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"content-length", str(len(body)).encode()), *_HEADERS]
    await send({"type": "http.response.start", "status": 403, "headers": headers})
    await send({"type": "http.response.body", "body": body})
