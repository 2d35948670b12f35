"""Who may ask the page for anything: one wall in front of every request and every websocket, and
how long a request's head is awaited (:class:`Patient`).

An ASGI application around another. It refuses, in this order,

1. a Host that this page does not have (a name that was made to lead here: DNS rebinding);
2. an Origin that is not this page's own, a websocket or a change (POST, ...) without one, and what
   a browser marks as asked for by another site (Sec-Fetch-Site);
3. whoever lacks the cookie. It is given for the token in an address, which is good for one browser
   and leaves the address bar at once, or for the password, which is asked for on every host but
   this machine's own; some wrong passwords make everybody wait;
4. a body longer than allowed, whatever its header says, while it arrives; or one that does not end.

and gives every answer the headers of :data:`HEADERS`. After OWASP's cheat sheets (cross-site
request forgery, session management, HTTP headers, websockets). What the password and all else is
carried by is plain HTTP: docs/bench.md says how to use it from afar.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import html
import math
import re
import secrets
import time
from collections.abc import Awaitable, Callable, Mapping, MutableMapping, Sequence
from typing import Any, TypeAlias
from urllib.parse import parse_qs, quote, urlencode

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import cookie_parser
from starlette.responses import Response
from uvicorn.protocols.http.auto import AutoHTTPProtocol

Scope: TypeAlias = MutableMapping[str, Any]
Message: TypeAlias = MutableMapping[str, Any]
Receive: TypeAlias = Callable[[], Awaitable[Message]]
Send: TypeAlias = Callable[[Message], Awaitable[None]]
App: TypeAlias = Callable[[Scope, Receive, Send], Awaitable[None]]

MOST_UPLOAD = 64 * 2**20
"""Bytes of a request."""
MOST_LOGIN = 4096
"""Bytes of the form with the password."""
LONGEST_UPLOAD = 300.0
"""Seconds for a request's body to arrive."""
LONGEST_LOGIN = 10.0
"""Seconds for the form with the password."""
TRIES = 5
"""Wrong passwords before the next must wait, and so on."""
WAIT = 30.0
"""Seconds to wait then."""
LONGEST_HEAD = 10.0
"""Seconds for a request's head to arrive."""
MOST_HEAD = 256 * 1024
"""Bytes of it."""
MOST_CONNECTIONS = 200
"""At once."""

# Vue compiles templates in the browser, and the framework's page holds scripts of its own: both are
# allowed, scripts from elsewhere are not.
POLICY = (
    "default-src 'none'; script-src 'self' 'nonce-{nonce}' 'unsafe-eval'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
    "connect-src 'self' {sockets}; frame-src {frames}; worker-src 'self' blob:; "
    "manifest-src 'self'; form-action 'self'; "
    "base-uri 'none'; frame-ancestors 'none'; object-src 'none'"
)
HEADERS = {
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), microphone=(), geolocation=(), payment=(), usb=()",
    "x-robots-tag": "noindex",
}
"""Of every answer, besides the content security policy."""

_LOCAL = ("127.0.0.1", "localhost")


def allowed_hosts(host: str, port: int, names: Sequence[str] = ()) -> frozenset[str]:
    """What a Host header may say: the address that the page is bound to, and further ``names``."""
    hosts = [*_LOCAL, *names] if host in _LOCAL else [host, *names]
    return frozenset(f"{name.lower()}:{port}" for name in hosts)


