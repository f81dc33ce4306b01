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

"""Good files of every format that the package reads, and the same files with errors in them."""

from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
import json
from pathlib import Path
import shutil
import struct

from benchmarks.results import ROOT
import laspy
import numpy as np
from ocp_ros.rig.placement_file import load_placement
from ocp_ros.rig.rig_file import load_rig
from ocp_ros.rooms.generator import generate_room
from ocp_ros.scenes.scene import Mesh
from ocp_ros.scenes.scene_files import load_scene
from plyfile import PlyData, PlyElement
import pye57
from scipy.spatial.transform import Rotation

#: What bytes and numbers of a file are made to be.
BYTES = (b'\0' * 4, b'\xff' * 4, b'\x7f\xff\xff\xff', b'\xff' * 8, b'\0\0\xc0\x7f')
WORDS = (b'-1', b'0', b'4294967295', b'99999999999999999999', b'1e308', b'nan', b'9' * 6000,
         b'*a', b'&a', b'[' * 500, b'2024-13-45', b'!!python/object:os.system', b'\xff', b'"')


def write_ply(path, points, text=False, kind='f4', order='xyz', **more):
    """Write points (N, 3) as PLY, with more columns if there are any."""
    columns = {axis: points[:, 'xyz'.index(axis)] for axis in order} | more
    rows = np.zeros(len(points), dtype=[(name, kind) for name in columns])
    for name, column in columns.items():
        rows[name] = column
    PlyData([PlyElement.describe(rows, 'vertex')], text=text).write(str(path))


def write_pcd(path, points, kind='F', size=4, data='binary', count=None,
              viewpoint='0 0 0 1 0 0 0'):
    """Write points (N, 3) as PCD, with a count of points that may be wrong."""
    count = len(points) if count is None else count
    header = (f'# .PCD v0.7\nVERSION 0.7\nFIELDS _ z x y\nSIZE 1 {size} {size} {size}\n'
              f'TYPE U {kind} {kind} {kind}\nCOUNT 3 1 1 1\nWIDTH {count}\nHEIGHT 1\n'
              f'VIEWPOINT {viewpoint}\nPOINTS {count}\nDATA {data}\n')
    rows = np.zeros(len(points), dtype=[('_', 'u1', 3)] + [(axis, f'f{size}') for axis in 'zxy'])
    rows['x'], rows['y'], rows['z'] = points.T
    lines = ''.join(f'0 0 0 {z:.7f} {x:.7f} {y:.7f}\n' for x, y, z in points.tolist())
    path.write_bytes(header.encode() + (lines.encode() if data == 'ascii' else rows.tobytes()))


def write_packed_pcd(path, points):
    """Write points (N, 3) as compressed PCD, though nothing is saved: in literals alone."""
    body = np.ascontiguousarray(points.T, dtype='<f4').tobytes()
    packed = b''.join(bytes([len(part) - 1]) + part for part in (
        body[at:at + 32] for at in range(0, len(body), 32)))
    path.write_bytes(
        f'VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {len(points)}\n'
        f'HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA binary_compressed\n'
        .encode() + struct.pack('<II', len(packed), len(body)) + packed)


def write_las(path, points, offsets=(0.0, 0.0, 0.0)):
    """Write points (N, 3) as LAS or LAZ, by the suffix."""
    header = laspy.LasHeader(point_format=3, version='1.2')
    header.scales, header.offsets = [1e-4] * 3, offsets
    content = laspy.LasData(header)
    content.x, content.y, content.z = points.astype(np.float64).T
    content.write(path)


def write_e57(path, points, poses=((1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),)):
    """Write points (N, 3) as E57: a scan for each pose, a unit quaternion and a position."""
    with pye57.E57(str(path), mode='w') as file:
        for part, pose in zip(np.array_split(points.astype(np.float64), len(poses)), poses):
            turn, position = Rotation.from_quat(np.roll(pose[:4], -1)), np.array(pose[4:])
            local = turn.inv().apply(part - position)
            columns = dict(zip(('cartesianX', 'cartesianY', 'cartesianZ'),
                               np.ascontiguousarray(local.T)))
            file.write_scan_raw(columns, rotation=np.array(pose[:4]), translation=position)


def write_text(path, points, tail=''):
    """Write points (N, 3) as lines, with something behind the coordinates."""
    path.write_text(''.join(f'{x:.7f} {y:.7f} {z:.7f}{tail}\n' for x, y, z in points.tolist()))


def write_records(path, points):
    """Write points (N, 3) as a NumPy array of records."""
    rows = np.zeros(len(points), dtype=[('i', 'u1'), ('z', 'f8'), ('x', 'f8'), ('y', 'f8')])
    rows['x'], rows['y'], rows['z'] = points.T
    np.save(path, rows)


