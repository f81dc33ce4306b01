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
tunnel. This server listens on one address, refuses other origins and host names, expects a token
in the path of the URL unless the address is of this machine alone, and never opens the tunnel.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from http import HTTPStatus
import io
import ipaddress
import secrets
import socket
from threading import Lock
from typing import Any
from urllib.parse import urlsplit

from ocp_ros.studio import LOCAL, PORT
from ocp_ros.util.settings import ConfigurationError
import viser
import websockets.asyncio.server
from websockets.http11 import Request, Response

#: Names of this machine in URLs; another name may be of a page that rebinds its address.
NAMES = (LOCAL, 'localhost', '[::1]')
#: Other pages must neither show this one inside them nor learn its URL.
HEADERS = {'X-Frame-Options': 'DENY', 'Referrer-Policy': 'no-referrer'}
#: Bytes of a token.
TOKEN = 24
#: Number of ports that are tried.
TRIED = 100

_starting = Lock()


class Gate:
    """
    Decide which requests reach the server.

    :param token: first part of the path of every URL; empty for none.
    """

    def __init__(self, token: str) -> None:
        self.token = token

    def refusal(self, request: Request) -> str:
        """
        Return why a request is refused; empty if it is not.

        The token is removed from the path of a request that is not refused.
        """
        host = request.headers.get('Host', '')
        if self.token:
            path, _, query = request.path.partition('?')
            first, _, rest = path.lstrip('/').partition('/')
            if not secrets.compare_digest(first.encode(), self.token.encode()):
                return 'found no token, or a wrong one; expected the URL that ocp has printed'
            request.path = f'/{rest}' + (f'?{query}' if query else '')
        elif host.rpartition(':')[0] not in NAMES:
            return f'found the host {host!r}; expected one of {", ".join(NAMES)}'
        if request.headers.get('Upgrade', '').lower() == 'websocket':
            origin = urlsplit(request.headers.get('Origin', ''))
            if origin.scheme not in ('http', 'https') or origin.netloc != host:
                return 'found another origin; expected the page of this server'
        return ''

    def guarded(self, process: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function for ``process_request`` that refuses requests before ``process``."""
        def first(connection: Any, request: Request) -> Response | None:
            reason = self.refusal(request)
            answer = (connection.respond(HTTPStatus.FORBIDDEN, f'ocp: {reason}\n') if reason
                      else process(connection, request))
            if answer is not None:
                answer.headers.update(HEADERS)
            return answer
        return first


class LocalServer(viser.ViserServer):
    """A viser server without the public tunnel, and silent."""

    def stop(self) -> None:
        """End the server."""
        with redirect_stdout(io.StringIO()):
            super().stop()

    def request_share_url(self, verbose: bool = True) -> None:
        """Refuse to open a tunnel, whoever asks."""


def is_local(host: str) -> bool:
    """Return whether only this machine can reach an address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == 'localhost'


def start_server(host: str = LOCAL, port: int = PORT, label: str = 'ocp studio'
                 ) -> tuple[viser.ViserServer, str]:
    """
    Start a server.

    :param host: address of an interface of this machine.
    :param port: first port to try; 0 for any free one.
    :param label: title of the page.
    :returns: the server, and the URL of its page.
    :raises ConfigurationError: if it cannot listen there.
    """
    port = _free_port(host, port)
    gate = Gate('' if is_local(host) else secrets.token_urlsafe(TOKEN))
    with _starting, _serving_behind(gate) as used, redirect_stdout(io.StringIO()):
        server = LocalServer(host, port, label=label, verbose=False)
    if not used:
        server.stop()
        raise ConfigurationError('viser: found a version that starts another way; expected the '
                                 "one of ocp_ros's requirements; install ocp_ros[studio]")
    shown = f'[{host}]' if ':' in host else host
    if host in ('0.0.0.0', '::'):
        shown = socket.gethostname()
    path = f'{gate.token}/' if gate.token else ''
    return server, f'http://{shown}:{server.get_port()}/{path}'


@contextmanager
def _serving_behind(gate: Gate) -> Iterator[list[bool]]:
    """
    Put a gate before the servers that start now; yield a list that is empty until one does.

    viser has no option for this, so its call of ``serve`` is replaced.
    """
    original, used = websockets.asyncio.server.serve, []

    def serve(*args: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        used.append(True)
        return original(*args, process_request=gate.guarded(process_request), **options)

    websockets.asyncio.server.serve = serve
    try:
        yield used
    finally:
        websockets.asyncio.server.serve = original


def _free_port(host: str, port: int) -> int:
    """Return the first free port; refuse an address that this machine does not have."""
    error: OSError | None = None
    for attempt in range(port, port + TRIED if port else 1):
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(
                host, attempt, type=socket.SOCK_STREAM)[0]
            with socket.socket(family, kind, protocol) as trial:
                trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                trial.bind(address)
                return trial.getsockname()[1]
        except (OSError, OverflowError, UnicodeError) as failure:
            error = failure if isinstance(failure, OSError) else OSError(0, str(failure))
    raise ConfigurationError(
        f'--host: found {host}, port {port}, where nothing can listen ({error.strerror}); '
        f'expected an address of this machine and a free port; name others, or leave --host out '
        f'for {LOCAL}')