class Guard:
    """The wall around ``app``.

    hosts : of :func:`allowed_hosts`. password : asked for; without one :meth:`ticket` is the way
    in. name : of the cookie (ports share cookies, so the port is in it). most : bytes of a request.
    longest : seconds for them to arrive. framed : port of another page of ours that may be framed.
    """

    def __init__(
        self,
        app: App,
        *,
        hosts: frozenset[str],
        password: str | None = None,
        name: str = "pam_ocp_bench",
        most: int = MOST_UPLOAD,
        longest: float = LONGEST_UPLOAD,
        framed: int | None = None,
    ) -> None:
        self._app, self._hosts, self._name, self._most = app, hosts, name, most
        self._longest, self._password, self._framed = longest, password, framed
        self._tickets: dict[str, Callable[[], None]] = {}
        self._key = secrets.token_urlsafe(32)
        self._origins = frozenset(f"http://{host}" for host in hosts)
        self._wrong, self._open_at = 0, 0.0

    def ticket(self, used: Callable[[], None] = lambda: None) -> str:
        """A token, which lets one browser in. used : called when it has."""
        token = secrets.token_urlsafe(32)
        self._tickets[token] = used
        return token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        refusal = self._refusal(scope, headers)
        if scope["type"] == "websocket":
            if refusal or not self._known(headers):
                await receive()
                await send({"type": "websocket.close", "code": 1008})
                return
            await self._app(scope, receive, send)
            return
        if refusal:
            await self._say(send, 403, refusal)
        elif await self._entered(scope, send):
            return
        elif not self._known(headers):
            await self._admit(scope, receive, send)
        else:
            await self._pass(scope, headers, receive, send)

    # ---- who asks ------------------------------------------------------------------------------
    def _refusal(self, scope: Scope, headers: Headers) -> str:
        """Why not, by the headers alone; "" where nothing is wrong."""
        hosts, origins = headers.getlist("host"), headers.getlist("origin")
        if len(hosts) != 1 or hosts[0].lower() not in self._hosts:
            return "this page does not answer to that host"
        if any(origin.lower() not in self._origins for origin in origins) or len(origins) > 1:
            return "this page answers to itself only"
        changing = scope["type"] == "websocket" or scope["method"] not in ("GET", "HEAD")
        if changing and not origins:
            return "this asks for a change and does not say from where"
        site = headers.get("sec-fetch-site", "none")
        if site not in ("same-origin", "none") and (
            changing or headers.get("sec-fetch-mode", "") != "navigate"
        ):
            return "this page answers to itself only"
        return ""

    def _known(self, headers: Headers) -> bool:
        there = cookie_parser("; ".join(headers.getlist("cookie"))).get(self._name, "")
        return _same(there, self._key)

    async def _entered(self, scope: Scope, send: Send) -> bool:
        """The cookie for a token, if there is one: it is used up."""
        asked = parse_qs(scope.get("query_string", b"").decode("latin-1"), max_num_fields=20)
        given = asked.pop("token", [""])[0]
        there = [t for t in self._tickets if _same(given, t)]
        path = "/" + quote(scope["path"].lstrip("/\\"))  # never another host
        path += f"?{urlencode(asked, True)}" if asked else ""
        if not there or scope["method"] != "GET":
            return False
        self._tickets.pop(there[0])()
        # no redirection: behind one that a file led to, browsers keep the cookie back
        await self._say(send, 200, "one moment", {**self._cookie, "refresh": f"0;url={path}"})
        return True

    async def _admit(self, scope: Scope, receive: Receive, send: Send) -> None:
        """The cookie for the password; a refusal, or the form, for all else."""
        if self._password is None:
            await self._say(
                send, 401, "open the address that pam-ocp bench printed last; each is good once"
            )
            return
        if scope["method"] == "POST" and scope["path"] == "/login":
            await self._log_in(receive, send)
        elif scope["method"] == "GET" and scope["path"] in ("/", "/login"):
            await self._form(send, 200, "")
        else:
            await self._say(send, 401, "give the password first")

    async def _log_in(self, receive: Receive, send: Send) -> None:
        assert self._password is not None
        try:
            body = await asyncio.wait_for(_body(receive, MOST_LOGIN), LONGEST_LOGIN)
        except asyncio.TimeoutError:
            await self._form(send, 408, "that took too long")
            return
        if time.monotonic() < self._open_at:
            await self._form(send, 429, "too many wrong passwords; wait half a minute")
            return
        given = parse_qs((body or b"").decode("utf-8", "replace"), max_num_fields=5)
        if _same(given.get("password", [""])[0], self._password):
            self._wrong = 0
            await self._say(send, 303, "", {**self._cookie, "location": "/"})
            return
        self._wrong += 1
        if self._wrong % TRIES == 0:
            self._open_at = time.monotonic() + WAIT
        await asyncio.sleep(0.5)
        await self._form(send, 401, "that is not the password")

    @property
    def _cookie(self) -> dict[str, str]:
        return {"set-cookie": f"{self._name}={self._key}; Path=/; HttpOnly; SameSite=Strict"}

    # ---- what comes and goes -------------------------------------------------------------------
    async def _pass(self, scope: Scope, headers: Headers, receive: Receive, send: Send) -> None:
        """The application's answer, with headers; its body stopped where it is too long."""
        said = headers.get("content-length", "0")
        if not said.isdigit() or int(said) > self._most:
            await self._say(send, 413, self._too_long)
            return
        nonce, begun, gone, over = secrets.token_urlsafe(16), False, False, 0
        count, end = 0, asyncio.get_running_loop().time() + self._longest

        async def counted() -> Message:
            nonlocal count, over, end, gone
            left = end - asyncio.get_running_loop().time()
            try:
                message = await asyncio.wait_for(receive(), None if end == math.inf else left)
            except asyncio.TimeoutError:
                over = 408
                raise _Broken from None
            gone = gone or (message["type"] == "http.disconnect" and not begun)
            count += len(message.get("body", b""))
            if count > self._most:
                over = 413
                raise _Broken
            if not message.get("more_body"):
                end = math.inf  # what is awaited then is the end of the connection
            return message

        page: Message | None = None
        parts: list[bytes] = []

        async def dressed(message: Message) -> None:
            nonlocal begun, page
            if over and not begun:
                return  # what the application makes of the broken body
            if message["type"] == "http.response.start":
                begun = True
                message.setdefault("headers", [])
                answered = MutableHeaders(scope=message)
                answered.update(self._headers(nonce))
                if scope["method"] not in ("GET", "HEAD"):
                    answered["connection"] = "close"  # what is still to come is not read
                if answered.get("content-type", "").startswith("text/html"):
                    page = message
                    return
            if page is None:
                await send(message)
                return
            parts.append(message.get("body", b""))
            if not message.get("more_body"):
                # scripts of the page's own: its framework writes "<" of any content as an entity
                body = _SCRIPT.sub(f'<script nonce="{nonce}"'.encode(), b"".join(parts))
                MutableHeaders(scope=page)["content-length"] = str(len(body))
                await send(page)
                await send({"type": "http.response.body", "body": body})

        # pages must come as they are, so that scripts in them get their nonce
        scope["headers"] = [(k, v) for k, v in scope["headers"] if k.lower() != b"accept-encoding"]
        try:
            await self._app(scope, counted, dressed)
        except Exception:
            # where a browser leaves before it is answered, starlette misses an answer
            if not (over or gone):
                raise
        if over and not begun:
            words = self._too_long if over == 413 else "that took too long to arrive"
            await self._say(send, over, words)

    @property
    def _too_long(self) -> str:
        return f"that is more than the {self._most / 2**20:g} MiB allowed at once"

    def _headers(self, nonce: str) -> dict[str, str]:
        sockets = " ".join(sorted(f"ws://{host}" for host in self._hosts))
        port = self._framed
        names = sorted({host.rpartition(":")[0] for host in self._hosts}) if port else []
        frames = " ".join(f"http://{name}:{port}" for name in names) or "'none'"
        policy = POLICY.format(nonce=nonce, sockets=sockets, frames=frames)
        return {**HEADERS, "content-security-policy": policy}

    async def _form(self, send: Send, status: int, words: str) -> None:
        text = (
            "<!doctype html><html lang=en><title>pam_ocp bench</title><body style='font:15px "
            "system-ui;max-width:26em;margin:12vh auto'><h1 style='font-size:1.2em'>pam_ocp bench"
            f"</h1><p role=alert>{html.escape(words)}</p><form method=post action=/login>"
            "<label>Password <input type=password name=password autofocus required "
            "autocomplete=current-password></label> <button>Open</button></form>"
        )
        await self._say(send, status, text, kind="text/html")

    async def _say(
        self,
        send: Send,
        status: int,
        text: str,
        extra: Mapping[str, str] | None = None,
        kind: str = "text/plain",
    ) -> None:
        own = {"cache-control": "no-store", "connection": "close"}
        headers = {**own, **self._headers(secrets.token_urlsafe(16)), **(extra or {})}
        answer = Response(text, status, headers, media_type=kind)
        await answer({"type": "http"}, _nothing, send)