def write_ply_mesh(path: Path, mesh: Mesh) -> None:
    """Write a mesh as PLY."""
    rows = np.rec.fromarrays(mesh.vertices.T, dtype=[(axis, 'f4') for axis in 'xyz'])
    faces = np.empty(len(mesh.triangles), dtype=[('vertex_indices', 'i4', (3,))])
    faces['vertex_indices'] = mesh.triangles
    PlyData([PlyElement.describe(rows, 'vertex'), PlyElement.describe(faces, 'face')]).write(
        str(path))


def write_obj(path: Path, mesh: Mesh) -> None:
    """Write a mesh as OBJ."""
    path.write_text(''.join(f'v {x:.6f} {y:.6f} {z:.6f}\n' for x, y, z in mesh.vertices.tolist())
                    + ''.join(f'f {a} {b} {c}\n' for a, b, c in (mesh.triangles + 1).tolist()))


def write_off(path: Path, mesh: Mesh) -> None:
    """Write a mesh as OFF."""
    path.write_text(f'OFF\n{len(mesh.vertices)} {len(mesh.triangles)} 0\n' + ''.join(
        f'{x:.6f} {y:.6f} {z:.6f}\n' for x, y, z in mesh.vertices.tolist()) + ''.join(
        f'3 {a} {b} {c}\n' for a, b, c in mesh.triangles.tolist()))


def write_stl(path: Path, mesh: Mesh) -> None:
    """Write a mesh as binary STL."""
    rows = np.zeros(len(mesh.triangles), dtype=[('n', '<f4', 3), ('c', '<f4', (3, 3)),
                                                ('more', '<u2')])
    rows['c'] = mesh.vertices[mesh.triangles]
    path.write_bytes(b'binary'.ljust(80) + struct.pack('<I', len(rows)) + rows.tobytes())


def gltf_of(mesh: Mesh, nodes: list[dict]) -> tuple[dict, bytes]:
    """Return a glTF document and its buffer; in the nodes the mesh has the number 0."""
    places = mesh.vertices.astype('<f4')
    buffer = places.tobytes() + mesh.triangles.astype('<u4').tobytes()
    start = places.nbytes
    return {
        'asset': {'version': '2.0'}, 'scene': 0, 'scenes': [{'nodes': [0]}], 'nodes': nodes,
        'meshes': [{'primitives': [{'attributes': {'POSITION': 0}, 'indices': 1}]}],
        'buffers': [{'byteLength': len(buffer)}],
        'bufferViews': [{'buffer': 0, 'byteOffset': 0, 'byteLength': start},
                        {'buffer': 0, 'byteOffset': start, 'byteLength': len(buffer) - start}],
        'accessors': [
            {'bufferView': 0, 'componentType': 5126, 'count': len(places), 'type': 'VEC3',
             'min': places.min(axis=0).tolist(), 'max': places.max(axis=0).tolist()},
            {'bufferView': 1, 'componentType': 5125, 'count': mesh.triangles.size,
             'type': 'SCALAR'}]}, buffer


def write_glb(path: Path, mesh: Mesh, nodes: list[dict] | None = None) -> None:
    """Write a mesh as binary glTF, in a scene graph if one is given."""
    document, buffer = gltf_of(mesh, [{'mesh': 0}] if nodes is None else nodes)
    text = json.dumps(document).encode()
    text += b' ' * (-len(text) % 4)
    path.write_bytes(struct.pack('<4sII', b'glTF', 2, 28 + len(text) + len(buffer))
                     + struct.pack('<I4s', len(text), b'JSON') + text
                     + struct.pack('<I4s', len(buffer), b'BIN\0') + buffer)


def _placement(path: Path) -> None:
    """Write a placement of two cameras."""
    path.write_text('version: 1\ncameras:\n' + ''.join(
        f'- {{name: c{k}, sensor: realsense_d455, position: [{k + 1.0}, 1.0, 1.9], yaw: 30.0}}\n'
        for k in range(2)))


def _read_config(path: Path):
    """Read training settings."""
    from ocp_ros.training.run_folder import read_config
    return read_config(path)


