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

"""Scans in files of every format, and files that are none."""

from functools import partial
import logging
import os

from benchmarks.drills import file_fuzz as files
from conftest import made_room, refusal, ROOT
import numpy as np
from ocp_ros.geometry.clouds import voxel_downsample
from ocp_ros.scenes.scene import Scene, SceneError
from ocp_ros.scenes.scene_files import load_scene, scene_of, SceneWarning
from ocp_ros.scenes.source_frame import map_from_file
import pytest

SCANS = ROOT.parent / 'shared' / 'data' / 'rooms'
ROOM = made_room(3, 2500).points
NORMALS = ('nx', 'ny', 'nz')


def write_table(path, points, separator, header='', axes='xyz', decimal='.'):
    """Write a line for each point, below a header that may have their number."""
    lines = [separator.join(f'{value:.7f}'.replace('.', decimal) for value in point)
             for point in points[:, ['xyz'.index(axis) for axis in axes]].tolist()]
    header = [header.format(len(points))] if header else []
    path.write_text('\n'.join([*header, *lines]) + '\n', encoding='utf-8')


def ptx_of(points):
    """Return a scan of one column, turned by 90 degrees, with two returns that are none."""
    local = (points - [1.0, 2.0, 0.5])[:, [1, 0, 2]] * [-1.0, 1.0, 1.0]
    rows = np.insert(local, [0, len(local)], 0.0, axis=0)
    head = (f'1\n{len(rows)}\n1 2 0.5\n0 -1 0\n1 0 0\n0 0 1\n'
            '0 -1 0 0\n1 0 0 0\n0 0 1 0\n1 2 0.5 1\n')
    return head + ''.join('{:.7f} {:.7f} {:.7f} 0.5\n'.format(*row) for row in rows.tolist())


def write_with_comments(path, points):
    files.write_text(path, points, '  # a point')
    path.write_text(f'# a scan\n\n{path.read_text()}\n# the end')


def write_pcd_with_open3d(path, points):
    open3d = pytest.importorskip('open3d')
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(np.float64)))
    assert open3d.io.write_point_cloud(str(path), cloud, compressed=True)


