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

"""The server of the studio: who can reach it, and what clients can do to it."""

from contextlib import closing, contextmanager, ExitStack
from dataclasses import replace
import http.client
import socket
from urllib.parse import urlsplit

from conftest import HUNG, wait_until
import numpy as np
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.util.settings import ConfigurationError
import pytest

pytest.importorskip('viser', reason='viser is not installed: pip install "ocp_ros[studio]"')
from benchmarks.page_client import PageClient, paints  # noqa: E402, I100
from ocp_ros.studio import texts  # noqa: E402
from ocp_ros.studio.folder import Folder  # noqa: E402
from ocp_ros.studio.scene_nodes import mesh_below  # noqa: E402
from ocp_ros.studio.server import is_local, LocalServer, start_server  # noqa: E402
from websockets.exceptions import InvalidStatus  # noqa: E402


def status_of(url, path=None, **headers):
    """Return the status of the answer to a request."""
    parts = urlsplit(url)
    with closing(http.client.HTTPConnection(parts.netloc, timeout=HUNG)) as connection:
        connection.request('GET', path or parts.path, headers=headers)
        answer = connection.getresponse()
        answer.read()
        return answer.status


def test_it_listens_on_this_machine_alone(page):
    _, url = page
    assert urlsplit(url).hostname == '127.0.0.1'
    with socket.socket() as other:
        other.settimeout(HUNG)
        # Another address of the same machine, which a server on all interfaces would answer.
        assert other.connect_ex(('127.0.0.2', urlsplit(url).port)) != 0
    assert is_local('127.0.0.1') and is_local('::1') and is_local('localhost')
    assert not is_local('0.0.0.0') and not is_local('192.168.0.1') and not is_local('example.org')


def test_pages_of_other_origins_and_names_that_point_to_this_machine_are_refused(page):
    _, url = page
    with client_of(url, lambda message: message['type'] == 'PointCloudMessage'):
        pass
    for origin in ('http://example.org', 'null', '', url.replace('127.0.0.1', 'localhost'),
                   'http://127.0.0.1:1'):
        with pytest.raises(InvalidStatus, match='403'):
            PageClient(url, origin=origin)
    port = urlsplit(url).port
    assert status_of(url) == status_of(url, Host=f'localhost:{port}') == 200
    assert status_of(url, Host='example.org') == 403
    assert status_of(url, Host=f'example.org:{port}') == 403
    # Browsers leave out port 80, and each address of the loopback is a name of this machine.
    for name in ('127.0.0.1', 'localhost', 'LOCALHOST', '127.0.0.2:80', '[::1]'):
        assert status_of(url, Host=name) == 200
    for name in ('', '127.0.0.1.example.org', '[::1', '127.0.0.1@example.org', '0.0.0.0'):
        assert status_of(url, Host=name) in (400, 403)


def test_another_address_needs_the_token_of_its_server():
    server, url = start_server('0.0.0.0', 0)
    try:
        token = urlsplit(url).path
        here = f'http://127.0.0.1:{urlsplit(url).port}{token}'
        assert len(token) > 30 and status_of(here) == 200
        other_letter = 'y' if token[1] == 'x' else 'x'
        for path in ('/', '/index.html', f'/{other_letter}{token[2:]}', '/%2e%2e/'):
            assert status_of(here, path) == 403
        with client_of(here):
            pass
        for wrong in ({'path': ''}, {'path': '/'}, {'path': '/x'}, {'path': token[:-2]},
                      {'origin': 'http://example.org'}):
            with pytest.raises(InvalidStatus, match='403'):
                PageClient(here, **wrong)
        other, other_url = start_server('0.0.0.0', 0)
        other.stop()
        assert urlsplit(other_url).path != token
    finally:
        server.stop()


def test_an_address_that_this_machine_does_not_have_is_refused():
    with pytest.raises(ConfigurationError, match='192.0.2.1'):
        start_server('192.0.2.1', 0)


@contextmanager
def client_of(url, ready=lambda message: True):
    """Yield a client that looks at a page, and has got a message."""
    with PageClient(url) as client:
        client.look()
        client.until(ready)
        yield client


def first_can_be_dragged(message):
    """Return whether a message adds the second camera: by then the page listens to the first."""
    return (message['type'], message.get('name')) == (
        'TransformControlsMessage', '/cameras/realsense_d455_2')


def drag(client, page, height):
    """Drag the first camera."""
    middle = page.studio.scene.bounds.mean(axis=0)[:2].tolist()
    client.drag('/cameras/realsense_d455_1', (*middle, height))


def test_all_clients_see_what_one_of_them_moves_and_no_tunnel_is_opened(page, monkeypatch):
    opened = []
    monkeypatch.setattr('viser._viser.ViserTunnel', lambda *_: opened.append(True))
    page, url = page
    assert isinstance(page.server, LocalServer)
    with ExitStack() as stack:
        clients = [stack.enter_context(client_of(url, first_can_be_dragged)) for _ in range(4)]
        clients[2].send('ShareUrlRequest')
        drag(clients[2], page, 1.9)
        for client in clients:
            client.until(paints)
    assert page.studio.state.poses[0, 2] == pytest.approx(1.9) and not opened


