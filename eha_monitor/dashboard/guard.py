"""Who may read the page: by which name it is called, and with which token."""

import hashlib
import hmac
import ipaddress
import secrets
import socket
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qsl, urlencode, urlsplit

from starlette.datastructures import Headers
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Receive, Scope, Send

from eha_monitor.errors import InputError

VARIABLE = "EHA_MONITOR_TOKEN"
# A token that is shorter can be found by trying.
SHORTEST = 16
_ASK = ("open the address with ?token=... that the dashboard printed when it started, or put "
        "?token= and the token behind this one; a program sends the header "
        "'Authorization: Bearer TOKEN'")
_REFUSED = """<!doctype html><html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1"><title>Token needed</title>
<style>body{{font-family:system-ui,"DejaVu Sans",sans-serif;margin:2rem auto;max-width:38rem;
padding:0 1rem;color:#1c2529;line-height:1.5;overflow-wrap:anywhere}}
input,button{{font:inherit;padding:.4rem .6rem}}</style></head>
<body><h1>{reason}</h1><p>To see this dashboard, {ask}.</p>
<form method="get" action="/"><label>Token <input name="token" type="password"
autocomplete="off" required></label> <button>Open</button></form></body></html>"""


def token_for(loopback: bool, given: str | None) -> tuple[str | None, bool]:
    """Return the token that is required, None for none, and whether it was made here.

    Raises
    ------
    InputError
        If the given one is too short, or cannot stand in an address.
    """
    if given is None:
        return (None, False) if loopback else (secrets.token_urlsafe(24), True)
    if len(given) < SHORTEST or not given.isascii() or not given.isprintable() or " " in given:
        raise InputError(f"--token (or {VARIABLE}): expected at least {SHORTEST} letters, digits "
                         f"or signs without spaces, got {len(given)} characters")
    return given, False


def names_of(host: str, loopback: bool, more: tuple[str, ...] = ()) -> frozenset[str]:
    """Return the names to answer to, in small letters: those of loopback, ``host`` and ``more``.

    Beyond loopback the machine's own name counts as well.  DNS is not queried: on a rig without
    one that takes seconds.
    """
    names = {"127.0.0.1", "localhost", "::1", host.lower(), *(name.lower() for name in more)}
    if not loopback:
        own = socket.gethostname().lower()
        names |= {own, f"{own}.local"}
    return frozenset(names)


class Guard:
    """Lets those requests and WebSockets through that call it by its name and bring its token.

    A web site that resolves its own name to this machine (DNS rebinding) must not read along,
    so names are checked, and a page of another origin cannot use what the browser keeps.

    Parameters
    ----------
    app : what is guarded.
    names : host names that it answers to.
    any_address : whether it answers to every numerical address as well; those cannot be rebound.
    token : required of everyone; None lets everyone in.
    cookie : name of the cookie that keeps it; cookies do not tell ports apart, names must.
    """

    def __init__(self, app: ASGIApp, names: frozenset[str], any_address: bool,
                 token: str | None, cookie: str):
        self._app, self._names, self._any_address = app, names, any_address
        self._token, self._cookie = token, cookie
        # The browser keeps no more than it needs.
        self._proof = "" if token is None else hashlib.sha256(f"{cookie} {token}".encode()
                                                              ).hexdigest()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request as ASGI asks for."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        answer = self._refusal(scope, Headers(scope=scope))
        if answer is None:
            await self._app(scope, receive, send)
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
        else:
            await answer(scope, receive, send)

    def _refusal(self, scope: Scope, headers: Headers) -> Response | None:
        if not self._known(headers.get("host", "")):
            return PlainTextResponse("Invalid host header: this dashboard answers to "
                                     f"{', '.join(sorted(self._names))}\n", status_code=400)
        origin = headers.get("origin")
        if origin and urlsplit(origin).netloc.lower() != headers.get("host", "").lower():
            return PlainTextResponse("a page of another origin may not use this dashboard\n",
                                     status_code=403)
        return None if self._token is None else self._ask(scope, headers)

    def _known(self, host: str) -> bool:
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        return name in self._names or (self._any_address and _is_address(name))

    def _ask(self, scope: Scope, headers: Headers) -> Response | None:
        query = parse_qsl(scope.get("query_string", b"").decode("latin-1"), keep_blank_values=True)
        given = next((value for key, value in query if key == "token"), None)
        scheme, _, bearer = headers.get("authorization", "").partition(" ")
        if scheme.lower() == "bearer" and _same(bearer.strip(), self._token):
            return None
        if given is not None and _same(given, self._token):
            if scope["type"] != "http" or scope["path"] != "/":
                return None
            rest = urlencode([pair for pair in query if pair[0] != "token"])
            answer = RedirectResponse(f"/?{rest}" if rest else "/", status_code=303,
                                      headers={"Referrer-Policy": "no-referrer",
                                               "Cache-Control": "no-store"})
            answer.set_cookie(self._cookie, self._proof, httponly=True, samesite="lax", path="/",
                              secure=scope["scheme"] == "https")  # a proxy on loopback says so
            return answer
        if given is None and _same(self._kept(headers), self._proof):
            return None
        return _unauthorised(headers, "This token is wrong" if given is not None or bearer
                             else "This dashboard needs its token")

    def _kept(self, headers: Headers) -> str:
        try:
            kept = SimpleCookie(headers.get("cookie", "")).get(self._cookie)
        except CookieError:
            return ""
        return kept.value if kept else ""


def _unauthorised(headers: Headers, reason: str) -> Response:
    kept = {"WWW-Authenticate": "Bearer", "Cache-Control": "no-store"}
    if "text/html" in headers.get("accept", ""):
        return HTMLResponse(_REFUSED.format(reason=reason, ask=_ASK), 401, kept)
    return PlainTextResponse(f"{reason}: {_ASK}\n", 401, kept)


def _same(one: str, other: str | None) -> bool:
    """Compare in a time that does not tell how much of it is right."""
    return other is not None and hmac.compare_digest(one.encode("utf-8", "replace"),
                                                     other.encode())


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
