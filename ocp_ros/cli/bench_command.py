# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``ocp bench``: what was measured of the engine, on the screen and as a page."""

import argparse
import json
from typing import Any

from rich.console import Console
from rich.table import Table

from ocp_ros.evaluation.engine_bench import (
    CLEARANCE,
    EXTENTS,
    FIGURES,
    measure_engine,
    MIDDLE,
    RADII,
)
from ocp_ros.evaluation.fused_bench import EXTENTS as FUSED_EXTENTS
from ocp_ros.evaluation.fused_bench import measure_fused, TOLERANCE
from ocp_ros.util.files import write_atomically

#: What the figures of speed are.
MEANING = {
    'speedup_vs_hpr': 'time of hidden point removal / time of `fast`',
    'speedup_vs_hpr_fine': 'time of hidden point removal / time of `fine`',
    'speedup_vs_embree_fine': 'time of `embree` / time of `fine`',
    'numpy_twin_speedup': 'time of the NumPy twin / time of `fast`',
    'env_steps_per_s': 'steps of the Gymnasium environment per second',
    'evaluations_per_s': 'evaluated placements per second',
    'evaluations_per_s_one_moved':
        'evaluated placements per second if only one camera has moved since the previous '
        'placement',
    'scaling_2_threads': 'time with one thread / time with two threads'}


def bench(arguments: argparse.Namespace) -> dict[str, Any]:
    """
    Measure the engine, and write the figures.

    :returns: what was measured, and the files ``written``.
    """
    result = {**measure_engine(EXTENTS[arguments.preset]),
              **measure_fused(FUSED_EXTENTS[arguments.preset]),
              'command': f'ocp bench --preset {arguments.preset}'}
    write_atomically(arguments.out, json.dumps(result, indent=2) + '\n')
    if arguments.page:
        write_atomically(arguments.page, page(result))
    return {**result, 'written': [path for path in (arguments.out, arguments.page) if path]}


def show(result: dict[str, Any]) -> None:
    """Print the figures."""
    table = Table('points', 'method', 'precision', 'recall', 'F1', 'ms', 'ns per point',
                  title='Visibility from one camera against ray casting, one thread')
    for row in result['visibility']:
        table.add_row(f'{row["density"]:,}', row['method'], f'{row["precision"]:.3f}',
                      f'{row["recall"]:.3f}', f'{row["f1"]:.3f}', f'{row["ms"]:.2f}',
                      f'{row["ns_per_point_camera"]:.1f}')
    fused = Table('points', 'method', 'precision', 'recall', 'F1',
                  title='Frames predicted from scans that were fused of other frames')
    for row in result['fused']:
        fused.add_row(f'{row["density"]:,}', row['method'],
                      *(f'{row[name]:.3f}' for name in ('precision', 'recall', 'f1')))
    console = Console(width=110)
    console.print(table, fused)
    for name in FIGURES:
        console.print(f'{name}: {result[name]:.1f}')


def page(result: dict[str, Any]) -> str:
    """Write the figures as a page of the documentation."""
    rows = '\n'.join(
        f'| {row["density"]:,} | {row["method"].replace("_", " ")} | {row["precision"]:.3f} | '
        f'{row["recall"]:.3f} | {row["f1"]:.3f} | {row["ms"]:.2f} | '
        f'{row["ns_per_point_camera"]:.1f} |' for row in result['visibility'])
    figures = '\n'.join(f'| `{name}` | {result[name]:,.1f} | {MEANING[name]} |'
                        for name in FIGURES)
    scales = '\n'.join(
        f'| {row["points"]:,} | {row["ns_per_point_camera"]:.1f} | {row["bytes_per_point"]:.0f} | '
        f'{row["seconds_to_build"]:.1f} |' for row in result['scale'])
    return f"""# The engine, measured

The engine computes which points of a room a camera sees ([how it works](explanation/engine.md)).
This page compares it with ray casting and with other methods. `{result["command"]}` wrote
it on {result["date"]}.

## Scans of tripods
The rooms are {result["rooms"]} generated rooms with {result["positions"]} camera positions each.
The cameras are at least {CLEARANCE} m from all surfaces and have a range of
{result["range"]:.0f} m. Ray casting at the meshes of the rooms says which points are visible. A
method predicts which points are visible. Precision is the share of the predicted points that are
visible, recall the share of the visible points that are predicted, and F1 the harmonic mean of
both. All methods run with the same cameras, in the same process, on one core.

| method | what it is |
|---|---|
| `fine`, `fast`, `paper` | presets of the engine |
| `embree` | one ray per point at the true mesh; a user who has only a point cloud cannot do this |
| `numpy twin of fast` | the rules of `fast` in plain NumPy |
| `hidden point removal` | the function of Open3D. It has a radius as parameter; \
the tables have the best of {len(RADII)} radii, in metres after the name |

| points | method | precision | recall | F1 | ms per camera | ns per point |
|---|---|---|---|---|---|---|
{rows}

{_fused(result)}\
## Speed
Speedups are ratios of times for one camera at {MIDDLE:,} points. The other figures are for the
preset `fast`, 4 cameras, a room of {result["points"]:,} points and two threads.

| figure | value | meaning |
|---|---|---|
{figures}

## Large rooms
Time per camera and memory per scene, with `fast` on one core. Memory includes points, normals,
coverage grid and the point lists of the depth error. Each thread needs 8 more bytes per point as
workspace.

| points | ns per point and camera | bytes per point | seconds to build |
|---|---|---|---|
{scales}
"""


def _fused(result: dict[str, Any]) -> str:
    """Write what was measured on fused scans; nothing where an earlier version measured none."""
    if 'fused' not in result:
        return ''
    fused = '\n'.join(
        f'| {row["density"]:,} | {row["method"].replace("_", " ")} | {row["precision"]:.3f} | '
        f'{row["recall"]:.3f} | {row["f1"]:.3f} |' for row in result['fused'])
    return f"""\
## Scans of a hand-held camera
Scans of depth cameras are noisier than those of tripods. A simulated hand-held camera scans
{result["fused_rooms"]} of the rooms. Up to {result["fused_frames"]} frames with the noise of a
Kinect are fused into a mesh. The mesh is thinned to the number of points in the table. Then the
camera walks through each room again and takes new frames, {result["fused_views"]} in all. From the
thinned points each method predicts which of them are visible in a new frame. Only points inside
the field of view and the range of the frame are compared. A point is visible if no true surface
lies more than {100 * TOLERANCE:.0f} cm in front of it. The method `mesh` casts rays at the fused
mesh.

| points at most | method | precision | recall | F1 |
|---|---|---|---|---|
{fused}

"""