FORMATS = {
    'ascii.ply': partial(files.write_ply, text=True),
    'double.ply': partial(files.write_ply, kind='f8', order='zxy'),
    'double.pcd': partial(files.write_pcd, size=8),
    'ascii.pcd': partial(files.write_pcd, data='ascii'),
    'compressed.pcd': write_pcd_with_open3d,
    'sensor.pcd': lambda path, points: files.write_pcd(
        path, (points - [3.0, 2.0, 1.4])[:, [1, 0, 2]] * [1.0, -1.0, 1.0],
        viewpoint='3 2 1.4 0.70710678 0 0 0.70710678'),
    'scan.las': files.write_las,
    'scan.laz': files.write_las,
    'two_scans.e57': partial(files.write_e57, poses=(
        (1.0, 0.0, 0.0, 0.0, 1.0, 2.0, 1.5), (0.6, 0.0, 0.0, 0.8, -3.0, 0.5, 1.4))),
    'wide.npy': lambda path, points: np.save(path, np.hstack([points, points])),
    'records.npy': files.write_records,
    'CAPITALS.XYZ': files.write_text,
    'comments.xyz': write_with_comments,
    # As in a copy of S3DIS.
    'broken_colours.txt': partial(files.write_text, tail=' 185\x10187 184'),
    'commas.csv': partial(write_table, separator=','),
    'named.csv': partial(write_table, separator=',', header='Z,"Y",X', axes='zyx'),
    'excel.csv': partial(write_table, separator=';', header='\ufeffx;y;z', decimal=','),
    'cloud_compare.asc': partial(
        write_table, separator=' ', header='//X Y Z R G B', axes='xyzxyz'),
    'numbered.csv': partial(write_table, separator=';', header='X1 (m);Y1 (m);Z1 (m)'),
    'prefix.txt': partial(
        write_table, separator=' ', header='pos_z [m] pos_y [m] pos_x [m]', axes='zyx'),
    'paraview.csv': partial(
        write_table, separator=',', header='range,Points_m_XYZ:0,Points_m_XYZ:1,Points_m_XYZ:2',
        axes='zxyz'),
    'counted.pts': partial(write_table, separator=' ', header='{}', axes='xyzxyz'),
    'named_and_counted.asc': partial(write_table, separator=' ', header='//X Y Z\n{}'),
    'counted_and_named.txt': partial(write_table, separator=';', header='{}\nR;Z;Y;X',
                                     axes='xzyx', decimal=','),
    'decimals.txt': partial(write_table, separator=' ', decimal=','),
    'tabs.asc': partial(write_table, separator='\t', axes='xyzxyz', decimal=','),
    'surveyor.csv': partial(write_table, separator=',', header='P,N,E,Z,D', axes='xyxzz'),
    'survey.csv': partial(write_table, separator=';', header='Point;Easting;Northing;Elevation',
                          axes='zxyz', decimal=','),
    'german.csv': partial(write_table, separator=';', header='Pkt;Hoch;Rechts;Höhe;Code',
                          axes='xyxzz', decimal=','),
    'quoted.csv': lambda path, points: path.write_text(''.join(
        '"{:.7f}","{:.7f}","{:.7f}"\n'.format(*row).replace('.', ',') for row in points.tolist())),
    'exponents.txt': lambda path, points: path.write_text(''.join(
        '{:.8e} {:.8e} {:.8e}\n'.format(*row).replace('.', ',') for row in points.tolist())),
    'pandas.csv': lambda path, points: path.write_text(',0,1,2\n' + ''.join(
        '{},{:.7f},{:.7f},{:.7f}\n'.format(k, *row) for k, row in enumerate(points.tolist()))),
    'late.csv': partial(write_table, separator=';', header='a;b;c;d;e;f;g;h;i;j;k;l;X;Y;Z',
                        axes=12 * 'z' + 'xyz', decimal=','),
    'two_scans.ptx': lambda path, points: path.write_text(
        ptx_of(points[:900]) + ptx_of(points[900:])),
}


@pytest.mark.parametrize('name', FORMATS)
def test_every_format_gives_back_the_points_and_is_refused_where_it_is_spoilt(tmp_path, name):
    path = tmp_path / name
    FORMATS[name](path, ROOM)
    scene = load_scene(path)
    assert scene.name == path.stem
    assert scene.points.dtype == np.float32 and scene.points.flags.c_contiguous
    np.testing.assert_allclose(scene.points, ROOM, atol=1e-4)
    content = path.read_bytes()
    spoilt = [b'', b'GIF89a\x00\xff\n' * 300]
    for share in (0.003, 0.5, 0.97):
        size = int(share * len(content))
        if path.suffix in ('.xyz', '.XYZ', '.txt', '.csv'):
            # Within the second number of a line, where text shows that it broke off.
            size = content.index(b'\n', size) + 14
        spoilt.append(content[:size])
    for bad in spoilt:
        path.write_bytes(bad)
        refusal(path)
    FORMATS[name](path, ROOM[:99])
    assert 'found 99 points' in refusal(path)


def test_ply_normals_are_kept_turned_and_of_length_one_unless_they_are_zero(tmp_path):
    path, normals = tmp_path / 'room.ply', 3.0 * Scene(ROOM).normals_or_estimate
    to_file = map_from_file('y')
    files.write_ply(path, ROOM @ to_file, **dict(zip(NORMALS, (normals @ to_file).T)))
    scene = load_scene(path, up='y')
    np.testing.assert_allclose(scene.points, ROOM, atol=1e-6)
    np.testing.assert_allclose(scene.normals, normals / 3.0, atol=1e-5)
    assert load_scene(path, up='y', voxel_size=0.3).normals is None
    # As 3D Gaussian splatting writes them.
    files.write_ply(path, ROOM, nx=0.0, ny=0.0, nz=0.0)
    assert load_scene(path).normals is None