def _write_bags(folder: Path) -> dict[str, Callable]:
    """Write a text in a bag of each kind; returns the names of their files and what reads them."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import get_typestore, Stores

    kind = 'geometry_msgs/msg/PoseArray'
    store = get_typestore(Stores.ROS2_JAZZY)
    types = store.types
    header = types['std_msgs/msg/Header'](types['builtin_interfaces/msg/Time'](1, 0), 'map')
    message = types[kind](header, [])
    readers: dict[str, Callable] = {}
    for name, writer in (('ros1.bag', Writer1(folder / 'ros1.bag')),
                         ('mcap.mcap', Writer2(folder / 'm', version=9,
                                               storage_plugin=StoragePlugin.MCAP)),
                         ('sqlite3.db3', Writer2(folder / 's', version=9,
                                                 storage_plugin=StoragePlugin.SQLITE3))):
        old = name == 'ros1.bag'
        with writer:
            connection = writer.add_connection(
                '/poses', kind, typestore=get_typestore(Stores.ROS1_NOETIC) if old else store)
            raw = bytes(store.serialize_cdr(message, kind))
            for time in range(20):
                writer.write(connection, time, store.cdr_to_ros1(raw, kind) if old else raw)
        if not old:
            recorded, = (folder / name[0]).glob(f'*{Path(name).suffix}')
            recorded.rename(folder / name)
        readers[name] = partial(_read_bag, folder / name[0] / 'metadata.yaml')
    (folder / 'metadata.yaml').write_bytes((folder / 'm' / 'metadata.yaml').read_bytes())
    readers['metadata.yaml'] = partial(_read_bag, folder / 'mcap.mcap')
    return readers


def _read_bag(beside: Path, path: Path) -> None:
    """Read all of a bag, or of one of two files that are one together."""
    from ocp_ros.ros.bags.bag_files import Bag
    if path.suffix == '.bag':
        place = path
    else:
        place = path.parent / 'read' / path.name
        place.mkdir(parents=True, exist_ok=True)
        metadata, recorded = sorted((beside, path), key=lambda one: one.suffix != '.yaml')
        shutil.copy(metadata, place / 'metadata.yaml')
        shutil.copy(recorded, place / f'{"m" if recorded.suffix == ".mcap" else "s"}'
                    f'{recorded.suffix}')
    with Bag(place) as bag:
        list(bag.messages([topic.name for topic in bag.topics]))


def good_files(folder: Path) -> dict[str, Callable]:
    """Write a good file of each format; returns their names and what reads them."""
    room = generate_room(3, 600)
    points, mesh = room.points, room.mesh
    for name, write in {
            'las.las': write_las, 'laz.laz': write_las, 'e57.e57': write_e57,
            'ply_binary.ply': write_ply,
            'npy.npy': np.save, 'records.npy': write_records, 'xyz.xyz': write_text,
            'pcd_binary.pcd': write_pcd, 'pcd_packed.pcd': write_packed_pcd}.items():
        write(folder / name, points)
    write_ply(folder / 'ply_ascii.ply', points, text=True)
    write_pcd(folder / 'pcd_ascii.pcd', points, data='ascii')
    write_text(folder / 'txt.txt', points, ' 12 34 56')
    for name, write_mesh in {'mesh.ply': write_ply_mesh, 'obj.obj': write_obj,
                             'off.off': write_off, 'stl.stl': write_stl,
                             'glb.glb': write_glb}.items():
        write_mesh(folder / name, mesh)
    (folder / 'room.yaml').write_text(
        'size: [6, 4.5, 2.7]\nopenings: [{wall: south, at: 1, width: 0.9, height: 2.1}]\n'
        'boxes: [{box: [[2, 1, 0], [4, 2, 0.75]]}]\n')
    readers: dict[str, Callable] = {path.name: load_scene for path in sorted(folder.iterdir())}
    (folder / 'rig.yaml').write_bytes((ROOT / 'config/rig/mixed.yaml').read_bytes())
    (folder / 'train.yaml').write_bytes((ROOT / 'config/train/actor.yaml').read_bytes())
    _placement(folder / 'placement.yaml')
    if find_spec('rosbags'):
        readers |= _write_bags(folder)
    return readers | {'rig.yaml': load_rig, 'placement.yaml': load_placement,
                      'train.yaml': _read_config}


def spoilt(rng: np.random.Generator, content: bytes) -> bytes:
    """
    Change a file as torn copies, broken disks and people with bad intentions do.

    Half of the changes lie in the first 400 bytes, where headers are.
    """
    torn = bytearray(content)
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        most = min(len(torn), 400) if rng.random() < 0.5 else len(torn)
        at = int(rng.integers(max(most, 1)))
        kind = rng.integers(7)
        if kind < 2:
            for place in rng.integers(at, len(torn) + 1, size=rng.integers(1, 6)):
                torn[int(place):int(place) + 1] = rng.bytes(1)
        elif kind == 2:
            word = BYTES[rng.integers(len(BYTES))]
            torn[at:at + len(word)] = word
        elif kind == 3:
            _replace_number(rng, torn, at)
        elif kind == 4:
            del torn[at:at + int(rng.integers(1, 60))]
        elif kind == 5:
            torn[at:at] = rng.bytes(int(rng.integers(1, 60)))
        else:
            end = int(rng.integers(at, len(torn) + 1))
            torn[at:at] = torn[at:min(end, at + 4096)]
    if rng.random() < 0.1:
        del torn[int(rng.integers(len(torn) + 1)):]
    return bytes(torn)


def _replace_number(rng: np.random.Generator, torn: bytearray, at: int) -> None:
    """Replace the next word of a text by one that means trouble."""
    start = next((k for k in range(at, min(at + 200, len(torn))) if torn[k:k + 1].isdigit()), at)
    end = start
    while end < len(torn) and end < start + 20 and torn[end] not in b' \n,]}':
        end += 1
    torn[start:end] = WORDS[rng.integers(len(WORDS))]
