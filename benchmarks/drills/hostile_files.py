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
Files that are made to do harm: to read other files, to call other machines, to fill the memory.

Each names a secret file and a listener on the loopback where its format can. ``main`` reads each
in a process of its own and counts by class what came of it.
"""

import argparse
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
import json
from multiprocessing import get_context
import os
from pathlib import Path
import socket
import struct
import sys
import tempfile
from threading import Thread
from typing import NamedTuple

from backports import zstd
from benchmarks import results
from benchmarks.drills.file_fuzz import (
    gltf_of,
    good_files,
    read_one,
    write_e57,
    write_las,
    write_obj,
)
import numpy as np
from ocp_ros.compare.comparison import run_tasks
from ocp_ros.compare.protocol import PRESETS
from ocp_ros.geometry.cameras import OPTICAL_TO_BODY
from ocp_ros.policy.agent_config import CheckpointError
from ocp_ros.policy.checkpoint import Checkpoint
from ocp_ros.registration.calibration import calibrate
from ocp_ros.registration.scan_surfaces import ScanSurfaces
from ocp_ros.rig.placement_file import load_placement, placement_of
from ocp_ros.rig.rig_file import load_rig, rig_of
from ocp_ros.rooms.generator import generate_room
from ocp_ros.ros.bags.bag_files import Bag
from ocp_ros.scenes.scene_files import load_cloud, load_scene
from ocp_ros.training.run_folder import read_config
from ocp_ros.util.settings import UserError

#: What may come of a file; the last four must not.
OUTCOMES = ('read', 'refused', 'wrong', 'crashed', 'hung', 'leaked')
#: What stands in the secret file, and seconds after which a reader hangs.
SECRET, PATIENCE = 'TOP-SECRET-4711', 120.0
#: Bytes of a page of an E57 file without and with its checksum.
LOGICAL, PHYSICAL = 1020, 1024
#: Bytes that a small file expands to, and of a file of which nothing is written.
BOMB, SPARSE = 3 << 30, 8 << 30
#: Levels of nested XML.
LEVELS = 200_000


class Hostile(NamedTuple):
    """
    A file that is made to do harm.

    :ivar kind: the class that it counts to.
    :ivar path: of the file.
    :ivar read: what reads it.
    """

    kind: str
    path: Path
    read: Callable


class Listener:
    """
    A server on the loopback that counts who connects.

    :ivar port: where it listens.
    :ivar calls: how many have.
    """

    def __init__(self) -> None:
        self.calls = 0
        self._socket = socket.create_server(('127.0.0.1', 0))
        self.port: int = self._socket.getsockname()[1]
        Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        """Take calls until it is closed."""
        while True:
            try:
                call, _ = self._socket.accept()
            except OSError:
                return
            self.calls += 1
            call.close()

    def close(self) -> None:
        """Stop."""
        self._socket.close()


def _checksum(page: bytes) -> int:
    """Return the CRC-32C of a page."""
    rest = 0xFFFFFFFF
    for byte in page:
        rest ^= byte
        for _ in range(8):
            rest = rest >> 1 ^ (0x82F63B78 if rest & 1 else 0)
    return rest ^ 0xFFFFFFFF


def rewrite_xml(path: Path, change: Callable[[str], str], encoding: str = 'utf-8') -> None:
    """Change the XML of an E57 file that pye57 has written, at its end, and its checksums."""
    content = path.read_bytes()
    start, length = struct.unpack_from('<QQ', content, 24)
    logical = b''.join(content[at:at + LOGICAL] for at in range(0, len(content), PHYSICAL))
    first = start // PHYSICAL * LOGICAL + start % PHYSICAL
    xml = change(logical[first:first + length].decode()).encode(encoding)
    logical = bytearray(logical[:first] + xml)
    logical += bytes(-len(logical) % LOGICAL)
    struct.pack_into('<Q', logical, 16, len(logical) // LOGICAL * PHYSICAL)
    struct.pack_into('<Q', logical, 32, len(xml))
    pages = [bytes(logical[at:at + LOGICAL]) for at in range(0, len(logical), LOGICAL)]
    path.write_bytes(b''.join(page + struct.pack('>I', _checksum(page)) for page in pages))


def _e57_files(folder: Path, url: str, secret: Path) -> Iterator[Hostile]:
    """Write E57 files whose XML names other files."""
    room = generate_room(3, 300)
    outside = (f'<!DOCTYPE a [<!ENTITY % f SYSTEM "file://{secret}">'
               f'<!ENTITY % d SYSTEM "{url}/d.dtd"> %d;]>')
    inside = f'<!DOCTYPE a [<!ENTITY e SYSTEM "file://{secret}">]>'
    nested = '<a>' * LEVELS + '</a>' * LEVELS + '</e57Root>'
    schema = ('<e57Root xmlns:s="http://www.w3.org/2001/XMLSchema-instance" '
              's:{}="{}{}/s.xsd" ')
    for name, old, new, encoding in (
            ('parameter', '?>', f'?>{outside}', 'utf-8'), ('entity', '?>', f'?>{inside}', 'utf-8'),
            ('utf16', '?>', f'?>{outside}', 'utf-16'),
            ('bare16', '?>', f'?>{outside}', 'utf-16-le'),
            ('ebcdic', '?>', f'?>{outside}', 'cp037'), ('latin', 'UTF-8', 'ISO-8859-1', 'utf-8'),
            ('schema', '<e57Root ', schema.format('schemaLocation', 'a ', url), 'utf-8'),
            ('bare_schema', '<e57Root ', schema.format('noNamespaceSchemaLocation', '', url),
             'utf-8'), ('nested', '</e57Root>', nested, 'utf-8')):
        path = folder / f'{name}.e57'
        write_e57(path, room.points)
        rewrite_xml(path, lambda xml, old=old, new=new: xml.replace(old, new, 1), encoding)
        yield Hostile('E57', path, load_scene)


def _mesh_files(folder: Path, url: str, secret: Path) -> Iterator[Hostile]:
    """Write meshes that name other files."""
    mesh = generate_room(3, 300).mesh
    document, buffer = gltf_of(mesh, [{'mesh': 0}])
    (folder / 'elsewhere').mkdir()
    (folder / 'elsewhere' / 'a.bin').write_bytes(buffer)
    (folder / 'link.bin').symlink_to(folder / 'elsewhere' / 'a.bin')
    os.mkfifo(folder / 'pipe')
    for number, uri in enumerate((f'{url}/a.bin', str(folder / 'elsewhere/a.bin'),
                                  'elsewhere/a.bin', '%2e%2e/a.bin', f'file://{secret}',
                                  'link.bin', 'pipe')):
        path = folder / f'buffer_{number}.gltf'
        path.write_text(json.dumps({**document, 'buffers': [
            {'byteLength': len(buffer), 'uri': uri}]}))
        yield Hostile('glTF', path, load_scene)
    picture = {'images': [{'uri': f'{url}/a.png'}], 'textures': [{'source': 0}],
               'materials': [{'pbrMetallicRoughness': {'baseColorTexture': {'index': 0}}}]}
    (folder / 'near.bin').write_bytes(buffer)
    path = folder / 'picture.gltf'
    path.write_text(json.dumps({**document, **picture, 'buffers': [
        {'byteLength': len(buffer), 'uri': 'near.bin'}]}))
    yield Hostile('glTF', path, load_scene)
    write_obj(folder / 'plain.obj', mesh)
    lines = (folder / 'plain.obj').read_text()
    (folder / 'maps.mtl').write_text(f'newmtl a\nmap_Kd {url}/a.png\nmap_Ka {folder}/pipe\n')
    for number, named in enumerate((f'{url}/a.mtl', str(secret), '../../etc/passwd', 'pipe',
                                    'maps.mtl')):
        path = folder / f'material_{number}.obj'
        path.write_text(f'mtllib {named}\nusemtl a\n{lines}')
        yield Hostile('OBJ', path, load_scene)


def _ply_files(folder: Path, url: str) -> Iterator[Hostile]:
    """Write PLY files with lists that would fill the memory, or that name pictures."""
    head = 'ply\nformat binary_little_endian 1.0\n'
    points = generate_room(3, 2000).points.astype('<f4')
    vertices = f'element vertex {len(points)}\n' + ''.join(f'property float {a}\n' for a in 'xyz')
    count = 4_000_000
    lists = f'element strip {count}\nproperty list uchar int i\n'
    for name, header, body in (
            ('after', vertices + lists, points.tobytes() + bytes(count)),
            ('before', lists + vertices, bytes(count) + points.tobytes()),
            ('picture', f'comment TextureFile {url}/a.png\n' + vertices, points.tobytes())):
        path = folder / f'{name}.ply'
        path.write_bytes(f'{head}{header}end_header\n'.encode() + body)
        yield Hostile('PLY', path, load_scene)


def _texts(folder: Path, url: str, secret: Path) -> Iterator[Hostile]:
    """Write settings that name other files, texts and weights without end, and long lines."""
    for name, text, read in (
            ('tag.yaml', f'cameras: !include {secret}', load_rig),
            ('object.yaml', "cameras: !!python/object/apply:os.system ['true']", load_rig),
            ('alias.yaml', 'a: &a [1]\ncameras: [*a, *a]', load_rig),
            ('room.yaml', f'cameras: [{{sensor: kinect_v2, position: [1, 1, 1]}}]\n'
                          f'room: {{file: "{url}/a.ply"}}', load_placement),
            ('engine.yaml', 'cameras: [{sensor: kinect_v2, position: [1, 1, 1]}]\n'
                            'engine: {preset: fine, error_rows: 2048, error_folds: 16}',
             load_placement),
            ('train.yaml', f'model: !!python/name:os.system {secret}', read_config)):
        (folder / name).write_text(text)
        yield Hostile('YAML', folder / name, read)
    for name, kind, read in (('line.txt', 'text', load_scene), ('line.xyz', 'text', load_scene),
                             ('sparse.safetensors', 'weights', _load_weights),
                             ('compared.safetensors', 'weights', _compare_weights),
                             ('sparse.yaml', 'YAML', load_rig), ('sparse.obj', 'OBJ', load_scene),
                             ('sparse.glb', 'glTF', load_scene)):
        with (folder / name).open('wb') as file:
            file.truncate(SPARSE)
        yield Hostile(kind, folder / name, read)
    # Lines whose time or memory could grow with the square of their length.
    for name, line in (('name.xyz', 'x' * 99_000), ('names.xyz', 'x ' * 49_000),
                       ('bracket.csv', f'{"[" * 90_000};b;c'),
                       ('unit.xyz', f'# unit {"9" * 15_000} a')):
        (folder / name).write_text(f'{line}\n1 2 3\n')
        yield Hostile('text', folder / name, load_scene)
    for name, number in (('dots', '1.2.3'), ('digits', '9' * 30_000)):
        path = folder / f'{name}.las'
        write_las(path, generate_room(3, 2000).points,
                  projection=f'UNIT["{"m" * 30_000}",{number}]')
        yield Hostile('LAS', path, load_scene)


def _load_weights(path: Path) -> None:
    """Read weights; their error counts as one of the user."""
    try:
        Checkpoint.load(path)
    except CheckpointError as error:
        raise UserError(str(error)) from error


def _compare_weights(path: Path) -> None:
    """Begin a comparison with weights."""
    run_tasks(replace(PRESETS['smoke'], model=str(path)), path.with_suffix('.out'))


def _clouds(folder: Path) -> Iterator[Hostile]:
    """Write clouds of few places, as a stuck driver sends them."""
    for name, places in (('same', [[0.0, 0.0, 2.0]]), ('two', [[0.0, 0.0, 2.0], [0.5, 0.0, 2.0]]),
                         ('ray', np.outer(np.linspace(1.0, 5.0, 50), [0.0, 0.0, 1.0]))):
        path = folder / f'{name}.npy'
        np.save(path, np.tile(places, (100, 1)).repeat(2, axis=0))
        yield Hostile('cloud', path, _calibrate)


def _calibrate(path: Path) -> None:
    """Register a camera by a cloud in the optical frame; a refusal counts as one of the file."""
    placement = placement_of(rig_of(1, 'realsense_d455'), np.array([[0.4, 0.5, 2.2, 0.7, 0.4, 0]]))
    name = placement.cameras[0].camera.name
    found, reasons = calibrate(ScanSurfaces(generate_room(3, 3000)), placement,
                               {name: load_cloud(path) @ OPTICAL_TO_BODY.T})
    if reason := reasons.get(name) or found[name].refused:
        # The command names the camera.
        raise UserError(f'{path.name}: {reason}')


def _zeros() -> bytes:
    """Return many zeros, packed."""
    packer, piece = zstd.ZstdCompressor(), bytes(1 << 24)
    return b''.join(packer.compress(piece) for _ in range(BOMB >> 24)) + packer.flush()


def _bags(folder: Path, secret: Path) -> Iterator[Hostile]:
    """Write bags that expand, compute, name other files or never end."""
    import apsw
    good_files(folder / 'good')
    bomb = _zeros()

    def bag(name: str, storage: str = 's') -> Path:
        path = folder / f'bag_{name}'
        path.mkdir()
        recorded = 'sqlite3.db3' if storage == 's' else 'mcap.mcap'
        metadata = (folder / 'good' / storage / 'metadata.yaml').read_text()
        stored = f'{storage}{Path(recorded).suffix}'
        (path / stored).write_bytes((folder / 'good' / recorded).read_bytes())
        (path / 'metadata.yaml').write_text(metadata)
        return path

    def change(path: Path, *statements: tuple) -> None:
        database = apsw.Connection(str(path / 's.db3'))
        for statement in statements:
            database.execute(*statement)
        database.close()

    def packed(path: Path, mode: str) -> str:
        text = (path / 'metadata.yaml').read_text()
        return text.replace("compression_format: ''", 'compression_format: zstd').replace(
            "compression_mode: ''", f'compression_mode: {mode}')

    path = bag('message_bomb')
    change(path, ('UPDATE messages SET data = ?', (bomb,)))
    (path / 'metadata.yaml').write_text(packed(path, 'MESSAGE'))
    yield Hostile('bag', path, _read_bag)
    path = bag('file_bomb')
    (path / 's.db3').unlink()
    (path / 's.db3.zstd').write_bytes(bomb)
    (path / 'metadata.yaml').write_text(packed(path, 'FILE').replace('s.db3', 's.db3.zstd'))
    yield Hostile('bag', path, _read_bag)
    path = bag('chunk_bomb', 'm')
    (path / 'm.mcap').write_bytes(_mcap_of(bomb))
    yield Hostile('bag', path, _read_bag)
    path = bag('column')
    change(path, ('DROP TABLE messages',), (
        'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data '
        'BLOB AS (zeroblob(1000000000)))',),
        *(('INSERT INTO messages(topic_id, timestamp) VALUES (1, 0)',),) * 20)
    yield Hostile('bag', path, _read_bag)
    path = bag('view')
    change(path, ('DROP TABLE messages',), (
        'CREATE VIEW messages AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id FROM n) '
        "SELECT id, 1 AS topic_id, 0 AS timestamp, x'00' AS data FROM n",))
    yield Hostile('bag', path, _read_bag)
    path = bag('pipe')
    (path / 's.db3').unlink()
    os.mkfifo(path / 's.db3')
    yield Hostile('bag', path, _read_bag)
    for name, named in (('absolute', str(secret)), ('parent', '../good/sqlite3.db3')):
        path = bag(name)
        text = (path / 'metadata.yaml').read_text()
        (path / 'metadata.yaml').write_text(text.replace('s.db3', named))
        (path / 's.db3').unlink()
        yield Hostile('bag', path, _read_bag)


def _mcap_of(packed: bytes) -> bytes:
    """Return an MCAP file with one chunk."""
    def record(kind: int, content: bytes) -> bytes:
        return struct.pack('<BQ', kind, len(content)) + content

    def text(content: str) -> bytes:
        return struct.pack('<I', len(content)) + content.encode()

    magic = b'\x89MCAP0\r\n'
    chunk = struct.pack('<QQQI', 0, 1, BOMB, 0) + text('zstd') + struct.pack(
        '<Q', len(packed)) + packed
    content = magic + record(1, text('ros2') + text('')) + record(6, chunk)
    return content + record(2, struct.pack('<QQI', 0, 0, 0)) + magic


def _read_bag(path: Path) -> None:
    """Read all of a bag."""
    with Bag(path) as bag:
        for topic in bag.topics:
            bag.frames(topic)
        for _ in bag.messages([topic.name for topic in bag.topics]):
            pass


def hostile_files(folder: Path, port: int) -> list[Hostile]:
    """
    Write all files.

    :param folder: an empty one.
    :param port: of a listener on the loopback.
    """
    url, secret = f'http://127.0.0.1:{port}', folder / 'secret'
    secret.write_text(SECRET)
    (folder / 'good').mkdir()
    return [*_e57_files(folder, url, secret), *_mesh_files(folder, url, secret),
            *_ply_files(folder, url), *_texts(folder, url, secret), *_bags(folder, secret),
            *_clouds(folder)]


def outcome_of(hostile: Hostile, listener: Listener) -> str:
    """Read a file in a process that may be lost, and return one of ``OUTCOMES``."""
    before = listener.calls
    context = get_context('fork')
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(
        target=lambda: sender.send(read_one(hostile.read, hostile.path)))
    process.start()
    sender.close()
    process.join(PATIENCE)
    if process.is_alive():
        process.kill()
        return 'hung'
    try:
        outcome, said = receiver.recv()
    except EOFError:
        return 'crashed'
    return 'leaked' if listener.calls > before or SECRET in said else outcome


def main(argv: list[str] | None = None) -> int:
    """Run; 2 if a file did harm."""
    parser = argparse.ArgumentParser(prog='hostile_files', description=__doc__)
    results.add_record(parser, 'hostile_files')
    options = parser.parse_args(argv)
    listener, counts = Listener(), {}
    with tempfile.TemporaryDirectory() as place:
        for hostile in hostile_files(Path(place), listener.port):
            outcome = outcome_of(hostile, listener)
            counts.setdefault(hostile.kind, Counter())[outcome] += 1
            print(f'{hostile.kind:12} {hostile.path.name:22} {outcome}', flush=True)
    found = {kind: {outcome: count[outcome] for outcome in OUTCOMES}
             for kind, count in counts.items()}
    if options.record:
        results.write('hostile_files', {'classes': found},
                      results.command_of('drills.hostile_files', argv))
    return 2 if any(count[outcome] for count in found.values() for outcome in OUTCOMES[2:]) else 0


if __name__ == '__main__':
    sys.exit(main())
