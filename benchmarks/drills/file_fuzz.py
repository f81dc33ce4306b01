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
Read files with errors in them, and see that each is read or refused in one sentence.

There is a good file of every format that the package reads; errors are put into copies of it.
Files are read in a process that may be lost: who crashes, hangs or takes too much memory is
counted, and the next file is read by a new one.
"""

import argparse
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib import import_module
from importlib.util import find_spec
import json
import os
from pathlib import Path
import queue
import resource
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
import warnings

from benchmarks import results
import laspy
import numpy as np
from ocp_ros.rig.placement_file import load_placement
from ocp_ros.rig.rig_file import load_rig
from ocp_ros.rooms.generator import generate_room
from ocp_ros.scenes.scene import Mesh
from ocp_ros.scenes.scene_files import load_scene
from ocp_ros.util import guarded_process
from ocp_ros.util.settings import UserError
from plyfile import PlyData, PlyElement
import pye57
from scipy.spatial.transform import Rotation

#: What may come of a file; the last three must not.
OUTCOMES = ('read', 'refused', 'wrong', 'crashed', 'hung')
#: Seconds after which a file hangs, and until a process is ready.
PATIENCE, START = 300.0, 600.0
#: Bytes of address space of the process that reads, and characters of a sentence.
MOST, SENTENCE = 4_000_000_000, 2500
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


def write_las(path, points, offsets=(0.0, 0.0, 0.0), projection=''):
    """Write points (N, 3) as LAS or LAZ, by the suffix, with a projection as WKT."""
    header = laspy.LasHeader(point_format=3, version='1.2')
    header.scales, header.offsets = [1e-4] * 3, offsets
    if projection:
        header.vlrs.append(laspy.VLR('LASF_Projection', 2112, '', projection.encode()))
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
            for stamp in range(20):
                writer.write(connection, stamp, store.cdr_to_ros1(raw, kind) if old else raw)
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
    (folder / 'rig.yaml').write_bytes((results.ROOT / 'config/rig/mixed.yaml').read_bytes())
    (folder / 'train.yaml').write_bytes((results.ROOT / 'config/train/actor.yaml').read_bytes())
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


class ForkedProcesses:
    """What :mod:`subprocess` does, for readers of files that are loaded already."""

    DEVNULL, PIPE, TimeoutExpired = subprocess.DEVNULL, subprocess.PIPE, subprocess.TimeoutExpired

    def __init__(self) -> None:
        # What takes long to import is imported once.
        import laspy  # noqa: F401
        import open3d  # noqa: F401
        self.memory = 0

    def Popen(self, command: list[str], stderr, **_) -> 'ForkedProcess':  # noqa: N802
        """Run a reader in a copy of this process."""
        return ForkedProcess(self, import_module(command[3]).main, command[4:], stderr)


class ForkedProcess:
    """
    A copy of this process that runs a reader.

    :param family: notes the memory that it took.
    :param stderr: where it says what is wrong.
    """

    def __init__(self, family: ForkedProcesses, run: Callable[[list[str]], int],
                 arguments: list[str], stderr) -> None:
        self._family, self._code = family, None
        asked, asking = os.pipe()
        answers, answering = os.pipe()
        self._child = os.fork()
        if self._child == 0:
            # Whatever happens, the copy must not go on as the original does.
            try:
                os.close(asking)
                os.close(answers)
                sys.stdin = os.fdopen(asked)
                os.dup2(answering, 1)
                os.dup2(stderr.fileno(), 2)
                os.close(answering)
                code = run(arguments)
            except BaseException:
                code = 1
            finally:
                os._exit(code)
        os.close(asked)
        os.close(answering)
        self.stdin, self.stdout = os.fdopen(asking, 'wb'), os.fdopen(answers, 'rb')

    def kill(self) -> None:
        """Kill it."""
        if self._code is None:
            os.kill(self._child, signal.SIGKILL)

    def wait(self, timeout: float | None = None) -> int:
        """Return the code that it ended with."""
        if self._code is None:
            _, status, used = os.wait4(self._child, 0)
            self._family.memory = max(self._family.memory, used.ru_maxrss)
            self._code = os.waitstatus_to_exitcode(status)
        return self._code


def read_one(reader, path: Path) -> tuple[str, str]:
    """Read a file; returns one of ``OUTCOMES`` and what was said."""
    try:
        reader(path)
    except UserError as error:
        said = str(error)
        plain = path.name in said and '\n' not in said and len(said) < SENTENCE
        return ('refused' if plain else 'wrong'), said
    except Exception as error:
        return 'wrong', f'{type(error).__name__}: {error}'
    return 'read', ''


def work(name: str, seed: int, start: int, stop: int) -> None:
    """Read the spoilt files of a format, and print a line about each, before and after."""
    resource.setrlimit(resource.RLIMIT_AS, (MOST, MOST))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    warnings.simplefilter('ignore')
    guarded_process.subprocess = forked = ForkedProcesses()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        reader = good_files(folder)[name]
        content = (folder / name).read_bytes()
        outcome, said = read_one(reader, folder / name)
        print(json.dumps(['good', outcome, said]), flush=True)
        for number in range(start, stop):
            path = folder / f'spoilt_{name}'
            path.write_bytes(spoilt(np.random.default_rng([seed, number]), content))
            Path('/proc/self/clear_refs').write_text('5')
            forked.memory = 0
            print(json.dumps(['begin', number]), flush=True)
            began = time.monotonic()
            outcome, said = read_one(reader, path)
            seconds = time.monotonic() - began
            peak = int(Path('/proc/self/status').read_text().split('VmHWM:')[1].split()[0])
            memory = max(peak, forked.memory) / 1024
            print(json.dumps(['end', number, outcome, said, seconds, memory]), flush=True)


class FormatTrial:
    """
    All spoilt files of a format.

    :ivar counts: how many came to what.
    :ivar seconds: of each file.
    :ivar memory: largest resident memory, MB.
    :ivar bad: number, outcome and words of files that were neither read nor refused well.
    """

    def __init__(self, name: str, mutations: int, seed: int) -> None:
        self.name, self.mutations, self.seed = name, mutations, seed
        self.counts: Counter = Counter()
        self.seconds: list[float] = []
        self.memory, self.bad = 0.0, []

    def run(self) -> 'FormatTrial':
        """Read them all, with as many processes as it takes."""
        done = 0
        while done < self.mutations:
            done = self._one_process(done)
        return self

    def _one_process(self, start: int) -> int:
        """Read with a new process, as long as it lives; returns the next file's number."""
        command = [sys.executable, '-m', 'benchmarks.drills.file_fuzz', '--work', self.name,
                   str(self.seed), str(start), str(self.mutations)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
                              text=True, cwd=results.ROOT) as process:
            lines: queue.Queue = queue.Queue()

            def listen() -> None:
                for line in process.stdout:
                    lines.put(line)
                lines.put('')

            listener = threading.Thread(target=listen)
            listener.start()
            try:
                return self._follow(process, lines)
            finally:
                process.kill()
                listener.join()

    def _follow(self, process: subprocess.Popen, lines: queue.Queue) -> int:
        """Note what a process says about its files, until it ends or says nothing for long."""
        current, patience = None, START
        while True:
            try:
                line = lines.get(timeout=patience)
            except queue.Empty:
                if current is None:
                    raise RuntimeError(
                        f'{self.name}: no process read within {patience:.0f} s') from None
                return self._lost(current, 'hung', '')
            if not line:
                return self._ended(process, current)
            kind, *values = json.loads(line)
            if kind == 'begin':
                current, patience = values[0], PATIENCE
            elif kind == 'end':
                self._note(*values)
                current, patience = None, START
            elif values[0] != 'read':
                raise RuntimeError(f'{self.name}: a good file is not read: {values}')

    def _ended(self, process: subprocess.Popen, current: int | None) -> int:
        """Return the next file's number once a process has ended."""
        code = process.wait()
        if current is None:
            if code:
                raise RuntimeError(f'{self.name}: the process that reads ended with {code}')
            return self.mutations
        return self._lost(current, 'crashed', f'ended with {code}')

    def _lost(self, number: int, outcome: str, said: str) -> int:
        """Note a file that took its process with it."""
        self.counts[outcome] += 1
        self.bad.append([number, outcome, said])
        return number + 1

    def _note(self, number: int, outcome: str, said: str, seconds: float, memory: float) -> None:
        """Note what came of a file."""
        self.counts[outcome] += 1
        self.seconds.append(seconds)
        self.memory = max(self.memory, memory)
        if outcome == 'wrong':
            self.bad.append([number, outcome, said[:300]])

    def figures(self) -> dict:
        """Return what was found."""
        return {'format': self.name, 'mutations': self.mutations,
                **{outcome: self.counts[outcome] for outcome in OUTCOMES},
                'longest_seconds': round(max(self.seconds, default=0.0), 2),
                'peak_mb': round(self.memory), 'bad': self.bad[:40]}


