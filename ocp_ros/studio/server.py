# Copyright 2026 The ocp_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
A viser server that only its own page can reach.

viser listens on all interfaces, accepts websockets from pages of any origin, and can open a public
tunnel. This server listens on one address, refuses other origins and host names, and never opens
the tunnel. It expects a token in the path of the URL if other machines can reach its address. Of
the messages of a page, only those pass that this package uses, with values like the present ones.
"""

import asyncio
from collections.abc import Callable, Coroutine, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from http import HTTPStatus
import io
import ipaddress
import logging
import math
import os
import secrets
import socket
from threading import Lock
from typing import Any
from urllib.parse import urlsplit

import msgspec
from ocp_ros.studio import FIRST_PORT, LOCAL_ADDRESS
from ocp_ros.util.settings import ConfigurationError
import viser
import websockets.asyncio.server
from websockets.http11 import Request, Response

#: Messages of a page that change nothing but the page itself, or only start an action.
PLAIN_MESSAGES = ('ViewerCameraMessage', 'SceneNodeClickMessage', 'CommandTriggerMessage',
                  'TransformControlsDragStartMessage', 'TransformControlsDragEndMessage')
#: Largest number of characters of a text that a page sends.
MAX_TEXT_LENGTH = 1000

_log = logging.getLogger(__name__)
#: Held while viser starts a server, since ``serve`` is replaced during the start.
_start_lock = Lock()


class Gate:
    """
    Decide which requests reach the server.

    :param token: first folder in the path of every URL; empty if none is expected.
    :ivar fields: fields and buttons of the page by their identifiers.
    """

    def __init__(self, token: str) -> None:
        self.token = token
        self.fields: Mapping[str, Any] = {}

    def refusal(self, request: Request) -> str:
        """
        Return why a request is refused; an empty string if it is not refused.

        This also removes the token from the path of a request that has the right one.
        """
        host = request.headers.get('Host', '')
        name = urlsplit(f'//{host}').hostname or ''
        # Only people who have the URL know the token, so with a token any host name is accepted.
        if self.token:
            path, _, query = request.path.partition('?')
            token, _, inner_path = path.lstrip('/').partition('/')
            if not secrets.compare_digest(os.fsencode(token), self.token.encode()):
                return 'found no token, or a wrong one; expected the URL that ocp has printed'
            request.path = f'/{inner_path}' + (f'?{query}' if query else '')
        # A web page under another name could point that name at this machine ("DNS rebinding") and
        # reach the server so.
        elif not is_local(name):
            return f'found the host {host!r}; expected localhost or {LOCAL_ADDRESS}'
        if request.headers.get('Upgrade', '').lower() == 'websocket':
            origin = urlsplit(request.headers.get('Origin', ''))
            if origin.scheme not in ('http', 'https') or origin.netloc != host:
                return 'found another origin; expected the page of this server'
        return ''

    def guarded(self, process_request: Callable[..., Any]) -> Callable[..., Any]:
        """
        Return a function that refuses requests, and passes all others to another function.

        :param process_request: see :func:`websockets.asyncio.server.serve`. It returns a response,
            or None to let a websocket open; so does the returned function.
        """
        def process_allowed(connection: Any, request: Request) -> Response | None:
            try:
                reason = self.refusal(request)
                response = (connection.respond(HTTPStatus.FORBIDDEN, f'ocp: {reason}\n') if reason
                            else process_request(connection, request))
            except (LookupError, ValueError, OSError):
                # For example, two headers that may stand once, or a path that is too long.
                response = connection.respond(
                    HTTPStatus.BAD_REQUEST, 'ocp: found a request that cannot be read\n')
            if response is not None:
                # Other pages must neither show this one inside them nor learn its URL.
                response.headers.update({'X-Frame-Options': 'DENY',
                                         'Referrer-Policy': 'no-referrer'})
            return response
        return process_allowed

    def handler_behind(self, handler: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that handles connections without their unexpected messages."""
        async def handle(connection: Any) -> None:
            asyncio.get_running_loop().set_exception_handler(
                lambda _, context: _log.error('a message of a page failed: %r',
                                              context.get('exception', context['message'])))
            receive = connection.recv

            async def receive_expected() -> bytes:
                while not self.is_expected(content := await receive()):
                    pass
                return content

            connection.recv = receive_expected
            await handler(connection)
        return handle

    def is_expected(self, content: bytes | str) -> bool:
        """
        Return whether a message can do no harm to other pages.

        viser itself takes any value of any attribute of a field, and shows it to all.
        """
        try:
            message = msgspec.msgpack.decode(content)
        except (TypeError, ValueError, RecursionError):
            return False
        match message:
            case {'type': 'GuiUpdateMessage', 'uuid': str(uuid),
                  'updates': {'value': value, **others}}:
                return not others and uuid in self.fields and is_like(
                    value, self.fields[uuid].value)
            case {'type': 'TransformControlsUpdateMessage', 'position': position, 'wxyz': wxyz}:
                return is_like(position, (0.0,) * 3) and is_like(wxyz, (0.0,) * 4)
            case {'type': kind}:
                return kind in PLAIN_MESSAGES
        return False