def test_duplicates_go_and_their_normals_with_them(tmp_path):
    path = tmp_path / 'room.ply'
    heights = np.arange(1.0, 2.0 * len(ROOM) + 1.0)
    files.write_ply(path, np.concatenate([ROOM, ROOM]), nx=heights, ny=0.0, nz=1.0)
    scene = load_scene(path)
    np.testing.assert_array_equal(scene.points, ROOM)
    np.testing.assert_allclose(scene.normals[:, 0] / scene.normals[:, 2], heights[:len(ROOM)],
                               rtol=1e-3)
    assert scene.spacing.min() > 0.0


def test_the_frame_of_the_file_is_found_again_and_far_coordinates_are_not_rounded(
        tmp_path, caplog):
    corner = np.array([512_345_600.0, 1000.0, 5_400_000_000.0])
    source = 1000.0 * ROOM.astype(np.float64) @ map_from_file('y') + corner
    files.write_las(tmp_path / 'utm.las', source, offsets=corner)
    scene = load_scene(tmp_path / 'utm.las', scale=0.001, up='y')
    assert abs(scene.points).max() < 1000.0 and not scene.source.is_map
    assert 'utm.las: ' in caplog.text and '(512300, -5400000, 0)' in caplog.text
    back = scene.source.to_source(scene.points)
    np.testing.assert_allclose(back, source, atol=0.1)
    np.testing.assert_allclose(scene.source.to_map(back), scene.points, atol=1e-6)
    homogeneous = np.column_stack([scene.points, np.ones(len(scene))])
    np.testing.assert_allclose((homogeneous @ scene.source.matrix.T)[:, :3], back, rtol=1e-12)


def test_down_sampling_is_logged_and_remarked(tmp_path, caplog):
    path = tmp_path / 'room.npy'
    np.save(path, ROOM)
    with caplog.at_level(logging.INFO):
        coarse = load_scene(path, voxel_size=0.4)
        few = load_scene(path, max_points=800)
        same = load_scene(path, max_points=len(ROOM))
    np.testing.assert_array_equal(coarse.points, voxel_downsample(ROOM, 0.4))
    assert 700 < len(few) <= 800
    np.testing.assert_array_equal(same.points, ROOM)
    assert f'{len(coarse)} of {len(ROOM)} points' in caplog.text
    assert caplog.text.count('voxel grid') == 2
    assert few.remarks == (f'{len(few):,} of {len(ROOM):,} points kept (--points)',)


@pytest.mark.parametrize('name', ['ascii.ply', 'compressed.pcd', 'wide.npy', 'CAPITALS.XYZ'])
def test_points_that_are_not_finite_are_refused_or_dropped_but_never_silently(
        tmp_path, caplog, name):
    path, points = tmp_path / name, ROOM.copy()
    points[7, 1], points[9] = np.nan, np.inf
    FORMATS[name](path, points)
    message = refusal(path)
    assert 'found 2 of' in message and '--drop-nonfinite' in message
    with caplog.at_level(logging.INFO):
        scene = load_scene(path, drop_nonfinite=True)
    np.testing.assert_allclose(scene.points, np.delete(ROOM, [7, 9], axis=0), atol=1e-4)
    assert name in caplog.text and str(len(ROOM) - 2) in caplog.text


def test_a_folder_is_refused_and_the_file_inside_named(tmp_path):
    folder = tmp_path / 'office_1'
    folder.mkdir()
    files.write_text(folder / 'office_1.txt', ROOM)
    assert 'office_1.txt' in refusal(folder)


def test_a_file_that_the_disk_does_not_give_is_refused(tmp_path, monkeypatch):
    path = tmp_path / 'room.npy'
    np.save(path, ROOM)

    def fail(*_, **__):
        raise PermissionError(13, 'Permission denied')

    monkeypatch.setattr(np.lib.format, 'read_array', fail)
    assert 'Permission denied' in refusal(path)


@pytest.mark.parametrize(('broken', 'found'), [
    ('1.0 2.\x100 3.0 1 2 3', r'2.\x100'), ('1.0 2.0', "'1.0 2.0'"), ('x y z', "'x y z'"),
    ('1.0,2.0,3.0', "'1.0,2.0,3.0'")])
