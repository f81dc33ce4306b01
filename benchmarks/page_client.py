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

"""A client of the studio's page without a browser, for measurements and tests."""

from collections.abc import Callable
import time
from typing import Any
from urllib.parse import urlsplit

import msgspec
import viser
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol
import zstandard


class PageClient:
    """
    A websocket client that speaks as the page does.

    :param url: of the page.
    :param origin: origin that it claims; the page's own by default.
    :param path: path of the websocket; that of the page by default.
    :ivar received: number of bytes that it has received.
    """

    def __init__(self, url: str, origin: str | None = None, path: str | None = None) -> None:
        parts = urlsplit(url)
        self.received, self._url = 0, url
        way = parts.path.rstrip('/') if path is None else path
        self.socket: ClientConnection = connect(
            f'ws://{parts.netloc}{way}', compression=None, max_size=None,
            origin=f'http://{parts.netloc}' if origin is None else origin,
            subprotocols=[Subprotocol(f'viser-v{viser.__version__}')])

    def __enter__(self) -> 'PageClient':
        """Return the client."""
        return self

    def __exit__(self, *_: Any) -> None:
        """Close the connection."""
        self.socket.close()

    def look(self) -> None:
        """Send the first message of a page, with which viser counts a client as connected."""
        self.send('ViewerCameraMessage', wxyz=(1, 0, 0, 0), position=(0, 0, 5), fov=1.0, near=0.1,
                  far=100.0, image_height=900, image_width=1440, look_at=(0, 0, 0),
                  up_direction=(0, 0, 1))

    def send(self, kind: str, **fields: Any) -> None:
        """Send a message."""
        self.socket.send(msgspec.msgpack.encode({'type': kind, **fields}))

    def receive(self, seconds: float | None = None) -> list[dict[str, Any]]:
        """
        Return the messages of the next frame.

        :raises TimeoutError: if there is none in time.
        """
        frame = self.socket.recv(seconds)
        self.received += len(frame)
        length = int.from_bytes(frame[8:16], 'little')
        content = zstandard.ZstdDecompressor().decompress(frame[16:16 + length])
        return msgspec.msgpack.decode(content)['messages']

    def until(self, holds: Callable[[dict[str, Any]], bool], seconds: float = 600.0
              ) -> dict[str, Any]:
        """Return the first message for which a condition holds."""
        end = time.monotonic() + seconds
        while True:
            for message in self.receive(max(end - time.monotonic(), 0.0)):
                if holds(message):
                    return message

    def drag(self, name: str, position: tuple[float, ...], wxyz: tuple[float, ...] = (1, 0, 0, 0)
             ) -> None:
        """Send a movement of a node by its handles."""
        self.send('TransformControlsUpdateMessage', name=name, wxyz=wxyz, position=position)


def paints(message: dict[str, Any]) -> bool:
    """Return whether a message colours the room."""
    return (message['type'] == 'SceneNodeUpdateMessage' and message['name'] == '/room'
            and 'colors' in message['updates'])
