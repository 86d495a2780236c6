"""The web server, in a thread of its own: the page, its downloads, the metrics."""

import contextlib
import errno
import ipaddress
import math
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from urllib.parse import quote

import uvicorn
from fastapi import FastAPI, HTTPException, Query, Response
from nicegui import ui

from eha_monitor.dashboard.events import EventLog
from eha_monitor.dashboard.exports import estimates_csv, metrics
from eha_monitor.dashboard.guard import Guard, names_of, token_for
from eha_monitor.dashboard.page import Page
from eha_monitor.dashboard.state import Actuator
from eha_monitor.errors import InputError

HOST = "127.0.0.1"
_START_TIMEOUT = 20.0  # s
_ICON = "⚙"
# What the system says of an address that is none of its own.
_NO_ADDRESS = (errno.EADDRNOTAVAIL, errno.ENODEV)


@dataclass(frozen=True)
class Door:
    """Where the page is served and who may come in.

    Attributes
    ----------
    listener : listening socket.
    host : as it was requested.
    loopback : whether nobody but this machine reaches it.
    token : required of everyone, or None.
    made : whether the token was made here, so that it must be printed.
    names : further names to answer to, as those of a reverse proxy.
    """

    listener: socket.socket
    host: str
    loopback: bool
    token: str | None
    made: bool
    names: tuple[str, ...] = ()

    @property
    def port(self) -> int:
        """The port, the one that was free where any was requested."""
        return self.listener.getsockname()[1]

    @property
    def address(self) -> str:
        """The page's address, with the token where that was made here."""
        host = self.host
        if self.listener.getsockname()[0] in ("0.0.0.0", "::"):
            host = socket.gethostname()
        elif ":" in host:
            host = f"[{host}]"
        token = f"?token={quote(self.token)}" if self.made and self.token else ""
        return f"http://{host}:{self.port}/{token}"


def claim(port: int, host: str = HOST, token: str | None = None,
          names: tuple[str, ...] = ()) -> Door:
    """Return a listening socket and who may come in; port 0 takes any that is free.

    On another address than loopback, or under other names, a token is required; one is made
    where none is given.

    Raises
    ------
    InputError
        If the port is taken or not allowed to this user, the address is none of this machine,
        or the token is too short.
    """
    try:
        family, _, _, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM,
                                                    flags=socket.AI_PASSIVE)[0]
    except (OSError, UnicodeError) as problem:
        raise InputError(f"--host {host}: no such address ({problem}), expected one of this "
                         "machine, or 0.0.0.0 for all of them") from problem
    loopback = ipaddress.ip_address(place[0].partition("%")[0]).is_loopback
    token, made = token_for(loopback and not names, token)
    listener = socket.socket(family, socket.SOCK_STREAM)
    # Else a port stays taken for a minute after the last dashboard.
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind(place)
        listener.listen()
    except OSError as problem:
        listener.close()
        reason = os.strerror(problem.errno)
        if problem.errno in _NO_ADDRESS:
            raise InputError(f"--host {host}: cannot serve there ({reason}), expected an address "
                             "of this machine, or 0.0.0.0 for all of them") from problem
        raise InputError(f"--port {port}: cannot serve on {host}:{port} ({reason}), expected a "
                         "free port") from problem
    return Door(listener, host, loopback, token, made, names)


def metrics_text() -> Callable:
    """Return what writes the metrics; raises ImportError where prometheus_client is missing."""
    from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4

    return lambda states: Response(metrics(states), media_type=CONTENT_TYPE_PLAIN_0_0_4)


@contextlib.contextmanager
def serving(shown: dict[str, Actuator], log: EventLog, door: Door,
            write_metrics: Callable | None = None) -> Iterator[str]:
    """Serve the page for the time of a block; gives its address.

    Parameters
    ----------
    shown : the actuators by name, in the order of the page.
    door : from :func:`claim`.
    write_metrics : from :func:`metrics_text`, or None for no ``/metrics``.
    """
    # No page of FastAPI's own: those load their scripts from the internet.
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    _add_downloads(app, shown, log)
    states = {name: each.state for name, each in shown.items()}
    absent = Response("start the dashboard with --metrics\n", 404, media_type="text/plain")
    app.add_api_route("/metrics", lambda: write_metrics(states) if write_metrics else absent,
                      response_class=Response)
    app.add_middleware(Guard, names=names_of(door.host, door.loopback, door.names),
                       any_address=not door.loopback, token=door.token,
                       cookie=f"eha_monitor_{door.port}")
    ui.run_with(app, root=lambda: Page(shown, log), title="Actuator health", favicon=_ICON,
                tailwind=False, show_welcome_message=False, binding_refresh_interval=None)
    server = uvicorn.Server(uvicorn.Config(app, log_config=None, log_level="warning",
                                           timeout_graceful_shutdown=1))
    # Not in the main thread, so uvicorn leaves the signals to ROS.
    thread = threading.Thread(target=server.run, kwargs={"sockets": [door.listener]},
                              name="dashboard", daemon=True)
    thread.start()
    try:
        _await_start(server, thread)
        yield door.address
    finally:
        server.should_exit = True
        thread.join(timeout=5.0)
        door.listener.close()


def _add_downloads(app: FastAPI, shown: dict[str, Actuator], log: EventLog) -> None:
    @app.get("/events.csv")
    def events() -> Response:
        return _csv(log.csv(), "events.csv")

    @app.get("/estimates.csv")
    def estimates(actuator: str = "", last: float | None = Query(None, gt=0),
                  since: float = -math.inf, until: float = math.inf) -> Response:
        name = actuator or next(iter(shown))
        if name not in shown:
            raise HTTPException(404, f"no actuator {name}, expected one of {', '.join(shown)}")
        if last is not None:
            since, until = time.time() - last, math.inf
        return _csv(estimates_csv(shown[name].state, time.monotonic(), since, until),
                    f"estimates_{name}.csv")


def _csv(text: str, name: str) -> Response:
    return Response(text, media_type="text/csv; charset=utf-8", headers={
        "Content-Disposition": f"attachment; filename*=UTF-8''{quote(name)}",
        "Cache-Control": "no-store"})


def _await_start(server: uvicorn.Server, thread: threading.Thread) -> None:
    waited = 0.0
    while not server.started:
        thread.join(timeout=0.02)
        waited += 0.02
        if not thread.is_alive() or waited > _START_TIMEOUT:
            raise InputError("the web server of the dashboard did not start")