def test_a_broken_line_is_named_with_its_number(tmp_path, broken, found):
    # As in some copies of S3DIS: Area_5/hallway_6 has a control character within a number.
    path = tmp_path / 'hallway_6.txt'
    files.write_text(path, ROOM, ' 1 2 3')
    lines = path.read_text().splitlines()
    path.write_text('\n'.join(['# S3DIS', '', *lines[:1500], broken, *lines[1500:]]) + '\n')
    message = refusal(path)
    assert found in message and 'line 1503' in message and 'sed -i 1503d' in message


def test_nan_of_windows_is_nan(tmp_path):
    path = tmp_path / 'room.xyz'
    files.write_text(path, ROOM)
    path.write_text('1.#QNAN -1.#IND 1.#INF\n' + path.read_text())
    assert 'NaN' in refusal(path)
    np.testing.assert_allclose(load_scene(path, drop_nonfinite=True).points, ROOM, atol=1e-4)


COLOURS = np.random.default_rng(3).integers(0, 256, ROOM.shape)
NUMBERS = np.arange(len(ROOM))[:, None]


def write_columns(path, *columns, separator=' ', form='.7g'):
    """Write a line of numbers for each row of the columns."""
    path.write_text('\n'.join(
        separator.join(f'{value:{form}}' for part in row for value in part.tolist())
        for row in zip(*columns)) + '\n')