def test_a_client_that_vanishes_while_it_drags_leaves_no_lock(page):
    page, url = page
    for height in (1.8, 2.1):
        with client_of(url, first_can_be_dragged) as client:
            client.send('TransformControlsDragStartMessage', name='/cameras/realsense_d455_1')
            drag(client, page, height)
            client.until(paints)
            client.socket.socket.close()
    assert page.studio.state.poses[0, 2] == pytest.approx(2.1)
    assert page.studio.history.undo() and page.studio.history.undo()


def set_value(client, handle, value):
    """Enter a value into a control of the panel."""
    client.send('GuiUpdateMessage', uuid=handle._impl.uuid, updates={'value': value})


def test_of_two_numbers_entered_at_once_both_clients_show_the_last(page):
    page, url = page
    with client_of(url, first_can_be_dragged) as first, client_of(url) as second:
        wait_until(lambda: len(page.server.get_clients()) == 2)
        for client, seconds in ((first, 44.0), (second, 33.0)):
            set_value(client, page.panel.seconds, seconds)
        wait_until(lambda: page.panel.seconds.value != 20.0)
        for client in (first, second):
            client.until(lambda message: message.get('uuid') == page.panel.seconds._impl.uuid
                         and message['updates'] == {'value': page.panel.seconds.value})


def test_numbers_that_are_none_change_nothing(page):
    page, url = page
    before = page.studio.state
    with client_of(url, first_can_be_dragged) as client:
        for position, wxyz in (((np.nan, 0, 0), (1, 0, 0, 0)), ((np.inf, 0, 0), (1, 0, 0, 0)),
                               ((0, 0, 0), (0, 0, 0, 0)), ((0, 0, 0), (np.inf, 0, 0, 0))):
            client.drag('/cameras/realsense_d455_1', position, wxyz)
        set_value(client, page.panel.camera_list, 'no such camera')
        set_value(client, page.panel.sensor_list, 'no such sensor')
        client.until(lambda message: 'no such sensor' in str(message.get('updates', '')))
    assert np.array_equal(page.studio.state.poses, before.poses)


def test_a_page_changes_only_values_and_only_to_others_like_them(page):
    page, url = page
    panel = page.panel
    with client_of(url, first_can_be_dragged) as client:
        before = [(field.value, field.label, field.visible)
                  for field in (panel.position, panel.seconds, panel.sensor_list)]
        for field, updates in (
                (panel.position, {'label': '<b>'}), (panel.position, {'value': [1.0, 2.0]}),
                (panel.position, {'value': 'abc'}), (panel.position, {'value': [np.inf] * 3}),
                (panel.seconds, {'value': np.nan}), (panel.seconds, {'value': [1]}),
                (panel.seconds, {'value': 5.0, 'visible': False}), (panel.seconds, {}),
                (panel.sensor_list, {'options': []}), (panel.sensor_list, {'value': 'x' * 9999})):
            client.send('GuiUpdateMessage', uuid=field._impl.uuid, updates=updates)
        for content in (b'', b'\xc1', b'\x90', b'\x91' * 5000, b'\x81\xa4type\xa1x'):
            client.socket.send(content)
        client.socket.send('text')
        client.send('GuiUpdateMessage', uuid=[], updates={'value': 1})
        client.send('SceneNodeUpdateMessage', name='/room', updates={'visible': False})
        set_value(client, panel.edit_buttons, 'Add')
        wait_until(lambda: len(page.studio.state.poses) == 4)
        assert before == [(field.value, field.label, field.visible)
                          for field in (panel.position, panel.seconds, panel.sensor_list)]


@pytest.mark.parametrize('host', ['127.0.0.1', '0.0.0.0'])
def test_a_request_that_cannot_be_read_is_one_line_of_the_terminal(host, capfd):
    server, url = start_server(host, 0)
    try:
        port = urlsplit(url).port
        for lines in (b'GET /\xff/ HTTP/1.1\r\nHost: 127.0.0.1', b'GET / HTTP/1.1\r\nHost: a\r\n'
                      b'Host: b', b'GET /' + b'a' * 5000 + b' HTTP/1.1\r\nHost: 127.0.0.1',
                      b'GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\n'
                      b'Upgrade: websocket', b'POST / HTTP/1.1\r\nHost: a', b'\x16\x03\x01'):
            with socket.create_connection(('127.0.0.1', port), HUNG) as connection:
                connection.sendall(lines + b'\r\n\r\n')
                answer = connection.recv(4096)
                assert not answer or answer.split()[1] in (b'400', b'403', b'404'), answer
        assert status_of(url, Host=f'127.0.0.1:{port}') in (200, 403)
    finally:
        server.stop()
    error = capfd.readouterr().err
    assert 'Traceback' not in error and error.count('\n') <= 3


@pytest.mark.parametrize('name', ['../up', '/etc/x', 'a/b', '.hidden', '', 'a\0b', 'x' * 61, 'a b',
                                  'link'])