def parser() -> argparse.ArgumentParser:
    """Build the parser."""
    top = argparse.ArgumentParser(prog='file_fuzz', description=__doc__)
    top.add_argument('--mutations', type=int, default=2000, help='spoilt files of each format')
    top.add_argument('--seed', type=int, default=0, help='of the errors')
    top.add_argument('--formats', nargs='*', help='names such as las.las; all unless named')
    top.add_argument('--jobs', type=int, default=1, help='formats at once')
    top.add_argument('--out', type=Path, default=Path('out'), help='folder for the results')
    results.add_record(top, 'drills')
    return top


def main(args: list[str] | None = None) -> int:
    """Run; 2 if a file did what it must not."""
    args = sys.argv[1:] if args is None else args
    if args[:1] == ['--work']:
        work(args[1], *map(int, args[2:]))
        return 0
    options = parser().parse_args(args)
    with tempfile.TemporaryDirectory() as folder:
        names = options.formats or list(good_files(Path(folder)))
    found = []
    with ThreadPoolExecutor(options.jobs) as pool:
        trials = [FormatTrial(name, options.mutations, options.seed) for name in names]
        for trial in pool.map(FormatTrial.run, trials):
            found.append(trial.figures())
            print({key: value for key, value in found[-1].items() if key != 'bad'}, flush=True)
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / 'file_fuzz.json').write_text(json.dumps(found, indent=1) + '\n')
    if options.record:
        totals = {key: sum(one[key] for one in found) for key in ('mutations', *OUTCOMES)}
        results.write('drills', {**totals, 'formats': found},
                      results.command_of('drills.file_fuzz', args), 'file_fuzz')
    return 2 if any(one[outcome] for one in found for outcome in OUTCOMES[2:]) else 0


if __name__ == '__main__':
    sys.exit(main())