#: Files that are refused: a function that writes each, and what the message names.
REFUSED = {
    'none.ply': (lambda path: None, 'no such file'),
    'room.pdc': (lambda path: files.write_text(path, ROOM), 'did you mean .pcd'),
    'room.step': (lambda path: files.write_text(path, ROOM), 'as STL or glTF'),
    'room.rcp': (lambda path: files.write_text(path, ROOM), 'as E57'),
    'room.splat': (lambda path: files.write_text(path, ROOM), 'as .ply'),
    'room.xyz.gz': (lambda path: files.write_text(path, ROOM), 'unpack'),
    'room.vtk': (lambda path: files.write_text(path, ROOM), 'CloudCompare'),
    'longitude.csv': (lambda path: write_table(path, ROOM, ',', 'lon,lat,alt'), 'degrees'),
    'room': (lambda path: files.write_text(path, ROOM), '.csv .dxf .e57 .glb'),
    'without coordinates.csv': (
        lambda path: write_table(path, ROOM, ',', 'range,azimuth,elevation'), 'azimuth'),
    'wrong count.pts': (lambda path: write_table(path, ROOM, ' ', str(len(ROOM) + 5)),
                        f'{len(ROOM) + 5:,}'),
    'broken off.xyz': (lambda path: path.write_text('1 2 3 4 5 6\n' * 200 + '1 2 3 4'),
                       '4 numbers'),
    'colours.txt': (lambda path: write_columns(path, COLOURS, ROOM), 'colours'),
    'light.txt': (lambda path: write_columns(path, COLOURS / 255.0, ROOM), 'colours'),
    'millimetres.txt': (lambda path: write_columns(
        path, COLOURS, (1000.0 * ROOM).astype(int)), 'colours'),
    'float colours.txt': (lambda path: write_columns(path, COLOURS, ROOM, form='.3f'),
                          'columns 1 to 3, like colours'),
    'colours and commas.txt': (lambda path: path.write_text(''.join(
        '{} {} {} {:.3f} {:.3f} {:.3f}\n'.format(*row).replace('.', ',')
        for row in np.hstack([COLOURS.astype(object), ROOM]))), 'colours'),
    'four colours.txt': (lambda path: write_columns(path, COLOURS, NUMBERS * 0 + 255, ROOM),
                         '1i r g b a x y z'),
    'backwards.txt': (lambda path: write_columns(path, NUMBERS[::-1] / 1.0, ROOM, form='.3f'),
                      'number of the point'),
    'rings and times.csv': (lambda path: write_columns(
        path, NUMBERS % 16, NUMBERS / 9e4, ROOM, separator=','), '1i a,b,x,y,z'),
    'seconds.txt': (lambda path: write_columns(path, NUMBERS / 9e4, ROOM, form='.6f'), 'times'),
    'counted.txt': (lambda path: write_columns(path, NUMBERS, ROOM), 'number of the point'),
    'grid.csv': (lambda path: write_columns(
        path, NUMBERS // 50, NUMBERS % 50, ROOM, separator=','), 'columns 1 to 2'),
    'intensity.txt': (lambda path: write_columns(path, 9 * COLOURS[:, :1], COLOURS, ROOM),
                      'columns 1 to 4'),
    'normals first.txt': (lambda path: write_columns(
        path, Scene(ROOM).normals_or_estimate, ROOM), 'normals'),
    'times.csv': (lambda path: write_columns(path, 1.7e9 + NUMBERS / 7.0, ROOM, separator=','),
                  'times'),
    'thousands.csv': (lambda path: write_columns(
        path, 1000.0 * ROOM, separator=';', form=',.3f'), 'thousands'),
    'thousands.txt': (lambda path: write_columns(path, 1000.0 * ROOM, form=',.1f'), 'thousands'),
    'whole thousands.txt': (lambda path: write_columns(path, 1000.0 * ROOM, form=',.0f'),
                            'thousands'),
    'thousands of points.txt': (lambda path: write_columns(
        path, (1000.0 * ROOM).round().astype(int), form=',d'), 'thousands'),
    'dots.txt': (lambda path: path.write_text(''.join('{:,.0f} {:,.0f} {:,.0f}\n'.format(
        *row).replace(',', '.') for row in 1000.0 * ROOM)), 'thousands'),
    'commas alone.csv': (lambda path: path.write_text(''.join('{:.2f},{:.2f},{:.2f}\n'.format(
        *row).replace('.', ',') for row in ROOM)), 'with semicolons'),
    'thousands and commas.csv': (lambda path: write_columns(
        path, 1000.0 * ROOM, separator=',', form=',.1f'), 'thousands'),
    'blanks in thousands.csv': (lambda path: path.write_text(''.join(
        '{:,.1f};{:,.1f};{:,.1f}\n'.format(*row).replace(',', '\u202f').replace('.', ',')
        for row in 1000.0 * ROOM), encoding='utf-8'), 'thousands'),
    'apostrophes.csv': (lambda path: path.write_text(''.join(
        '{:,.1f};{:,.1f};{:,.1f}\n'.format(*row).replace(',', "'").replace(';', ',')
        for row in 1000.0 * ROOM)), 'thousands'),
    'tabs and no number.txt': (lambda path: path.write_text(''.join(
        '{:.3f}\t{:.3f}\t{}\t12\n'.format(*row[:2], row[2] if k % 20 else '')
        for k, row in enumerate(ROOM.tolist()))), 'of the next'),
    'longer lines.txt': (lambda path: path.write_text(''.join(
        f'{k % 4} ' * (k % 3 == 0) + '{:.3f} {:.3f} {:.3f}\n'.format(*row)
        for k, row in enumerate(ROOM.tolist()))), 'lines of 3 and of 4'),
    'keys.txt': (lambda path: path.write_text(''.join(
        'x={:.3f} y={:.3f} z={:.3f}\n'.format(*row) for row in ROOM.tolist())), 'numbers alone'),
    'ragged.txt': (lambda path: path.write_text('1 2 3 4\n1 2\n1 2 3\n' * 50), '49 of the next'),
    'comments alone.xyz': (lambda path: path.write_text('# only\n\n# comments\n'), 'no points'),
    'strips.ply': (lambda path: path.write_text(
        'ply\nformat ascii 1.0\nelement tristrips 1\nproperty int a\nend_header\n1\n'),
        'tristrips'),
    'no vertices.ply': (lambda path: path.write_text(
        'ply\nformat ascii 1.0\nelement camera 1\nproperty int a\nend_header\n1\n'),
        'no vertices'),
    'no z.ply': (lambda path: files.write_ply(path, ROOM, order='xy', r=0.0), 'no z'),
    'no rows.ply': (lambda path: files.write_ply(path, ROOM[:0]), 'no points'),
    'rounded.ply': (lambda path: files.write_ply(path, ROOM + [5e5, 5e6, 1e2]), 'float32'),
    'short.ply': (lambda path: files.write_ply(path, 1000.0 * ROOM, kind='i2'), '--scale 0.001'),
    'one more.pcd': (lambda path: files.write_pcd(
        path, ROOM, data='ascii', count=len(ROOM) + 1), 'export'),
    'a point.npy': (lambda path: np.save(path, 0.01 * ROOM), '--scale, 1000'),
    'all alike.npy': (lambda path: np.save(path, np.tile(ROOM[::40][:60], (5, 1))), '60 points'),
    'two axes.npy': (lambda path: np.save(path, ROOM[:, :2]), 'float32'),
    'one axis.npy': (lambda path: np.save(path, ROOM[:900].ravel()), '(2700,)'),
    'pickled.npy': (lambda path: np.save(path, np.array([{}], dtype=object)), 'export'),
    'hollow.ply': (lambda path: (files.write_ply(path, ROOM), os.truncate(path, 1 << 30)),
                   'were written'),
    'words.npy': (lambda path: np.save(path, ROOM.astype(str)), '<U'),
}


@pytest.mark.parametrize('name', REFUSED)
def test_files_that_are_no_scan_are_refused(tmp_path, name):
    write, words = REFUSED[name]
    write(tmp_path / name)
    message = refusal(tmp_path / name)
    assert words in message and 'delete' not in message
    assert '--scale' not in message or '--scale' in words


def test_las_says_what_is_noise_and_what_its_unit_is(tmp_path):
    laspy = pytest.importorskip('laspy')
    foot, path = 1200.0 / 3937.0, tmp_path / 'room.laz'
    files.write_las(path, np.vstack([ROOM, ROOM[:40] + [0.0, 3.0, 0.0]]) / foot)
    content = laspy.read(path)
    content.classification[-40:-20], content.withheld[-20:] = 7, 1
    wkt = 'PROJCS["x",GEOGCS["y",UNIT["degree",0.0174]],UNIT["US survey foot",0.304800609601219]]'
    content.header.vlrs.append(laspy.VLR('LASF_Projection', 2112, '', wkt.encode()))
    content.write(path)
    scene = load_scene(path)
    np.testing.assert_allclose(scene.size, np.ptp(ROOM, axis=0), atol=1e-3)
    assert len(scene) == len(ROOM) and any('US survey foot' in one for one in scene.remarks)
    assert load_scene(path, scale=foot).remarks == ()


#: The unit of heights in feet, as text.
HEIGHT_IN_FEET = 'VERT_CS["h",VERT_DATUM["d",2005],UNIT["US survey foot",0.3048006],AXIS["up",UP]]'


def geo_keys(*keys):
    """Return a record of GeoTIFF keys, each with its number in it."""
    rows = [(1, 1, 0, len(keys)), *((key, 0, 1, value) for key, value in keys)]
    return 34735, np.array(rows, dtype='<u2').tobytes()


def own_unit(metres):
    """Return records of a unit that the file defines itself, with its length in metres."""
    rows = [(1, 1, 0, 2), (3076, 0, 1, 32767), (3077, 34736, 1, 0)]
    return ((34735, np.array(rows, dtype='<u2').tobytes()), (34736, np.array([metres]).tobytes()))


def named_heights(name):
    """Return records of a system of heights that has only a name."""
    rows = [(1, 1, 0, 2), (3076, 0, 1, 9001), (4097, 34737, len(name), 0)]
    return (34735, np.array(rows, dtype='<u2').tobytes()), (34737, name.encode())


#: A system in feet that is bound to one in metres, as text.
BOUND = ('BOUNDCRS[SOURCECRS[PROJCRS["p",CS[Cartesian,2],LENGTHUNIT["foot",0.3048]]],TARGETCRS['
         'GEOGCRS["g",DATUM["d",ELLIPSOID["e",6378137,298.257,LENGTHUNIT["metre",1]]]]]]')


@pytest.mark.parametrize(('record', 'plan_m', 'height_m', 'words'), [
    (own_unit(0.3048), 0.3048, 0.3048, 'unit: 0.3048 m,'),
    (named_heights('NAVD88 - Geoid12B (Feet)|'), 1.0, 0.3048, 'metre in plan, foot in height'),
    ((2112, BOUND.encode()), 0.3048, 0.3048, 'unit: foot,'),
    ((2112, b'ENGCRS["site",CS[Cartesian,3],AXIS["x",east,LENGTHUNIT["metre",1]],'
      b'AXIS["z",up,LENGTHUNIT["foot",0.3048]]]'), 1.0, 0.3048, 'metre in plan, foot in height'),
    (geo_keys((3076, 9001), (4099, 9003)), 1.0, 0.3048, 'metre in plan, US survey foot in height'),
    (geo_keys((3076, 9002), (4099, 9001)), 0.3048, 1.0, 'foot in plan, metre in height'),
    (geo_keys((3072, 2263), (4096, 5703)), 0.3048, 1.0, 'foot in plan, metre in height'),
    (geo_keys((3072, 26918), (4096, 6360)), 1.0, 0.3048, 'metre in plan, foot in height'),
    (geo_keys((3072, 6539)), 0.3048, 0.3048, 'unit: foot,'),
    ((2112, f'COMPD_CS["c",PROJCS["p",GEOGCS["g",UNIT["degree",0.0174]],UNIT["metre",1]],'
      f'{HEIGHT_IN_FEET}]'.encode()), 1.0, 0.3048, 'metre in plan, US survey foot in height'),
    ((2112, b'COMPOUNDCRS["c",PROJCRS["p",ANGLEUNIT["degree",0.0174],CS[Cartesian,2],'
      b'LENGTHUNIT["foot",0.3048]],VERTCRS["h",CS[vertical,1],LENGTHUNIT["metre",1]]]'),
     0.3048, 1.0, 'foot in plan, metre in height')])
def test_las_may_measure_heights_in_another_unit_than_the_plan(
        tmp_path, record, plan_m, height_m, words):
    laspy, path = pytest.importorskip('laspy'), tmp_path / 'room.las'
    corner = np.array([300_000.0, 60_000.0, 0.0])
    source = ROOM / [plan_m, plan_m, height_m] + corner
    files.write_las(path, source, offsets=corner)
    content = laspy.read(path)
    for number, body in record if isinstance(record[0], tuple) else (record,):
        content.header.vlrs.append(laspy.VLR('LASF_Projection', number, '', body))
    content.write(path)
    scene = load_scene(path)
    np.testing.assert_allclose(scene.size, np.ptp(ROOM, axis=0), rtol=1e-4)
    assert any(words in remark for remark in scene.remarks)
    np.testing.assert_allclose(scene.source.to_source(scene.points), source, atol=0.01)
    np.testing.assert_allclose(
        scene.source.to_map(scene.source.to_source(scene.points)), scene.points, atol=1e-6)


def test_vertices_without_faces_are_points(tmp_path):
    path = tmp_path / 'room.obj'
    path.write_text(''.join('v {:.7f} {:.7f} {:.7f}\n'.format(*point) for point in ROOM.tolist()))
    np.testing.assert_allclose(load_scene(path).points, ROOM, atol=1e-5)


@pytest.mark.parametrize(('comment', 'metres'), [
    ('# Exported by a program\n# File units = inches', 0.0254), ('# Units: Millimeters', 0.001),
    ('# 1 unit = 1 cm', 0.01), ('#unit 0.5 ft', 0.1524), ('# all dimensions in mm.', 0.001),
    ('# a unit of furniture, 3 m', 1.0), ('# exported in a hurry, 1/10 mm', 1.0),
    ('# This file uses centimeters as units', 0.01), ('# Units: US survey feet', 1200.0 / 3937.0),
    ('# measured in feet', 0.3048), ('# 1 unit equals 1 mm', 0.001)])
@pytest.mark.parametrize(('name', 'line'), [('a.obj', 'v {:.6f} {:.6f} {:.6f}\n'),
                                            ('a.xyz', '{:.6f} {:.6f} {:.6f}\n')])
def test_a_unit_in_a_comment_is_the_unit_of_the_file(tmp_path, name, line, comment, metres):
    path = tmp_path / name
    path.write_text(f'{comment}\n' + ''.join(line.format(*row) for row in ROOM / metres))
    scene = load_scene(path)
    np.testing.assert_allclose(scene.size, np.ptp(ROOM, axis=0), atol=1e-4)
    assert any('unit' in remark for remark in scene.remarks) == (metres != 1.0)
    assert not load_scene(path, scale=metres).remarks


@pytest.mark.parametrize(('header', 'metres'), [
    ('Easting (ft);Northing (ft);Elevation (ft)', 0.3048), ('x_mm;y_mm;z_mm', 0.001),
    ('"X [cm]";"Y [cm]";"Z [cm]"', 0.01), ('x_in_map;y_in_map;z_in_map', 1.0)])
def test_a_unit_in_the_name_of_a_column_is_the_unit_of_the_file(tmp_path, header, metres):
    write_table(tmp_path / 'a.csv', ROOM / metres, ';', header)
    scene = load_scene(tmp_path / 'a.csv')
    np.testing.assert_allclose(scene.size, np.ptp(ROOM, axis=0), atol=1e-4)


def test_splats_are_warned_of_unless_their_scale_is_given(tmp_path):
    path = tmp_path / 'splats.ply'
    files.write_ply(path, ROOM, nx=0.0, ny=0.0, nz=0.0, f_dc_0=0.5, opacity=1.0, scale_0=-5.0)
    with pytest.warns(SceneWarning, match='splats'):
        load_scene(path)
    assert load_scene(path, scale=1.0).notes == ()


@pytest.mark.parametrize('options', [
    {'voxel_size': 1e-5}, {'voxel_size': np.nan}, {'voxel_size': 5.0}, {'max_points': 10},
    {'scale': -1.0}, {'scale': np.inf}, {'up': 'w'}])
def test_options_without_a_meaning_are_refused(tmp_path, options):
    np.save(tmp_path / 'room.npy', ROOM)
    assert next(iter(options)) in refusal(tmp_path / 'room.npy', **options)


def test_points_in_memory_say_nothing_of_their_unit_and_axes():
    for option, value in (('up', 'file'), ('scale', 0.0)):
        with pytest.raises(SceneError, match=option):
            scene_of(ROOM, **{option: value})


@pytest.mark.parametrize(('name', 'options', 'size'), [
    ('washitsu.ply', {}, [3.7, 2.6, 2.5]), ('office_floor.ply', {}, [38.9, 14.7, 3.0]),
    # Behind a wall of the living room there is a strip of another room.
    ('living_room_open.ply', {'all_rooms': True}, [7.4, 6.3, 3.2]),
    ('room_scan2.pcd', {}, [17.1, 14.9, 3.3]),
    pytest.param('indoor.laz', {'up': 'y'}, [27.8, 17.6, 9.4], marks=pytest.mark.system)])
def test_real_scans_load_and_only_turned_ones_warn(tmp_path, name, options, size):
    if not (SCANS / name).exists():
        pytest.skip(f'no real scan {SCANS / name}')
    scene = load_scene(SCANS / name, max_points=15000, **options)
    assert 10000 < len(scene) <= 15000 and scene.spacing.min() > 0.0
    np.testing.assert_allclose(scene.size, size, atol=0.15)
    for up in 'yx':
        path = tmp_path / f'{up}.npy'
        np.save(path, scene.points @ map_from_file(up))
        with pytest.warns(SceneWarning, match=f'--up {up}'):
            load_scene(path)
