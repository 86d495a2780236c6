"""The web server: on loopback only, in a thread of its own."""

import contextlib
import os
import socket
import threading
from collections.abc import Iterator

import uvicorn
from fastapi import FastAPI
from fastapi.middleware.trustedhost import TrustedHostMiddleware
from nicegui import ui

from eha_monitor.dashboard.page import Page
from eha_monitor.dashboard.state import State
from eha_monitor.errors import InputError

HOST = "127.0.0.1"
_START_TIMEOUT = 20.0  # s
_ICON = "⚙"


def claim(port: int) -> socket.socket:
    """Return a listening socket on loopback; port 0 takes any that is free.

    Raises
    ------
    InputError
        If the port is taken, or not allowed to this user.
    """
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    # Else a port stays taken for a minute after the last dashboard.
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((HOST, port))
        listener.listen()
    except OSError as problem:
        listener.close()
        reason = os.strerror(problem.errno)
        raise InputError(f"--port {port}: cannot serve on {HOST}:{port} ({reason}), expected a "
                         "free port") from problem
    return listener


@contextlib.contextmanager
def serving(state: State, topics: dict[str, str], listener: socket.socket) -> Iterator[str]:
    """Serve the page for the time of a block; gives its address.

    Parameters
    ----------
    state : what the page shows.
    topics : full names of the topics, by the keys of ``View.silence`` that are looked at.
    listener : from :func:`claim`.
    """
    # No page of FastAPI's own: those load their scripts from the internet.
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    # A web site that resolves its own name to loopback must not read along.
    app.add_middleware(TrustedHostMiddleware, allowed_hosts=[HOST, "localhost"])
    ui.run_with(app, root=lambda: Page(state, topics), title="Actuator health", favicon=_ICON,
                tailwind=False, show_welcome_message=False, binding_refresh_interval=None)
    server = uvicorn.Server(uvicorn.Config(app, log_config=None, log_level="warning",
                                           timeout_graceful_shutdown=1))
    # Not in the main thread, so uvicorn leaves the signals to ROS.
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, name="dashboard",
                              daemon=True)
    thread.start()
    try:
        _await_start(server, thread)
        yield f"http://{HOST}:{listener.getsockname()[1]}/"
    finally:
        server.should_exit = True
        thread.join(timeout=5.0)
        listener.close()


def _await_start(server: uvicorn.Server, thread: threading.Thread) -> None:
    waited = 0.0
    while not server.started:
        thread.join(timeout=0.02)
        waited += 0.02
        if not thread.is_alive() or waited > _START_TIMEOUT:
            raise InputError("the web server of the dashboard did not start")