def test_no_typed_name_leaves_the_folder(tmp_path, name):
    inside, outside = tmp_path / 'inside', tmp_path / 'outside.yaml'
    folder = Folder(inside)
    outside.write_text('kept')
    (inside / 'link.yaml').symlink_to(outside)
    (inside / 'link').symlink_to(tmp_path)
    for suffix in ('.yaml', ''):
        with pytest.raises(ConfigurationError, match='name: found'):
            folder.claim_path(name, suffix)
    for file in ('../outside.yaml', '/etc/passwd', 'link.yaml', 'link', 'none.yaml'):
        with pytest.raises(ConfigurationError, match='load: found'):
            folder.load(file, None)
    assert outside.read_text() == 'kept'


def test_files_of_others_are_not_replaced(tmp_path):
    (tmp_path / 'mine.yaml').write_text('kept')
    folder = Folder(tmp_path)
    with pytest.raises(ConfigurationError, match='mine'):
        folder.claim_path('mine')
    folder.save_rig('rig', rig_of(1))
    folder.save_rig('rig', rig_of(2))
    assert folder.file_names() == ['mine.yaml', 'rig.yaml']


def test_names_are_escaped():
    text = texts.message('<img src=x onerror=alert(1)>') + texts.table(
        [('<script>', '&')], ('<b>',))
    assert '<img' not in text and '<script' not in text and '<b>' not in text
    assert '&lt;img' in text


def area_of(vertices, triangles):
    """Return the area of a mesh, square metres."""
    a, b, c = vertices[triangles].swapaxes(0, 1)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()


def test_a_mesh_is_cut_at_a_height(studio_room):
    mesh, height = studio_room[0].mesh, 1.1
    low, turned = mesh_below(mesh, height), replace(mesh, vertices=mesh.vertices * [1, 1, -1])
    assert low[0][low[1]][..., 2].max() == pytest.approx(height, abs=1e-6)
    whole = area_of(mesh.vertices, mesh.triangles)
    assert area_of(*low) + area_of(*mesh_below(turned, -height)) == pytest.approx(whole, rel=1e-5)
    assert 0.2 < area_of(*low) / whole < 0.8


def test_the_room_is_shown_as_a_mesh(page):
    page, url = page
    with client_of(url, first_can_be_dragged) as client:
        set_value(client, page.panel.room_list, texts.MESH)
        found = set()
        client.until(lambda message: found.add((message['type'], message.get('visible')))
                     or {('MeshMessage', None), ('SetSceneNodeVisibilityMessage', False)} <= found)


def test_buttons_and_fields_of_the_panel_edit_compare_and_save(page, tmp_path, undrawn):
    page, url = page
    panel, studio = page.panel, page.studio
    with client_of(url, first_can_be_dragged) as client:
        def press(handle, value, holds):
            set_value(client, handle, value)
            wait_until(holds)

        press(panel.edit_buttons, 'Add', lambda: len(studio.state.poses) == 4)
        press(panel.edit_buttons, 'Copy', lambda: len(studio.state.poses) == 5)
        press(panel.edit_buttons, 'Remove', lambda: len(studio.state.poses) == 4)
        press(panel.step_buttons, 'Undo', lambda: len(studio.state.poses) == 5)
        press(panel.step_buttons, 'Redo', lambda: len(studio.state.poses) == 4)
        press(panel.new_zone_buttons, 'region', lambda: (
            len(studio.state.rig.regions) == 1 and panel.must_see.visible))
        press(panel.must_see, 0.9, lambda: studio.state.rig.regions[0].must_see == 0.9)
        press(panel.new_zone_buttons, 'keep-out zone', lambda: len(studio.state.rig.keep_out) == 1)
        press(panel.remove_zone_button, True, lambda: not studio.state.rig.keep_out)
        press(panel.colouring_list, texts.COLOURINGS.by_requirement,
              lambda: 'too few' in panel.legend.content)
        press(panel.compare_buttons, 'Keep as A', lambda: page.kept_evaluation is not None)
        press(panel.locked_box, True, lambda: len(studio.state.locked) == 1)
        press(panel.compare_buttons, 'Go to A', lambda: not studio.state.locked)
        press(panel.compare_buttons, 'Stop', lambda: page.kept_evaluation is None)
        press(panel.save_buttons, 'Placement', (tmp_path / 'placement.yaml').exists)
        press(panel.file_name, 'my_rig', lambda: panel.file_name.value == 'my_rig')
        press(panel.save_buttons, 'Rig', (tmp_path / 'my_rig.yaml').exists)
        press(panel.export_button, True,
              lambda: 'files to my_rig' in panel.file_message.content)
        press(panel.file_name, '../up', lambda: panel.file_name.value == '../up')
        press(panel.save_buttons, 'Placement', lambda: '../up' in panel.message.content)
        press(panel.plan_buttons['Which camera to leave out'], True,
              lambda: 'realsense_d455' in panel.search_message.content)
        # A client that has not read what it was told cannot leave in order.
        client.until(lambda message: message.get('updates', {}).get(
            'content') == panel.search_message.content)
    assert not (tmp_path.parent / 'up.yaml').exists()