async def _nothing() -> Message:
    """What a plain answer has to receive."""
    return {"type": "http.disconnect"}


class _Broken(Exception):
    """A body that is longer than allowed, or does not end."""


def _same(given: str, right: str) -> bool:
    """Equal, in a time that does not tell how much of it."""
    one, other = (
        hashlib.sha256(text.encode("utf-8", "replace")).digest() for text in (given, right)
    )
    return hmac.compare_digest(one, other)


_SCRIPT = re.compile(rb"<script(?=[\s>])")


async def _body(receive: Receive, most: int) -> bytes | None:
    """A short body; None where it is longer."""
    parts, size = [], 0
    while True:
        message = await receive()
        parts.append(message.get("body", b""))
        size += len(parts[-1])
        if size > most:
            return None
        if not message.get("more_body"):
            return b"".join(parts)


class Patient(AutoHTTPProtocol):  # type: ignore[misc, valid-type]
    """uvicorn's connection, closed where a request's head is too long in coming or too long, or too
    many are open: uvicorn limits neither, and who never ends a head would hold them for ever.
    """

    _late: asyncio.TimerHandle | None = None
    _size = 0

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        if len(self.connections) > MOST_CONNECTIONS:
            transport.abort()
        else:
            self._awaited(0)

    def connection_lost(self, error: Exception | None) -> None:
        self._said()
        super().connection_lost(error)

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        upgraded = self.transport.get_protocol() is not self  # a websocket's from here on
        if upgraded or not (self.cycle is None or self.cycle.response_complete):
            self._said()
        else:
            self._awaited(len(data))

    def _awaited(self, size: int) -> None:
        self._size += size
        if self._late is None:
            loop = asyncio.get_running_loop()
            self._late = loop.call_later(LONGEST_HEAD, self.transport.abort)
        if self._size > MOST_HEAD:
            self.transport.abort()

    def _said(self) -> None:
        self._size = 0
        if self._late is not None:
            self._late.cancel()
            self._late = None