def is_like(value: Any, present: Any) -> bool:
    """Return whether a value has the type of the present one, with as many, finite, numbers."""
    if isinstance(present, tuple):
        return (isinstance(value, list) and len(value) == len(present)
                and all(map(is_like, value, present)))
    if isinstance(present, bool) or isinstance(value, bool):
        return type(value) is type(present)
    if isinstance(present, (int, float)):
        return isinstance(value, (int, float)) and math.isfinite(value)
    return (isinstance(value, str) and isinstance(present, str)
            and len(value) <= MAX_TEXT_LENGTH)


class _OneLine(logging.Filter):
    """Log an error of a connection as one line in place of a traceback."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Shorten the record; return False for connections that only ended."""
        error = record.exc_info[1] if record.exc_info else None
        # Browsers open connections ahead of time, which end without a request.
        if isinstance(error, TimeoutError) or isinstance(
                error and error.__cause__, (EOFError, OSError)):
            return False
        if error is not None:
            record.msg = f'{record.getMessage()}: {error.__cause__ or error!r}'
            record.args, record.exc_info = (), None
        return True


#: Gets what ``websockets`` reports of requests and connections.
_connection_log = _log.getChild('connections')
_connection_log.addFilter(_OneLine())


class LocalServer(viser.ViserServer):
    """A viser server that opens no public tunnel and prints nothing."""

    def stop(self) -> None:
        """End the server."""
        with redirect_stdout(io.StringIO()):
            super().stop()

    def request_share_url(self, verbose: bool = True) -> None:
        """Do nothing in place of opening a public tunnel."""


def in_order(react: Callable[[Any], None]) -> Callable[[Any], Coroutine[Any, Any, None]]:
    """
    Return a callback for viser that reacts to events in their order.

    viser runs coroutines one after the other, and functions in threads, which keep no order.

    :param react: gets an event of viser, and returns soon.
    """
    async def callback(event: Any) -> None:
        react(event)
    return callback


def is_local(host: str) -> bool:
    """Return whether only this machine can reach an address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == 'localhost'


def start_server(host: str = LOCAL_ADDRESS, port: int = FIRST_PORT, label: str = 'ocp studio'
                 ) -> tuple[viser.ViserServer, str]:
    """
    Start a server of a page.

    :param host: address of an interface of this machine.
    :param port: first port to try; 0 for any free port.
    :param label: title of the page.
    :returns: the server, and the URL of its page.
    :raises ConfigurationError: if no server can listen at this address, or if the installed viser
        does not start as expected.
    """
    port = _free_port(host, port)
    gate = Gate('' if is_local(host) else secrets.token_urlsafe(nbytes=24))
    with _start_lock, _serving_behind(gate) as guarded_calls, redirect_stdout(io.StringIO()):
        server = LocalServer(host, port, label=label, verbose=False)
    if not guarded_calls:
        server.stop()
        raise ConfigurationError('viser: found a version that starts another way; expected the '
                                 "one of ocp_ros's requirements; install ocp_ros[studio]")
    gate.fields = server.gui._gui_input_handle_from_uuid
    url_host = f'[{host}]' if ':' in host else host
    # These addresses stand for all interfaces; a URL needs a name of this machine.
    if host in ('0.0.0.0', '::'):
        url_host = socket.gethostname()
    path = f'{gate.token}/' if gate.token else ''
    return server, f'http://{url_host}:{server.get_port()}/{path}'


@contextmanager
def _serving_behind(gate: Gate) -> Iterator[list[bool]]:
    """
    Put a gate before the servers that start in this context.

    viser has no option for this, so the function ``serve`` that it calls is replaced. The context
    is a list, which has an item for each server that has started behind the gate.
    """
    original_serve = websockets.asyncio.server.serve
    guarded_calls: list[bool] = []

    def serve(handler: Callable[..., Any], *args: Any, process_request: Callable[..., Any],
              **options: Any) -> Any:
        guarded_calls.append(True)
        return original_serve(gate.handler_behind(handler), *args, logger=_connection_log,
                              process_request=gate.guarded(process_request), **options)

    websockets.asyncio.server.serve = serve
    try:
        yield guarded_calls
    finally:
        websockets.asyncio.server.serve = original_serve


def _free_port(host: str, port: int) -> int:
    """Return the first free port of 100 from ``port`` on; refuse an address of other machines."""
    error: OSError | None = None
    # Port 0 is tried once, since it stands for any free port.
    for tried_port in range(port, (port + 100) if port else 1):
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(
                host, tried_port, type=socket.SOCK_STREAM)[0]
            with socket.socket(family, kind, protocol) as test_socket:
                test_socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                test_socket.bind(address)
                return test_socket.getsockname()[1]
        except (OSError, OverflowError, UnicodeError) as failure:
            # The message below needs the strerror that only an OSError has.
            error = failure if isinstance(failure, OSError) else OSError(0, str(failure))
    raise ConfigurationError(
        f'--host: found {host}, port {port}, where nothing can listen ({error.strerror}); '
        'expected an address of this machine and a free port; name others, or leave --host out '
        f'for {LOCAL_ADDRESS}')
